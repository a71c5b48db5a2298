"""The gateway between Zenoh and the loop, without processes: what it passes on, refuses and survives."""

from __future__ import annotations

import json
import queue
import random
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh
from control_rig import CONFIG, carried
from trirail.errors import RefusalCode
from trirail.processes.gateway import Gateway
from trirail.processes.incoming import GOAL_PATIENCE, GOALS, GOALS_OF_ONE, MAX_COMMAND_WAIT, Incoming
from trirail.processes.monitoring import Meter, ServiceMeasurements
from trirail.processes.replies import REFUSALS_OF_USER
from trirail.processes.requests import MAX_COMMANDS_OF_USER, MAX_GOALS, MAX_GOALS_OF_USER, REPLY_TIMEOUT_S, Requests
from trirail.processes.session_guard import Guard
from trirail.wire import boundary, packets, zenoh_session
from trirail.wire.call_mark import CallMark, new_connection
from trirail.wire.event_codes import EventCode
from trirail.wire.goals import TrajectoryGoal, TrajectoryPoint
from trirail.wire.kinds.trajectory import parts
from trirail.wire.links import LinkClosed, PacketLink
from trirail.wire.messages import CommandReply, Event, GoalReply, Notice
from trirail.wire.packets import (
    Accepted,
    Announcement,
    Answer,
    CommandDone,
    CommandRequest,
    EventReport,
    GoalRequest,
    Refused,
    Request,
    Status,
    Welcome,
)
from trirail.wire.records import DTYPE
from trirail.wire.sizes import MAX_PART
from trirail.wire.state import Info
from trirail.wire.vocabulary import AcquireLease, Command, Mode, Role, Stop
from trirail_drivers.interface import MissingProtection


class FakeLink:
    """Keeps what the gateway sends to the loop."""

    def __init__(self) -> None:
        self.sent: list[Request] = []
        self.full = False
        """Whether it takes nothing but announcements."""

    def send(self, packet: bytes) -> bool:
        request = packets.decode_request(packet[1:])
        if self.full and not isinstance(request, Announcement):
            return False
        self.sent.append(request)
        return True


class Rig:
    """A gateway, what reaches it, and what it sends to the loop."""

    def __init__(self, opened: zenoh.Session) -> None:
        self.link = FakeLink()
        self.ready: list[int] = []
        """Cycle of the record with which the gateway began to serve clients."""
        self.gateway = Gateway(CONFIG, self.link, lambda: None, opened, Guard(CONFIG))  # type: ignore[arg-type]
        self.gateway._requests._tickets = 0  # so that the first ticket is 1

    @property
    def sent(self) -> list[Request]:
        return self.link.sent

    def goal(self, name: str, user: str = "ann", number: int = 0) -> None:
        content = json.dumps({"kind": "pose", "x": 0, "y": 0, "phi": 0, "id": name}).encode()
        self.gateway._handle(came("goal", f"trirail/demo/goal/{user}", content, number))

    def command(self, name: str, content: bytes = b"", user: str = "ann", number: int = 0, waited: float = 0.0) -> None:
        incoming = came("cmd", f"trirail/demo/cmd/{user}/{name}", content, number)
        self.gateway._handle(incoming._replace(arrived_ns=incoming.arrived_ns - round(waited * 1e9)))

    def hear(self, answer: Answer) -> None:
        """The loop says something."""
        self.gateway._handle_packet(packets.message(answer), lambda: None)

    def record(self, cycle: int) -> None:
        """The loop sends a record."""
        rows = np.zeros(1, DTYPE)
        rows["cycle"] = cycle
        self.gateway._handle_packet(bytes((packets.Kind.RECORDS,)) + rows.tobytes(), lambda: self.ready.append(cycle))

    def accepted(self, ticket: int) -> None:
        self.hear(Accepted(ticket, GoalReply("g", 1.0)))

    def goals(self) -> list[tuple[str, str | None]]:
        """The goals that the loop was given, and why they are not to begin."""
        return [(request.id, request.withdrawn) for request in self.sent if isinstance(request, GoalRequest)]

    def commands(self) -> list[CommandRequest]:
        return [request for request in self.sent if isinstance(request, CommandRequest)]

    def refusals(self) -> list[Notice]:
        return [request.notice for request in self.sent if isinstance(request, Announcement)]


POSE = b'{"kind": "pose", "x": 0, "y": 0, "phi": 0}'
EVERYBODYS_STOPS = (Command.STOP, Command.QUICK_STOP, Command.DISABLE)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/z"]) as opened:
        made = Rig(opened)
        yield made
        made.gateway._replies.close()  # a thread that is still in Zenoh when the interpreter ends aborts it


def refused(user: str, words: str, code: RefusalCode) -> Notice:
    return Notice("refused", "warning", words, user=user, code=code, event_code=EventCode.REFUSED)


def came(kind: str, key: str, content: bytes, number: int = 0) -> Incoming:
    return Incoming(kind, key, len(content), content, "", None, time.monotonic_ns(), number)


def test_what_has_waited_is_as_old_as_its_arrival_and_a_targets_age_is_that_of_then(rig: Rig) -> None:
    content = json.dumps({"kind": "track", "x": 0, "y": 0, "phi": 0, "time": time.time() - 2.1}).encode()
    arrived = time.monotonic_ns() - 2_000_000_000
    rig.gateway._handle(came("goal", "trirail/demo/goal/ann", content)._replace(arrived_ns=arrived))
    (sent,) = rig.sent
    assert isinstance(sent, GoalRequest)
    assert sent.received_ns == arrived
    assert 0.05 < sent.age < 2.0


@pytest.mark.parametrize("name", Command)
def test_every_command_is_passed_on(rig: Rig, name: Command) -> None:
    rig.command(name, boundary.encode(carried(name)))
    assert rig.sent == [CommandRequest(1, "ann", name, carried(name))]


@pytest.mark.parametrize("name", Command)
@pytest.mark.parametrize("holder", [None, "ann", "bob"])
def test_a_command_that_has_waited_long_is_refused_unless_it_stops_or_renews_the_lease(
    rig: Rig, name: Command, holder: str | None
) -> None:
    rig.hear(Status(None, 1.0, None, lease=holder))
    rig.command(name, boundary.encode(carried(name)), waited=MAX_COMMAND_WAIT + 0.1)
    late = name.stops or (name in (Command.ACQUIRE, Command.RELEASE) and holder == "ann")
    assert [request.name for request in rig.commands()] == [name] * late
    assert [notice.code for notice in rig.refusals()] == [RefusalCode.TIMEOUT] * (not late)


@pytest.mark.parametrize("stop", [Command.STOP, Command.DISABLE, Command.QUICK_STOP, Command.PAUSE])
@pytest.mark.parametrize("name", Command)
def test_a_command_that_starts_something_is_not_carried_out_behind_a_later_stop(
    rig: Rig, name: Command, stop: Command
) -> None:
    rig.command(stop, user="bob", number=5)
    for number in (4, 6):
        rig.command(name, boundary.encode(carried(name)), number=number)
    refused_one = name in (Command.ENABLE, Command.HOME, Command.RESUME, Command.RESET)
    assert [request.name for request in rig.commands()] == [stop, *[name] * (2 - refused_one)]
    assert [notice.code for notice in rig.refusals()] == [RefusalCode.STOPPED] * refused_one


def test_a_stop_of_one_goal_overtakes_no_other_command(rig: Rig) -> None:
    rig.command("stop", b'{"goal": "g"}', user="bob", number=5)
    rig.command("enable", number=4)
    assert [request.name for request in rig.commands()] == ["stop", "enable"]


@pytest.mark.parametrize("kind", ["teach", "forget"])
def test_poses_are_neither_taught_late_nor_under_anothers_lease(rig: Rig, kind: str) -> None:
    incoming = came(kind, f"trirail/demo/{kind}/ann/pick", b"")
    rig.gateway._handle(incoming._replace(arrived_ns=incoming.arrived_ns - round((MAX_COMMAND_WAIT + 0.1) * 1e9)))
    rig.hear(Status(None, 1.0, None, lease="bob"))
    rig.gateway._handle(came(kind, f"trirail/demo/{kind}/ann/pick", b""))
    assert [notice.code for notice in rig.refusals()] == [RefusalCode.TIMEOUT, RefusalCode.LEASED]


@pytest.mark.parametrize("name", Command)
def test_what_a_command_does_not_take_is_refused_with_what_it_takes(rig: Rig, name: Command) -> None:
    rig.command(name, b'{"odd": 1}')
    *carried_out, said = rig.sent
    assert [one.name for one in carried_out if isinstance(one, CommandRequest)] == [name] * (name in EVERYBODYS_STOPS)
    assert isinstance(said, Announcement)
    assert said.notice.message.startswith(f"{name} accepts {name.content.words}: ")


def test_a_command_that_there_is_not_is_refused_with_those_that_there_are(rig: Rig) -> None:
    rig.command("dance")
    there_are = f"unknown command dance: use one of {', '.join(Command)}"
    assert rig.sent == [Announcement(refused("ann", there_are, RefusalCode.UNKNOWN_COMMAND))]


def test_a_goal_that_has_waited_too_long_does_not_begin(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    now = time.monotonic_ns()
    monkeypatch.setattr(time, "monotonic_ns", lambda: now)
    for name in ("a", "b", "c", "d", "e"):
        rig.goal(name)
    now += round(0.9 * GOAL_PATIENCE * 1e9)
    rig.accepted(1)
    now += round(0.2 * GOAL_PATIENCE * 1e9)
    rig.accepted(2)
    passed = rig.goals()
    assert [name for name, _ in passed] == ["a", "b", "c", "d", "e"]
    assert [withdrawn for _, withdrawn in passed[:4]] == [None] * 4
    assert (
        passed[4][1]
        == "the goal waited longer than 8 s for earlier goals or because the machine was busy: send the goal again"
    )


def test_many_commands_are_refused_but_never_a_stop(rig: Rig) -> None:
    for _ in range(MAX_COMMANDS_OF_USER + 3):
        rig.command("resume")
    for name in ("stop", "quick_stop", "disable", "pause"):
        rig.command(name)
    passed = [request.name for request in rig.commands()]
    assert passed == ["resume"] * MAX_COMMANDS_OF_USER + ["stop", "quick_stop", "disable", "pause"]
    rig.hear(CommandDone(1, Command.RESUME, "holding", 1))
    for ticket in (
        MAX_COMMANDS_OF_USER + 1,
        MAX_COMMANDS_OF_USER + 2,
        MAX_COMMANDS_OF_USER + 3,
        MAX_COMMANDS_OF_USER + 4,
    ):
        rig.hear(CommandDone(ticket, Command.STOP, "holding", 1))
    rig.command("reset")
    assert rig.commands()[-1].name == "reset"


def test_users_take_turns_at_the_loop(rig: Rig) -> None:
    for number in range(4):
        rig.goal(f"e{number}", "eve")
    rig.goal("a", "ann")
    assert [name for name, _ in rig.goals()] == ["e0", "e1", "e2", "a"]  # three of each at most
    rig.accepted(1)
    assert [name for name, _ in rig.goals()] == ["e0", "e1", "e2", "a", "e3"]


def test_what_the_loop_has_at_once_is_bounded_for_all_users_together(rig: Rig) -> None:
    for number in range(40):
        rig.goal(f"g{number}", f"u{number % 20}")
    assert len(rig.goals()) == MAX_GOALS
    for ticket in range(1, 41):
        rig.accepted(ticket)
    assert sorted(name for name, _ in rig.goals()) == sorted(f"g{number}" for number in range(40))


def test_stops_that_are_read_late_withdraw_what_came_before_them_alone(rig: Rig) -> None:
    """A stop of a user who sends too many waits, and others overtake it."""
    for number in range(4, 5 + MAX_GOALS_OF_USER):
        rig.goal(f"g{number}", number=number)
    late = f"g{4 + MAX_GOALS_OF_USER}"
    rig.command("stop", user="bob", number=3)
    rig.accepted(1)
    assert rig.goals()[-1] == (late, None)
    rig.command("stop", number=20)
    rig.command("stop", user="bob", number=10)
    rig.goal("between", "eve", number=15)
    assert rig.goals()[-1] == ("between", "stop by ann")


def test_a_restarted_gateway_uses_no_ticket_of_the_one_before(rig: Rig) -> None:
    """The loop may still answer the requests of that one."""
    gateway, incoming = rig.gateway, came("cmd", "trirail/demo/cmd/ann/resume", b"")
    tickets = []
    for _ in range(2):
        parts = gateway._guard, gateway._replies, gateway._loop_death, nullcontext
        requests = Requests(CONFIG, rig.link, *parts)  # type: ignore[arg-type]
        tickets += [requests.command(incoming, "ann", Command.RESUME, None) for _ in range(3)]
    assert tickets == sorted(set(tickets))


def test_a_stop_of_the_service_itself_withdraws_what_waits(rig: Rig) -> None:
    for number in range(MAX_GOALS_OF_USER + 1):
        rig.goal(f"a{number}")
    assert rig.gateway._requests.stop("demo")
    assert [(request.name, request.user) for request in rig.commands()] == [(Command.STOP, "demo")]
    rig.accepted(1)
    assert rig.goals()[-1] == (f"a{MAX_GOALS_OF_USER}", "stop by demo")


def test_goals_wait_while_the_loop_has_no_room(rig: Rig) -> None:
    rig.link.full = True
    for name in ("a0", "a1"):
        rig.goal(name)
    assert rig.goals() == []
    rig.link.full = False
    for _ in range(2):  # one of each user at a time
        rig.gateway._requests.send_goals()
    assert rig.goals() == [("a0", None), ("a1", None)]


@pytest.mark.parametrize("name", ["resume", "stop"])
def test_a_command_for_which_the_loop_has_no_room_is_refused(rig: Rig, name: str) -> None:
    rig.link.full = True
    for _ in range(MAX_COMMANDS_OF_USER):
        rig.command(name)
    words = "the queue of requests to the loop is full: send the request again"
    assert rig.refusals() == [refused("ann", words, RefusalCode.BUSY)] * MAX_COMMANDS_OF_USER
    rig.link.full = False
    rig.command(name)  # those that were refused are not in progress
    assert [request.name for request in rig.commands()] == [name]


def test_goals_of_one_who_floods_are_refused_and_nobody_elses(rig: Rig) -> None:
    for number in range(MAX_GOALS_OF_USER + GOALS_OF_ONE + 3):
        rig.goal(f"e{number}", "eve")
    rig.goal("a", "ann")
    words = f"{GOALS_OF_ONE} goals of eve are already waiting, which is the maximum: send fewer goals"
    assert rig.refusals() == [refused("eve", words, RefusalCode.BUSY)] * 3
    assert rig.goals()[-1] == ("a", None)


def test_a_stop_that_overtook_goals_withdraws_them_and_none_that_came_later(rig: Rig) -> None:
    rig.command("stop", number=5)
    for number, user in ((3, "ann"), (4, "bob"), (6, "ann"), (7, "eve")):
        rig.goal(f"g{number}", user, number)
    assert rig.goals() == [("g3", "stop by ann"), ("g4", "stop by ann"), ("g6", None), ("g7", None)]


@pytest.mark.generated(*range(8))
def test_what_was_called_for_before_a_stop_of_its_connection_is_not_carried_out_after_it(rig: Rig, seed: int) -> None:
    chance = random.Random(seed)
    connections, stopped = [new_connection() for _ in range(3)], {"": 0}
    for number in range(1, 60):
        mark = CallMark(chance.choice(connections), chance.randrange(1, 1000))
        is_marked, name = chance.random() < 0.8, chance.choice(["goal", "enable", "resume", "stop", "pause", "one"])
        content = b'{"goal": "other"}' if name == "one" else b""
        if name == "goal":
            content = json.dumps({"kind": "pose", "x": 0, "y": 0, "phi": 0, "id": f"g{number}"}).encode()
        kind, key = ("goal", "goal/ann") if name == "goal" else ("cmd", f"cmd/ann/{'stop' if name == 'one' else name}")
        answers: list[object] = []
        incoming = came(kind, f"trirail/demo/{key}", content, number)
        rig.gateway._handle(incoming._replace(at_door=answers.append, mark=mark if is_marked else None))
        for ticket in list(rig.gateway._requests._pending):
            rig.gateway._requests.answer(ticket, GoalReply("g", 1.0))
        if name in ("stop", "pause") and is_marked:
            stopped[mark.connection] = max(mark.called_ns, stopped.get(mark.connection, 0))
        overtaken = is_marked and mark.called_ns < stopped.get(mark.connection, 0)
        if name == "goal":
            assert (rig.goals()[-1][1] is not None) == overtaken
        elif name in ("enable", "resume"):
            assert [getattr(answer, "code", None) for answer in answers] == [RefusalCode.STOPPED if overtaken else None]


@pytest.mark.parametrize(
    ("stop", "user", "content", "ends"),
    [
        ("stop", "eva", b"", True),
        ("quick_stop", "ann", b"", True),
        ("disable", "eva", b"", True),
        ("pause", "ann", b"", False),
        ("stop", "eva", b'{"goal": "other"}', False),
    ],
)
@pytest.mark.parametrize("late", [False, True])
def test_a_call_that_sends_goals_later_ends_with_a_stop_of_any_user(
    rig: Rig, stop: str, user: str, content: bytes, ends: bool, late: bool
) -> None:
    """As an alignment does, whose robot may rest when the stop comes. `late`: the gateway reads the stop last."""
    mark, other = CallMark(new_connection(), 5), CallMark(new_connection(), 3)
    rig.gateway._handle(came("role", "trirail/demo/role/ann", b"", 1)._replace(mark=mark))
    if not late:
        rig.command(stop, content, user, number=3)
    rig.gateway._handle(came("role", "trirail/demo/role/ann", b"", 4)._replace(mark=mark))
    if late:
        rig.command(stop, content, user, number=3)
    begun = came("goal", "trirail/demo/goal/ann", POSE, 5)
    for each in (mark, other, mark._replace(called_ns=6)):
        rig.gateway._handle(begun._replace(mark=each))
    reason = f"{stop} by {user}" if ends else None
    assert [withdrawn for _, withdrawn in rig.goals()] == [reason, None, None]


def test_the_first_state_follows_when_requests_can_be_received(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    monkeypatch.setattr(rig.gateway._inbox, "declare", lambda: order.append("requests"))
    monkeypatch.setattr(rig.gateway._publications, "state", lambda state: order.append("state"))
    monkeypatch.setattr(rig.gateway, "_welcomed", True)
    for cycle in (1, 2):
        rig.record(cycle)
        rig.gateway._state_due = 0.0
    assert order == ["requests", "state"]


def test_stops_that_were_merged_and_read_late_end_calls(rig: Rig) -> None:
    announced, merged = CallMark(new_connection(), 5), CallMark(new_connection(), 5)
    rig.gateway._handle(came("role", "trirail/demo/role/ann", b"", 5)._replace(mark=announced))
    alike = came("cmd", "trirail/demo/cmd/ann/stop", b"", 10)._replace(mark=merged)
    rig.gateway._handle(came("cmd", "trirail/demo/cmd/ann/stop", b"", 9)._replace(alike=(alike,)))
    rig.command("stop", number=3)
    for mark in (announced, merged._replace(called_ns=4), merged._replace(called_ns=6)):
        rig.gateway._handle(came("goal", "trirail/demo/goal/ann", POSE, 11)._replace(mark=mark))
    assert [withdrawn for _, withdrawn in rig.goals()] == ["stop by ann", "stop by ann", None]


def test_what_was_called_at_the_time_of_a_stop_is_carried_out(rig: Rig) -> None:
    """A call may stop the robot first, and then move it."""
    mark = CallMark(new_connection(), 5)
    rig.gateway._handle(came("cmd", "trirail/demo/cmd/ann/stop", b"", 1)._replace(mark=mark))
    rig.gateway._handle(came("goal", "trirail/demo/goal/ann", POSE, 2)._replace(mark=mark))
    assert [withdrawn for _, withdrawn in rig.goals()] == [None]


def test_calls_are_remembered_up_to_a_limit(rig: Rig) -> None:
    backlog = rig.gateway._requests.backlog
    for number in range(GOALS + 5):
        stop = came("cmd", "trirail/demo/cmd/ann/stop", b"", number)._replace(mark=CallMark(f"{number:012x}", number))
        backlog.note_call(stop)
        backlog.withdraw_all("stop by ann", stop, ends_calls=True)
    assert len(backlog._calls) == len(backlog._stop_calls) == GOALS


@pytest.mark.parametrize("under_way", [True, False])
def test_a_stop_of_a_goal_that_waits_reaches_the_loop_which_may_have_another_of_its_id(
    rig: Rig, under_way: bool
) -> None:
    rig.gateway._states.records(np.zeros(1, DTYPE))
    for number, name in enumerate(["a", *"bcdefgh"[:MAX_GOALS_OF_USER], "a"]):
        rig.goal(name, number=number)
    answers: list[object] = []
    stop = came("cmd", "trirail/demo/cmd/ann/stop", b'{"goal": "a"}', 100)
    rig.gateway._handle(stop._replace(at_door=answers.append))
    (sent,) = rig.commands()
    no = Refused(sent.ticket, RefusalCode.NO_GOAL, "not in progress")
    rig.hear(CommandDone(sent.ticket, Command.STOP, Mode.HOLDING, 0) if under_way else no)
    assert [type(answer) for answer in answers] == [CommandReply]
    for ticket in (1, 2):
        rig.accepted(ticket)
    assert rig.goals()[-1] == ("a", "stop by ann")


def test_a_goal_that_the_loop_does_not_have_is_stopped_without_it(rig: Rig) -> None:
    rig.gateway._states.records(np.zeros(1, DTYPE))
    *_, last = names = [*"abcdefgh"[: MAX_GOALS_OF_USER + 1]]
    for name in names:
        rig.goal(name)
    answers: list[object] = []
    stop = came("cmd", "trirail/demo/cmd/ann/stop", b'{"goal": "%b"}' % last.encode())
    rig.gateway._handle(stop._replace(at_door=answers.append))
    assert [type(answer) for answer in answers] == [CommandReply]
    assert rig.commands() == []
    rig.accepted(1)
    assert rig.goals()[-1] == (last, "stop by ann")


@pytest.mark.parametrize("content", [b"", b'{"goal": "g"}'])
def test_a_stop_that_overtook_a_part_of_a_trajectory_withdraws_the_whole(rig: Rig, content: bytes) -> None:
    points = tuple(TrajectoryPoint(0.1 * n, 0.0, 0.0, 0.0) for n in range(MAX_PART + 1))
    first, last = map(msgspec.json.encode, parts(TrajectoryGoal(points, "g")))
    rig.gateway._handle(came("goal", "trirail/demo/goal/ann", first, 1))
    answers: list[object] = []
    stop = came("cmd", "trirail/demo/cmd/ann/stop", content, 2)
    rig.gateway._handle(stop._replace(at_door=answers.append))
    (sent,) = rig.commands()
    no = Refused(sent.ticket, RefusalCode.NO_GOAL, "not in progress")
    rig.gateway._states.records(np.zeros(1, DTYPE))
    rig.hear(no if content else CommandDone(sent.ticket, Command.STOP, Mode.HOLDING, 0))
    assert [type(answer) for answer in answers] == [CommandReply]
    rig.gateway._handle(came("goal", "trirail/demo/goal/ann", last, 3))
    assert rig.goals() == [("g", "stop by ann")]


def test_what_waits_for_the_loop_does_not_begin_under_anothers_lease(rig: Rig) -> None:
    for number in range(MAX_GOALS_OF_USER + 1):
        rig.goal(f"a{number}", "ann")
        rig.goal(f"b{number}", "bob")
    event = Event("lease", "info", "lease acquired by bob", user="bob", seq=1, t=0.0, cycle=1, time=0.0)
    rig.hear(EventReport(event))
    for ticket in range(1, 2 * MAX_GOALS_OF_USER + 1):
        rig.accepted(ticket)
    assert rig.goals()[2 * MAX_GOALS_OF_USER :] == [
        (f"a{MAX_GOALS_OF_USER}", "lease acquired by bob"),
        (f"b{MAX_GOALS_OF_USER}", None),
    ]


def test_a_published_event_has_the_identity_of_the_run(tmp_path: Path) -> None:
    received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    event = Event("service", "info", "x", seq=1, t=0.0, cycle=1, time=0.0)
    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/z"]) as opened:
        gateway = Gateway(CONFIG, FakeLink(), lambda: None, opened, Guard(CONFIG), run="r")  # type: ignore[arg-type]
        with opened.declare_subscriber("trirail/demo/event", lambda sample: received.put(sample.payload.to_bytes())):
            gateway._handle_packet(packets.message(EventReport(event)), lambda: None)
            assert json.loads(received.get(timeout=20.0))["run"] == "r"
        gateway._replies.close()


@pytest.mark.parametrize(("holder", "withdrawn"), [(None, True), ("ann", True), ("bob", False)])
def test_goals_that_wait_are_withdrawn_by_a_pause_of_who_may(rig: Rig, holder: str | None, withdrawn: bool) -> None:
    rig.hear(Status(None, 1.0, None, lease=holder))
    for number in range(MAX_GOALS_OF_USER + 1):
        rig.goal(f"b{number}", "bob", number)
    rig.command("pause", number=MAX_GOALS_OF_USER + 1)
    rig.accepted(1)
    assert rig.goals()[-1] == (f"b{MAX_GOALS_OF_USER}", "pause by ann" if withdrawn else None)


def test_commands_of_one_are_bounded_and_leave_the_others_theirs(rig: Rig) -> None:
    for _ in range(MAX_COMMANDS_OF_USER + 1):
        rig.command("resume", user="eve")
    rig.command("resume", user="ann")
    users = [request.user for request in rig.commands()]
    assert users == ["eve"] * MAX_COMMANDS_OF_USER + ["ann"]


def test_commands_of_others_do_not_end_a_lease(rig: Rig) -> None:
    for number in range(9 * MAX_COMMANDS_OF_USER):
        rig.command("resume", user=f"eve{number % 9}")
    before = len(rig.commands())
    for _ in range(2):  # the second waits for the answer to the first, as every command
        rig.command("acquire", b'{"id": "l", "timeout": 0.5}')
    assert [request.name for request in rig.commands()[before:]] == ["acquire"]
    rig.hear(CommandDone(rig.commands()[-1].ticket, Command.ACQUIRE, "holding", 1))
    rig.command("acquire", b'{"id": "l", "timeout": 0.5}')
    assert [request.name for request in rig.commands()[before:]] == ["acquire"] * 2


@pytest.mark.parametrize("kind", ["pose", "velocity", "track"])
def test_a_goal_that_is_answered_too_late_does_not_begin(rig: Rig, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """Its sender has been told that it is not carried out. A jog or track ends by its own time-out."""
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now)
    content = json.dumps({"kind": kind, "x": 0, "y": 0, "phi": 0, "id": "g"}).encode()
    rig.gateway._handle(came("goal", "trirail/demo/goal/ann", content))
    rig.gateway._requests.expire()
    assert rig.commands() == []
    now += REPLY_TIMEOUT_S + 0.1
    rig.gateway._requests.expire()
    assert [(stop.user, stop.name, stop.content) for stop in rig.commands()] == (
        [("ann", Command.STOP, Stop("g"))] if kind == "pose" else []
    )
    rig.gateway._requests.expire()
    assert len(rig.commands()) == (kind == "pose")


def test_enabling_may_take_as_long_as_is_configured(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now)
    for name in ("enable", "reset"):
        rig.command(name)
    now += REPLY_TIMEOUT_S + 0.9 * CONFIG.watchdogs.enable_timeout
    rig.gateway._requests.expire()
    assert list(rig.gateway._requests._commands) == [1]
    now += 0.2 * CONFIG.watchdogs.enable_timeout
    rig.gateway._requests.expire()
    assert not rig.gateway._requests._commands


def test_a_goal_is_accepted_with_the_run_that_reports_its_end(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    replies: list[object] = []
    monkeypatch.setattr(rig.gateway._requests, "answer", lambda _, reply: replies.append(reply))
    rig.gateway._run = "r1"
    rig.hear(Accepted(1, GoalReply("g", 1.0)))
    assert replies == [GoalReply("g", 1.0, run="r1")]


def test_what_is_refused_of_one_who_floods_leaves_room_to_tell_of_the_others(rig: Rig) -> None:
    for _ in range(100):
        rig.command("dance", user="eve")
    rig.command("dance", user="ann")
    told = [request.user for request in rig.refusals()]
    assert told == ["eve"] * REFUSALS_OF_USER + ["ann"]


@pytest.mark.parametrize("role", [Role.OPERATOR, Role.MAINTAINER])
def test_the_lease_is_taken_over_by_a_role_that_may(rig: Rig, monkeypatch: pytest.MonkeyPatch, role: Role) -> None:
    monkeypatch.setattr(rig.gateway._guard, "role", lambda _: role)
    rig.command("acquire", b'{"id": "l", "timeout": 0.5, "force": true}')
    if role is Role.MAINTAINER:
        assert rig.sent == [CommandRequest(1, "ann", Command.ACQUIRE, AcquireLease("l", 0.5, force=True))]
    else:
        said = "ann is operator at robot demo: taking over the lease needs the role maintainer"
        assert rig.sent == [Announcement(refused("ann", said, RefusalCode.NOT_ALLOWED))]


def test_an_error_of_its_own_is_told_and_does_not_end_it(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:

    def broken(*_: object) -> None:
        raise KeyError("\x1b[2J")

    with monkeypatch.context() as patched:
        patched.setattr(boundary, "decode", broken)
        rig.goal("a")
        rig.command("stop")
    rig.gateway._handle_packet(b"\x02not a message", lambda: None)
    told = [request.message for request in rig.refusals()]
    assert [text[:14] for text in told] == ["internal error", "internal error", "the gateway co"]
    rig.goal("b")
    assert isinstance(rig.sent[-1], GoalRequest)


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
    rig.gateway._inbox.declare()
    locator = f"unixsock-stream/{tmp_path}/z"
    over = threading.Event()

    def serve() -> None:
        while not over.wait(0.001):
            for incoming in rig.gateway._inbox.next_messages(1000):
                rig.gateway._handle(incoming)

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
            while asked < 5 or rig.gateway._replies.waiting <= 100:  # so many are not even tried meanwhile
                asked += 1
                (reply,) = other.get("trirail/demo/cmd/ann/dance", timeout=60.0)
                assert reply.err is not None
                assert "unknown command" in reply.err.payload.to_string()
        finally:
            asker.kill()
            over.set()
            serving.join()


def test_info_tells_what_the_drives_do_without(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop says so in its welcome, before anybody can ask."""
    said: list[object] = []
    monkeypatch.setattr(rig.gateway._replies, "send", lambda _incoming, content: said.append(content))
    missing = (MissingProtection("A", "1006", "its monitoring of SYNC"), MissingProtection("C", "6007", "its stop"))
    rig.hear(Welcome((), 0.5, missing))
    rig.gateway._handle(came("info", "trirail/demo/info", b""))
    (info,) = said
    assert isinstance(info, Info)
    assert info.missing_protections == missing


def test_info_follows_drives_that_are_set_up_later_and_nothing_is_declared_twice(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[object] = []
    monkeypatch.setattr(rig.gateway._replies, "send", lambda _incoming, content: said.append(content))
    missing = (MissingProtection("A", "1006", "its monitoring of SYNC"),)
    rig.hear(Welcome((), 0.5))
    rig.record(1)
    declared = list(rig.gateway._inbox._declared)
    rig.hear(Welcome((), 0.5, missing))
    rig.record(2)
    assert rig.gateway._inbox._declared == declared
    rig.gateway._handle(came("info", "trirail/demo/info", b""))
    (info,) = said
    assert isinstance(info, Info)
    assert info.missing_protections == missing


def test_clients_are_served_when_there_is_a_state_to_answer_them(rig: Rig) -> None:
    rig.hear(Welcome((), 0.5))
    assert not hasattr(rig.gateway._inbox, "_declared")
    rig.record(1)
    rig.record(2)
    assert rig.ready == [1]


def test_leases_from_before_the_gateway_withdraw_no_goals(rig: Rig) -> None:
    def lease(number: int) -> None:
        rig.hear(EventReport(Event("lease", "info", "of bob", user="bob", seq=number, t=0.1, cycle=1, time=1.0)))

    rig.hear(Welcome((), 0.5, newest_event=7))
    for number in range(MAX_GOALS_OF_USER + 2):
        rig.goal(f"g{number}")
    lease(7)
    rig.accepted(1)
    rig.gateway._requests.send_goals()
    lease(8)
    rig.accepted(2)
    rig.gateway._requests.send_goals()
    assert [withdrawn for _, withdrawn in rig.goals()] == [None] * (MAX_GOALS_OF_USER + 1) + ["of bob"]


class EndedLoop(FakeLink):
    """A loop that has said something and ended: it takes nothing any more."""

    def __init__(self, *said: bytes) -> None:
        super().__init__()
        self._said = list(said)

    def send(self, packet: bytes) -> bool:
        raise LinkClosed

    def receive(self) -> bytes:
        if not self._said:
            raise LinkClosed
        return self._said.pop(0)

    def fileno(self) -> int:
        return 0

    packets = PacketLink.packets


def test_what_the_loop_said_before_it_ended_is_heard_though_it_takes_nothing_any_more(tmp_path: Path) -> None:
    event = Notice("service", "info", "said last").event(1, 0.0, 1, 0.0)
    accepted, ended = (packets.message(said) for said in (Accepted(1, GoalReply("g", 1.0)), EventReport(event)))
    unreadable = bytes([packets.Kind.MESSAGE]) + b"\xc1"
    told: list[Event] = []
    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/z"]) as opened:
        link = EndedLoop(accepted, unreadable, accepted, ended)
        given = link, lambda: None, opened, Guard(CONFIG), told.append
        gateway = Gateway(CONFIG, *given, last_cycle=lambda: 1)  # type: ignore[arg-type]
        gateway.serve(lambda: None)
    assert told == [event]


class BusyLoop(EndedLoop):
    """A loop that sends without a pause, and accepts everything."""

    def send(self, packet: bytes) -> bool:
        return FakeLink.send(self, packet)


def test_a_stop_is_forwarded_while_the_loop_keeps_sending(tmp_path: Path) -> None:
    accepted = packets.message(Accepted(1, GoalReply("g", 1.0)))
    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/z"]) as opened:
        link = BusyLoop(*[accepted] * 1000)
        gateway = Gateway(CONFIG, link, lambda: None, opened, Guard(CONFIG))  # type: ignore[arg-type]

        def handle(_packet: bytes, _ready: object) -> None:
            if len(link._said) == 999:  # the stop arrives while packets of the loop are being handled
                gateway._inbox._put(came("cmd", "trirail/demo/cmd/ann/stop", b""))
            if len(link._said) == 500:
                assert any(isinstance(request, CommandRequest) for request in link.sent)

        gateway._handle_packet = handle  # type: ignore[assignment,method-assign]
        gateway.serve(lambda: None)
    assert not link._said


def test_monitoring_has_the_warnings_and_faults_of_the_state(rig: Rig) -> None:
    """Whoever watches /healthz alone learns why goals are refused, as `trirail status` shows it."""
    measured: list[ServiceMeasurements] = []
    rig.gateway._meter = Meter(measured.append)  # type: ignore[arg-type]
    conflict = rig.gateway._name_conflict
    conflict._tokens.add(("", "another service"))
    conflict._grace_ends = 0.0
    conflict.poll()
    lost = "nothing is recorded: the disk is full"
    rig.hear(packets.Status(None, 1.0, "drive B: EMCY", unrecorded=lost, unready=("C is absent",)))
    rig.record(1)
    state = rig.gateway._states.newest(rig.gateway.warnings())
    (newest,) = measured
    assert (newest.warnings, newest.faults) == (state.warnings, state.faults)
    assert ["same name" in newest.warnings[0], *newest.warnings[1:]] == [True, lost]
    assert newest.faults == ("drive B: EMCY", "C is absent")
