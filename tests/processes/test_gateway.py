"""The gateway between Zenoh and the loop, without processes: what it passes on, refuses and survives."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import CONFIG
from trirail.processes.backlog import PATIENCE
from trirail.processes.gateway import UNDER_WAY, Gateway
from trirail.processes.guard import Guard
from trirail.processes.inbox import Incoming
from trirail.wire import boundary, packets, zenoh_session
from trirail.wire.packets import Accepted, CommandRequest, Confirmed, GoalRequest, RefusedRequest, Request, Welcome
from trirail.wire.state import Info
from trirail.wire.vocabulary import Command
from trirail_drivers.interface import MissingProtection


class FakeLink:
    """Keeps what the gateway sends to the loop."""

    def __init__(self) -> None:
        self.sent: list[Request] = []

    def send(self, packet: bytes) -> bool:
        self.sent.append(packets.decode_request(packet[1:]))
        return True


Rig = tuple[Gateway, FakeLink]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    link = FakeLink()
    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/z"]) as opened:
        yield Gateway(CONFIG, link, lambda: None, opened, Guard(CONFIG)), link  # type: ignore[arg-type]


def goal(gateway: Gateway, name: str) -> None:
    content = json.dumps({"kind": "pose", "x": 0, "y": 0, "phi": 0, "id": name}).encode()
    gateway._handle(Incoming("goal", "trirail/demo/goal/ann", len(content), content, "", None))


def command(gateway: Gateway, name: str, content: bytes = b"") -> None:
    gateway._handle(Incoming("cmd", f"trirail/demo/cmd/ann/{name}", len(content), content, "", None))


@pytest.mark.parametrize("name", Command)
def test_every_command_is_passed_on(rig: Rig, name: Command) -> None:
    gateway, link = rig
    command(gateway, name, b'{"percent": 50}' if name is Command.OVERRIDE else b"")
    assert link.sent == [CommandRequest(1, "ann", name, 0.5 if name is Command.OVERRIDE else None)]


@pytest.mark.parametrize("name", Command)
def test_what_a_command_does_not_take_is_refused_with_what_it_takes(rig: Rig, name: Command) -> None:
    gateway, link = rig
    command(gateway, name, b'{"odd": 1}')
    (said,) = link.sent
    assert isinstance(said, RefusedRequest)
    assert said.message.startswith(f"{name} takes {name.content}: ")


def test_a_command_that_there_is_not_is_refused_with_those_that_there_are(rig: Rig) -> None:
    gateway, link = rig
    command(gateway, "dance")
    names = "enable, disable, stop, quick_stop, reset, home, pause, resume, override"
    assert link.sent == [RefusedRequest("ann", f"dance: no such command; there are {names}")]


def test_a_goal_that_has_waited_too_long_does_not_begin(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    gateway, link = rig
    now = time.monotonic_ns()
    monkeypatch.setattr(time, "monotonic_ns", lambda: now)
    for name in ("a", "b", "c", "d"):
        goal(gateway, name)
    now += round(0.9 * PATIENCE * 1e9)
    gateway._hear(packets.message(Accepted(1, "a", 1.0, 1.0, False, False)), lambda: None)
    now += round(0.2 * PATIENCE * 1e9)
    gateway._hear(packets.message(Accepted(2, "b", 1.0, 1.0, False, False)), lambda: None)
    passed = [(request.id, request.withdrawn) for request in link.sent if isinstance(request, GoalRequest)]
    assert [name for name, _ in passed] == ["a", "b", "c", "d"]
    assert [withdrawn for _, withdrawn in passed[:3]] == [None] * 3
    assert passed[3][1] == "too many goals before it: it has waited longer than 8 s"


def test_many_commands_are_refused_but_never_a_stop(rig: Rig) -> None:
    gateway, link = rig
    for _ in range(UNDER_WAY + 3):
        command(gateway, "resume")
    for name in ("stop", "quick_stop", "disable", "pause"):
        command(gateway, name)
    passed = [request.name for request in link.sent if isinstance(request, CommandRequest)]
    assert passed == ["resume"] * UNDER_WAY + ["stop", "quick_stop", "disable", "pause"]
    gateway._hear(packets.message(Confirmed(1, Command.RESUME, "holding")), lambda: None)
    for ticket in (UNDER_WAY + 1, UNDER_WAY + 2, UNDER_WAY + 3, UNDER_WAY + 4):
        gateway._hear(packets.message(Confirmed(ticket, Command.STOP, "holding")), lambda: None)
    command(gateway, "reset")
    last = link.sent[-1]
    assert isinstance(last, CommandRequest)
    assert last.name == "reset"


def test_an_error_of_its_own_is_told_and_does_not_end_it(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    gateway, link = rig

    def broken(*_: object) -> None:
        raise KeyError("\x1b[2J")

    with monkeypatch.context() as patched:
        patched.setattr(boundary, "decode", broken)
        goal(gateway, "a")
        command(gateway, "stop")
    gateway._hear(b"\x02not a message", lambda: None)
    told = [request.message for request in link.sent if isinstance(request, RefusedRequest)]
    assert [text[:14] for text in told] == ["internal error", "internal error", "the gateway co"]
    goal(gateway, "b")
    assert isinstance(link.sent[-1], GoalRequest)


STUCK = """
import sys, threading, zenoh
from trirail.wire.zenoh_session import open_client
session = open_client(sys.argv[1])
never = threading.Event()
stuck = zenoh.handlers.Callback(lambda reply: never.wait(), indirect=False)
for _ in range(3000):
    session.get("trirail/demo/info", stuck, timeout=60.0)
print("asked", flush=True)
never.wait()
"""


def test_an_asker_that_takes_no_answer_holds_up_nobody_else(rig: Rig, tmp_path: Path) -> None:
    gateway, _ = rig
    gateway._inbox.declare()
    locator = f"unixsock-stream/{tmp_path}/z"
    over = threading.Event()

    def serve() -> None:
        while not over.wait(0.001):
            for incoming in gateway._inbox.take(1000):
                gateway._handle(incoming)

    serving = threading.Thread(target=serve)
    serving.start()
    with (
        zenoh_session.open_client(locator) as other,
        subprocess.Popen([sys.executable, "-c", STUCK, locator], stdout=subprocess.PIPE) as asker,
    ):
        try:
            assert asker.stdout is not None
            assert asker.stdout.readline() == b"asked\n"
            for _ in range(5):
                (reply,) = other.get("trirail/demo/cmd/ann/dance", timeout=20.0)
                assert reply.err is not None
                assert "no such command" in reply.err.payload.to_string()
            assert gateway._replies.waiting > 100  # so many were not even tried meanwhile
        finally:
            asker.kill()
            over.set()
            serving.join()


def test_info_tells_what_the_drives_do_without(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop says so in its welcome, before anybody can ask."""
    gateway, _ = rig
    said: list[object] = []
    monkeypatch.setattr(gateway._replies, "send", lambda _incoming, content: said.append(content))
    missing = (MissingProtection("A", "1006", "its watch on SYNC"), MissingProtection("C", "6007", "its stop"))
    gateway._hear(packets.message(Welcome((), 0.5, 0.0, missing)), lambda: None)
    gateway._handle(Incoming("info", "trirail/demo/info", 0, b"", "", None))
    (info,) = said
    assert isinstance(info, Info)
    assert info.missing_protections == missing
