"""A whole service whose ports others hold: a new stop gets through to the moving robot, once."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections.abc import Iterator

import pytest
from certificates import service_port, user
from processes.test_service import SLOWLY, until
from processes.test_tls_service import Served
from refusals import refused_as
from trirail.client.client import Robot
from trirail.client.new_stop import NewStop
from trirail.errors import RefusalCode, ServiceError
from trirail.wire.stop_protocol import PORT_OFFSET
from waiting import WITHIN

pytestmark = pytest.mark.slow

HELD = 150
"""Connections on each port: Zenoh shakes hands with one after the other, and waits seconds for each of these."""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    served = Served(tmp_path_factory.mktemp("flooded"))
    yield served
    assert served.service.end() == 0, served.service.log.read_text()
    assert "Traceback" not in served.service.log.read_text()


@pytest.fixture(scope="module")
def users(served: Served) -> Iterator[tuple[Robot, Robot]]:
    """An operator and a maintainer, whose sessions are open before anybody holds the ports."""
    with served.robot("ann") as ann, served.robot("max") as boss:
        yield ann, boss


@pytest.fixture
def ann(users: tuple[Robot, Robot]) -> Robot:
    ann, boss = users
    if ann.state().mode == "fault":
        boss.reset()
    ann.enable()
    assert ann.move_to(x=-0.1, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
    return ann


def port(locator: str) -> int:
    return int(locator.rpartition(":")[2])


@contextlib.contextmanager
def held(served: Served) -> Iterator[str]:
    """Hold both ports; the locator is the service's own."""
    with contextlib.ExitStack() as connections:
        for _ in range(HELD):
            for number in (port(served.locator), port(served.locator) + PORT_OFFSET):
                connections.enter_context(socket.create_connection(("127.0.0.1", number)))
        yield served.locator


def passed(ready: socket.socket) -> bytes:
    """What comes of a connection; nothing of one that was cut off."""
    with contextlib.suppress(ConnectionError):
        return ready.recv(4096)
    return b""


@contextlib.contextmanager
def without_zenoh(served: Served) -> Iterator[str]:
    """A locator at which Zenoh never answers, while the door beside it is the service's."""
    number, over = service_port(), threading.Event()
    with (
        contextlib.ExitStack() as opened,
        socket.create_server(("127.0.0.1", number)),
        socket.create_server(("127.0.0.1", number + PORT_OFFSET)) as door,
    ):

        def serve() -> None:
            other: dict[socket.socket, socket.socket] = {}
            while not over.is_set():
                for ready in select.select([door, *other], [], [], 0.02)[0]:
                    if ready is door:
                        client = opened.enter_context(door.accept()[0])
                        service = socket.create_connection(("127.0.0.1", port(served.locator) + PORT_OFFSET))
                        other |= {client: opened.enter_context(service), service: client}
                    elif heard := passed(ready):
                        other[ready].sendall(heard)
                    else:
                        for each in (other.pop(ready), ready):
                            other.pop(each, None)
                            each.close()
                        break  # the other one of the pair may be among those that were ready

        serving = threading.Thread(target=serve)
        serving.start()
        try:
            yield f"tls/127.0.0.1:{number}"
        finally:
            over.set()
            serving.join()


@pytest.mark.parametrize("hindered", [held, without_zenoh])
@pytest.mark.parametrize(("command", "mode"), [("stop", "holding"), ("disable", "disabled"), ("quick-stop", "fault")])
def test_a_new_stop_is_confirmed_while_others_hold_the_ports(
    served: Served, ann: Robot, hindered: object, command: str, mode: str
) -> None:
    goal = ann.move_to(x=0.1, y=0.0, phi=0.0, speed=SLOWLY)
    until(ann, lambda state: state.mode == "moving")
    with hindered(served) as locator:  # type: ignore[operator]
        code, said = served.call("ann", command, "--connect", locator)
    assert (code, said["mode"]) == (0, mode), said
    assert goal.wait(WITHIN).outcome in ("stopped", "faulted")


def test_a_role_that_may_not_is_refused_there_too(served: Served) -> None:
    with without_zenoh(served) as locator:
        asked = NewStop("quick_stop", "demo", locator, user(served.folder, "eva"))
        with refused_as(RefusalCode.NOT_ALLOWED):
            asked.wait()
        asked.opening.join()


def test_where_nobody_is_that_is_said(served: Served) -> None:
    asked = NewStop("stop", "demo", f"tls/127.0.0.1:{service_port()}", user(served.folder, "ann"))
    with pytest.raises(ServiceError, match="no service at tls/"):
        asked.wait()
    asked.opening.join()
