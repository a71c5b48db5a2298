"""Two services with one robot name behind one router: neither moves, and both stop."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh
from control_rig import CONFIG
from processes.test_gateway import FakeLink, came
from refusals import refused_as, uncoded
from trirail.cli.router import RouterConfig
from trirail.cli.router import settings as router_settings
from trirail.config import Zenoh
from trirail.errors import RefusalCode
from trirail.processes.gateway import Gateway
from trirail.processes.name_conflict import GRACE_S, NameConflict
from trirail.processes.session_guard import Guard
from trirail.wire import zenoh_session
from trirail.wire.event_codes import EventCode
from trirail.wire.messages import Notice
from trirail.wire.packets import Announcement, CommandRequest, GoalRequest
from trirail.wire.records import DTYPE
from waiting import wait_until

GOAL = b'{"kind": "pose", "x": 0, "y": 0, "phi": 0}'
REFUSED = (("goal/ann", GOAL), ("cmd/ann/enable", b""), ("cmd/ann/home", b""), ("cmd/ann/resume", b""),
           ("cmd/ann/set_output", b'{"output": "valve", "value": true}'),
           ("cmd/ann/override", b'{"percent": 101}'))  # fmt: skip
STOPS = ("stop", "quick_stop", "disable", "pause")


class Router:
    """A router, which may come and go."""

    def __init__(self, folder: Path) -> None:
        self.locator = f"unixsock-stream/{folder}/hub"
        self.start()

    def start(self) -> None:
        settings = router_settings(RouterConfig(Zenoh(listen=(self.locator,)), robots=("demo",)))
        self._session = zenoh.open(zenoh.Config.from_json5(msgspec.json.encode(settings).decode()))

    def end(self) -> None:
        zenoh_session.close(self._session)


class Service:
    """A gateway behind the router, with a clock of its own for what it knows of others of its name."""

    def __init__(self, folder: Path, router: str, run: str, name: str = "demo") -> None:
        folder.mkdir(exist_ok=True)
        own = Zenoh(listen=(f"unixsock-stream/{folder}/{run}",), connect=(router,))
        robot = msgspec.structs.replace(CONFIG.robot, name=name)
        config = msgspec.structs.replace(CONFIG, robot=robot, zenoh=own)
        self.name, self.now, self.link, guard = name, 0.0, FakeLink(), Guard(config)
        self.session = guard.open()
        self.gateway = Gateway(config, self.link, lambda: None, self.session, guard, run=run)  # type: ignore[arg-type]
        self.conflict._clock, self.conflict._grace_ends = lambda: self.now, GRACE_S
        wait_until(self._watches)

    @property
    def conflict(self) -> NameConflict:
        return self.gateway._name_conflict

    def _watches(self) -> bool:
        """Whether it watches the router; it has not announced anything meanwhile."""
        self.conflict._check_at = 0.0
        self.conflict.poll()
        return any(opened.done() and opened.exception() is None for opened in self.conflict._routers.values())

    def knows(self) -> bool:
        return bool(self.conflict._tokens)

    def send(self, key: str, content: bytes = b"") -> None:
        self.gateway._handle(came(key.partition("/")[0], f"trirail/{self.name}/{key}", content))

    def announced(self) -> list[Notice]:
        return [request.notice for request in self.link.sent if isinstance(request, Announcement)]

    def at(self, now: float) -> tuple[str, ...]:
        """Return the warnings at this time."""
        self.now = now
        self.conflict.poll()
        return self.gateway.warnings()

    def end(self) -> None:
        self.conflict.close()
        self.gateway._replies.close()
        zenoh_session.close(self.session)


@pytest.fixture
def router(tmp_path: Path) -> Iterator[Router]:
    made = Router(tmp_path)
    yield made
    made.end()


@pytest.fixture
def first(tmp_path: Path, router: Router) -> Iterator[Service]:
    made = Service(tmp_path, router.locator, "first")
    yield made
    made.end()


def test_neither_of_two_services_of_one_name_moves_but_both_stop(
    tmp_path: Path, router: Router, first: Service
) -> None:
    second = Service(tmp_path, router.locator, "second")
    for service in (first, second):
        wait_until(service.knows)
        service.gateway._states.records(np.zeros(1, DTYPE))  # the override is 100 %
        for key, content in REFUSED:
            service.send(key, content)
        assert [notice.code for notice in service.announced()] == [RefusalCode.NAME_IN_USE] * len(REFUSED)
        assert not [request for request in service.link.sent if isinstance(request, GoalRequest | CommandRequest)]
        for name in STOPS:
            service.send(f"cmd/ann/{name}")
        service.send("cmd/ann/override", b'{"percent": 0}')
        passed = [request.name for request in service.link.sent if isinstance(request, CommandRequest)]
        assert passed == [*STOPS, "override"]
        service.link.sent.clear()
        (warning,) = service.at(GRACE_S)
        assert service.at(GRACE_S + 100.0) == (warning,)
        (notice,) = service.announced()  # once
        assert uncoded([notice]) == [Notice("service", "error", warning)]
        assert notice.event_code is EventCode.NAME_IN_USE
    second.end()
    wait_until(lambda: not first.knows())
    assert first.at(GRACE_S + 200.0) == ()
    first.send("goal/ann", GOAL)
    assert [request.user for request in first.link.sent if isinstance(request, GoalRequest)] == ["ann"]


@pytest.mark.long
def test_a_run_that_vanishes_soon_is_not_reported(tmp_path: Path, router: Router, first: Service) -> None:
    second = Service(tmp_path, router.locator, "second")
    wait_until(second.knows)
    with refused_as(RefusalCode.NAME_IN_USE):
        second.conflict.check("a goal")
    assert second.at(0.9 * GRACE_S) == ()
    zenoh_session.close(first.session)
    wait_until(lambda: not second.knows())
    second.conflict.check("a goal")
    assert second.at(2.0 * GRACE_S) == ()
    assert not second.announced()
    second.end()


@pytest.mark.long
def test_a_restarted_gateway_and_a_robot_of_another_name_do_not_disturb(
    tmp_path: Path, router: Router, first: Service
) -> None:
    again = Service(tmp_path / "again", router.locator, "first")
    other = Service(tmp_path / "other", router.locator, "second", name="other")
    third = Service(tmp_path, router.locator, "third")
    for service in (first, again):
        wait_until(service.knows)
    third.end()
    for service in (first, again):  # nothing is left; whatever came before the end of the third has arrived
        wait_until(lambda service=service: not service.knows())  # type: ignore[misc]
    assert not other.knows()
    again.end()
    other.end()


@pytest.mark.long
def test_it_is_known_again_after_the_router_has_restarted(tmp_path: Path, router: Router, first: Service) -> None:
    second = Service(tmp_path, router.locator, "second")
    for service in (first, second):
        wait_until(service.knows)
    router.end()
    for service in (first, second):  # nothing reaches both now
        wait_until(lambda service=service: not service.knows())  # type: ignore[misc]
    router.start()
    for service in (first, second):
        wait_until(service.knows)
    second.end()
