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
from control_rig import CONFIG, carried
from trirail.processes.gateway import Gateway
from trirail.processes.incoming import GOAL_PATIENCE, GOALS_OF_ONE, Incoming, Kind
from trirail.processes.replies import REFUSALS_PER_SECOND
from trirail.processes.requests import AHEAD, AHEAD_OF_ALL, UNDER_WAY
from trirail.processes.session_guard import Guard
from trirail.wire import boundary, packets, zenoh_session
from trirail.wire.links import Closed
from trirail.wire.messages import Event
from trirail.wire.packets import (
    Accepted,
    CommandRequest,
    Confirmed,
    Farewell,
    GoalRequest,
    Happened,
    RefusedRequest,
    Request,
    Status,
    Welcome,
)
from trirail.wire.state import Info
from trirail.wire.vocabulary import AcquireLease, Command, Role
from trirail_drivers.interface import MissingProtection


class FakeLink:
    """Keeps what the gateway sends to the loop."""

    def __init__(self) -> None:
        self.sent: list[Request] = []

    def send(self, packet: bytes) -> bool:
        self.sent.append(packets.decode_request(packet[1:]))
        return True


Rig = tuple[Gateway, FakeLink]
EVERYBODYS_STOPS = (Command.STOP, Command.QUICK_STOP, Command.DISABLE)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    link = FakeLink()
    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/z"]) as opened:
        yield Gateway(CONFIG, link, lambda: None, opened, Guard(CONFIG)), link  # type: ignore[arg-type]


def came(kind: Kind, key: str, content: bytes, number: int = 0) -> Incoming:
    return Incoming(kind, key, len(content), content, "", None, time.monotonic_ns(), number)


def goal(gateway: Gateway, name: str, user: str = "ann", number: int = 0) -> None:
    content = json.dumps({"kind": "pose", "x": 0, "y": 0, "phi": 0, "id": name}).encode()
    gateway._handle(came("goal", f"trirail/demo/goal/{user}", content, number))


def test_what_has_waited_is_as_old_as_its_arrival_and_a_targets_age_is_that_of_then(rig: Rig) -> None:
    gateway, link = rig
    content = json.dumps({"kind": "track", "x": 0, "y": 0, "phi": 0, "time": time.time() - 2.1}).encode()
    arrived = time.monotonic_ns() - 2_000_000_000
    gateway._handle(came("goal", "trirail/demo/goal/ann", content)._replace(arrived_ns=arrived))
    (sent,) = link.sent
    assert isinstance(sent, GoalRequest)
    assert sent.received_ns == arrived
    assert 0.05 < sent.age < 2.0


def command(gateway: Gateway, name: str, content: bytes = b"", user: str = "ann", number: int = 0) -> None:
    gateway._handle(came("cmd", f"trirail/demo/cmd/{user}/{name}", content, number))


def passed(link: FakeLink) -> list[tuple[str, str | None]]:
    """The goals that the loop was given, and why they are not to begin."""
    return [(request.id, request.withdrawn) for request in link.sent if isinstance(request, GoalRequest)]


def accepted(gateway: Gateway, ticket: int) -> None:
    gateway._hear(packets.message(Accepted(ticket, "g", 1.0, 1.0, False, False)), lambda: None)


@pytest.mark.parametrize("name", Command)
def test_every_command_is_passed_on(rig: Rig, name: Command) -> None:
    gateway, link = rig
    command(gateway, name, boundary.encode(carried(name)))
    assert link.sent == [CommandRequest(1, "ann", name, carried(name))]


@pytest.mark.parametrize("name", Command)
def test_what_a_command_does_not_take_is_refused_with_what_it_takes(rig: Rig, name: Command) -> None:
    gateway, link = rig
    command(gateway, name, b'{"odd": 1}')
    *carried_out, said = link.sent
    assert [one.name for one in carried_out if isinstance(one, CommandRequest)] == [name] * (name in EVERYBODYS_STOPS)
    assert isinstance(said, RefusedRequest)
    assert said.message.startswith(f"{name} takes {name.content.words}: ")


def test_a_command_that_there_is_not_is_refused_with_those_that_there_are(rig: Rig) -> None:
    gateway, link = rig
    command(gateway, "dance")
    assert link.sent == [RefusedRequest("ann", f"dance: no such command; there are {', '.join(Command)}")]


def test_a_goal_that_has_waited_too_long_does_not_begin(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    gateway, link = rig
    now = time.monotonic_ns()
    monkeypatch.setattr(time, "monotonic_ns", lambda: now)
    for name in ("a", "b", "c", "d", "e"):
        goal(gateway, name)
    now += round(0.9 * GOAL_PATIENCE * 1e9)
    gateway._hear(packets.message(Accepted(1, "a", 1.0, 1.0, False, False)), lambda: None)
    now += round(0.2 * GOAL_PATIENCE * 1e9)
    gateway._hear(packets.message(Accepted(2, "b", 1.0, 1.0, False, False)), lambda: None)
    passed = [(request.id, request.withdrawn) for request in link.sent if isinstance(request, GoalRequest)]
    assert [name for name, _ in passed] == ["a", "b", "c", "d", "e"]
    assert [withdrawn for _, withdrawn in passed[:4]] == [None] * 4
    assert passed[4][1] == "too many goals before it: it has waited longer than 8 s"


def test_many_commands_are_refused_but_never_a_stop(rig: Rig) -> None:
    gateway, link = rig
    for _ in range(UNDER_WAY + 3):
        command(gateway, "resume")
    for name in ("stop", "quick_stop", "disable", "pause"):
        command(gateway, name)
    passed = [request.name for request in link.sent if isinstance(request, CommandRequest)]
    assert passed == ["resume"] * UNDER_WAY + ["stop", "quick_stop", "disable", "pause"]
    gateway._hear(packets.message(Confirmed(1, Command.RESUME, "holding", 1)), lambda: None)
    for ticket in (UNDER_WAY + 1, UNDER_WAY + 2, UNDER_WAY + 3, UNDER_WAY + 4):
        gateway._hear(packets.message(Confirmed(ticket, Command.STOP, "holding", 1)), lambda: None)
    command(gateway, "reset")
    last = link.sent[-1]
    assert isinstance(last, CommandRequest)
    assert last.name == "reset"


def test_users_take_turns_at_the_loop(rig: Rig) -> None:
    gateway, link = rig
    for number in range(4):
        goal(gateway, f"e{number}", "eve")
    goal(gateway, "a", "ann")
    assert [name for name, _ in passed(link)] == ["e0", "e1", "e2", "a"]  # three of each at most
    accepted(gateway, 1)
    assert [name for name, _ in passed(link)] == ["e0", "e1", "e2", "a", "e3"]


def test_what_the_loop_has_at_once_is_bounded_for_all_users_together(rig: Rig) -> None:
    gateway, link = rig
    for number in range(40):
        goal(gateway, f"g{number}", f"u{number % 20}")
    assert len(passed(link)) == AHEAD_OF_ALL
    for ticket in range(1, 41):
        accepted(gateway, ticket)
    assert sorted(name for name, _ in passed(link)) == sorted(f"g{number}" for number in range(40))


def test_goals_of_one_who_floods_are_refused_and_nobody_elses(rig: Rig) -> None:
    gateway, link = rig
    for number in range(AHEAD + GOALS_OF_ONE + 3):
        goal(gateway, f"e{number}", "eve")
    goal(gateway, "a", "ann")
    refused = [said for said in link.sent if isinstance(said, RefusedRequest)]
    assert refused == [RefusedRequest("eve", f"{GOALS_OF_ONE} goals of eve are waiting already: send fewer")] * 3
    assert passed(link)[-1] == ("a", None)


def test_a_stop_that_overtook_goals_withdraws_them_and_none_that_came_later(rig: Rig) -> None:
    gateway, link = rig
    command(gateway, "stop", number=5)
    for number, user in ((3, "ann"), (4, "bob"), (6, "ann"), (7, "eve")):
        goal(gateway, f"g{number}", user, number)
    assert passed(link) == [("g3", "stop by ann"), ("g4", "stop by ann"), ("g6", None), ("g7", None)]


def test_what_waits_for_the_loop_does_not_begin_under_anothers_lease(rig: Rig) -> None:
    gateway, link = rig
    for number in range(AHEAD + 1):
        goal(gateway, f"a{number}", "ann")
        goal(gateway, f"b{number}", "bob")
    event = Event("lease", "info", "lease acquired by bob", user="bob", seq=1, t=0.0, cycle=1, time=0.0)
    gateway._hear(packets.message(Happened(event)), lambda: None)
    for ticket in range(1, 2 * AHEAD + 1):
        accepted(gateway, ticket)
    assert passed(link)[2 * AHEAD :] == [(f"a{AHEAD}", "lease acquired by bob"), (f"b{AHEAD}", None)]


@pytest.mark.parametrize(("holder", "withdrawn"), [(None, True), ("ann", True), ("bob", False)])
def test_goals_that_wait_are_withdrawn_by_a_pause_of_who_may(rig: Rig, holder: str | None, withdrawn: bool) -> None:
    gateway, link = rig
    gateway._hear(packets.message(Status(None, 1.0, None, lease=holder)), lambda: None)
    for number in range(AHEAD + 1):
        goal(gateway, f"b{number}", "bob", number)
    command(gateway, "pause", number=AHEAD + 1)
    accepted(gateway, 1)
    assert passed(link)[-1] == (f"b{AHEAD}", "pause by ann" if withdrawn else None)


def test_commands_of_one_are_bounded_and_leave_the_others_theirs(rig: Rig) -> None:
    gateway, link = rig
    for _ in range(UNDER_WAY + 1):
        command(gateway, "resume", user="eve")
    command(gateway, "resume", user="ann")
    users = [request.user for request in link.sent if isinstance(request, CommandRequest)]
    assert users == ["eve"] * UNDER_WAY + ["ann"]


def test_what_is_refused_of_one_who_floods_leaves_room_to_tell_of_the_others(rig: Rig) -> None:
    gateway, link = rig
    for _ in range(100):
        command(gateway, "dance", user="eve")
    command(gateway, "dance", user="ann")
    told = [request.user for request in link.sent if isinstance(request, RefusedRequest)]
    assert told == ["eve"] * REFUSALS_PER_SECOND + ["ann"]


@pytest.mark.parametrize("role", [Role.OPERATOR, Role.MAINTAINER])
def test_the_lease_is_taken_over_by_a_role_that_may(rig: Rig, monkeypatch: pytest.MonkeyPatch, role: Role) -> None:
    gateway, link = rig
    monkeypatch.setattr(gateway._guard, "role", lambda _: role)
    command(gateway, "acquire", b'{"id": "l", "timeout": 0.5, "force": true}')
    if role is Role.MAINTAINER:
        assert link.sent == [CommandRequest(1, "ann", Command.ACQUIRE, AcquireLease("l", 0.5, force=True))]
    else:
        said = "ann is operator at demo: taking the lease over needs maintainer"
        assert link.sent == [RefusedRequest("ann", said)]


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
            for incoming in gateway._inbox.next_messages(1000):
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
            asked = 0
            while asked < 5 or gateway._replies.waiting <= 100:  # so many are not even tried meanwhile
                asked += 1
                (reply,) = other.get("trirail/demo/cmd/ann/dance", timeout=60.0)
                assert reply.err is not None
                assert "no such command" in reply.err.payload.to_string()
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
    gateway._hear(packets.message(Welcome((), 0.5, missing)), lambda: None)
    gateway._handle(came("info", "trirail/demo/info", b""))
    (info,) = said
    assert isinstance(info, Info)
    assert info.missing_protections == missing


class EndedLoop(FakeLink):
    """A loop that has said something and ended: it takes nothing any more."""

    def __init__(self, *said: bytes) -> None:
        super().__init__()
        self._said = list(said)

    def send(self, packet: bytes) -> bool:
        raise Closed

    def receive(self) -> bytes:
        if not self._said:
            raise Closed
        return self._said.pop(0)

    def fileno(self) -> int:
        return 0


def test_what_the_loop_said_before_it_ended_is_heard_though_it_takes_nothing_any_more(tmp_path: Path) -> None:
    """Else a loop that ended as it should would be told to have died."""
    accepted, ended = (packets.message(said) for said in (Accepted(1, "g", 1.0, 1.0, False, False), Farewell()))
    unreadable = bytes([packets.Kind.MESSAGE]) + b"\xc1"
    told: list[Event] = []
    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/z"]) as opened:
        link = EndedLoop(accepted, unreadable, accepted, ended)
        gateway = Gateway(CONFIG, link, lambda: None, opened, Guard(CONFIG), told.append)  # type: ignore[arg-type]
        gateway.serve(lambda: None)
    assert told == []
