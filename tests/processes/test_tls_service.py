"""A whole service among users with real certificates, and with the wrong ones: who moves it, and who only stops it."""

from __future__ import annotations

import json
import stat
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from certificates import ROLES, tls_config, user
from processes.test_service import SLOWLY, Service, until
from refusals import refused_as
from trirail.client import connection
from trirail.client.client import Robot
from trirail.errors import RefusalCode, ServiceError
from trirail.wire import zenoh_session
from trirail.wire.credentials import Credentials
from trirail.wire.vocabulary import Role
from waiting import WITHIN
from warm import trirail

pytestmark = pytest.mark.slow

LONG = 10.0
"""The time-out of a lease that a busy machine must not end [s]."""
LISTEN = 'listen = ["tcp/127.0.0.1:7447"]'


class Served:
    """The service and everybody's certificates."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        zenoh = tls_config(folder).zenoh
        (self.locator,) = zenoh.listen
        assert zenoh.tls is not None
        users = "\n".join(f'{name} = "{role}"' for name, role in zenoh.users.items())
        tables = f'[zenoh.tls]\ndirectory = "{zenoh.tls.directory}"\n[zenoh.users]\n{users}'
        self.service = Service(folder, **{LISTEN: f'listen = ["{self.locator}"]\n{tables}'})
        self.service.wait_up()

    def robot(self, name: str) -> Robot:
        return Robot("demo", self.locator, tls=user(self.folder, name))

    def call(self, name: str, *arguments: object) -> tuple[int, dict[str, object]]:
        """Run a command as a user; return its exit code, and what it says as JSON."""
        done = trirail(*arguments, "--json", "--tls", user(self.folder, name), locator=self.locator)
        return done.returncode, json.loads(done.stdout)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    served = Served(tmp_path_factory.mktemp("tls"))
    yield served
    assert served.service.end() == 0, served.service.log.read_text()
    for recording in (served.folder / "recordings").iterdir():
        assert stat.S_IMODE(recording.stat().st_mode) == 0o640


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "ROLE_WITHIN", WITHIN)
    monkeypatch.setattr(connection, "HERE_WITHIN", WITHIN)


@pytest.fixture
def ann(served: Served) -> Iterator[Robot]:
    with served.robot("ann") as ann:
        ann.enable()
        assert ann.move_to(x=-0.1, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
        yield ann


def test_an_operator_moves_it_from_the_command_line(served: Served) -> None:
    assert served.call("ann", "enable")[0] == 0
    code, result = served.call("ann", "goto", 0.01, 0, 0, "--wait")
    assert (code, result["outcome"]) == (0, "done")
    assert served.call("ann", "reset") == (
        1,
        {
            "ok": False,
            "error": "RefusedError",
            "code": "not_allowed",
            "message": "ann is operator at robot demo: cmd/ann/reset needs the role maintainer",
        },
    )


@pytest.mark.usefixtures("ann")
def test_a_viewer_sees_it_and_is_refused(served: Served) -> None:
    with served.robot("eva") as eva:
        before = until(eva, lambda state: state.mode == "holding")
        assert eva.info().robot == "demo"
        assert eva.role() is Role.VIEWER
        assert {"ann", "eva"} <= set(eva.users())
        for ask in (lambda: eva.move_to(x=0.0, y=0.0, phi=0.0), eva.disable, eva.acquire):
            with refused_as(RefusalCode.NOT_ALLOWED):
                ask()
        after = until(eva, lambda state: state.seq > before.seq + 100)
        assert after.commanded.pose == before.commanded.pose
        assert after.lease is None


@pytest.mark.parametrize("name", ROLES)
def test_everybody_with_a_role_stops_it(served: Served, ann: Robot, name: str) -> None:
    goal = ann.move_to(x=0.1, y=0.0, phi=0.0, speed=SLOWLY)
    until(ann, lambda state: state.mode == "moving")
    with ann.lease(timeout=LONG), served.robot(name) as anybody:
        anybody.stop()
        assert goal.wait(WITHIN).outcome == "stopped"


@pytest.mark.usefixtures("ann")
def test_who_is_revoked_or_has_no_role_does_nothing(served: Served) -> None:
    for name in ("gone", "una"):
        with served.robot(name) as asking, refused_as(RefusalCode.NOT_ALLOWED):
            asking.move_to(x=0.0, y=0.0, phi=0.0)


@pytest.mark.parametrize("name", ["late", "early", "foreign", "none"])
def test_a_certificate_that_is_no_good_opens_no_session(served: Served, name: str) -> None:
    with pytest.raises(ServiceError):
        served.robot(name)
    if name != "none":
        unseen = Credentials(user(served.folder, name), name, datetime.now(UTC), ())  # not looked at by the client
        with pytest.raises(ServiceError, match=r"no service at tls/.*certificate.*; .*--tls"):
            zenoh_session.open_client(served.locator, unseen)


def test_nobody_without_a_certificate_opens_one(served: Served) -> None:
    address = served.locator.removeprefix("tls/")
    for protocol in ("tls", "tcp"):
        with pytest.raises(ServiceError, match="no service at"):
            zenoh_session.open_client(f"{protocol}/{address}")


def test_only_a_maintainer_takes_the_lease_over(served: Served, ann: Robot) -> None:
    with served.robot("max") as boss, boss.lease(timeout=LONG) as lease:
        with refused_as(RefusalCode.NOT_ALLOWED), ann.lease(force=True):
            pass
        until(ann, lambda state: state.lease == "max")
        assert lease.lost is None
    with ann.lease(timeout=LONG) as lease, served.robot("max") as boss, boss.lease(force=True, timeout=LONG):
        assert lease.wait(WITHIN)
        until(ann, lambda state: state.lease == "max")
