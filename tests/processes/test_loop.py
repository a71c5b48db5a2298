"""The loop's shell around the control: overruns, neighbours, and a program that is wrong."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import can
import msgspec
import pytest
from conftest import Followers, Rig, alone, what_memory_takes
from control_rig import CONFIG
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.config import Config
from trirail.errors import RefusalCode
from trirail.motion.motion_planner import MotionPlanner
from trirail.processes import ending
from trirail.processes.clock import Tick
from trirail.processes.heartbeats import Heartbeats, Watch
from trirail.processes.incoming import Incoming
from trirail.processes.loop import Loop, TimeBudget
from trirail.processes.loop_death import LoopDeath
from trirail.processes.ports import REQUESTS_A_CYCLE, Ports
from trirail.processes.reports import BATCHES_PER_SECOND, SENT_TOGETHER
from trirail.processes.requests import MAX_COMMANDS, MAX_GOALS, Requests
from trirail.processes.session_guard import Guard
from trirail.wire import links
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.goals import PoseGoal
from trirail.wire.links import LinkClosed, PacketLink, Port
from trirail.wire.messages import CommandReply, Event, GoalReply, Notice
from trirail.wire.packets import (
    Accepted,
    Announcement,
    Answer,
    Checked,
    CommandDone,
    CommandRequest,
    ControlInput,
    Disturbance,
    DrivesFault,
    EventReport,
    EventsWritten,
    GoalRequest,
    Kind,
    Refused,
    Status,
    Unrecorded,
    Welcome,
    decode_answer,
    message,
)
from trirail.wire.plan_packets import NotPlanned, PreemptingMotion, decode_plan_request, encode
from trirail.wire.records import unpack
from trirail.wire.sizes import MAX_TEXT
from trirail.wire.vocabulary import Command, FaultCause, Mode, Override
from trirail_drivers.bus.can_frame import CAPTURED
from trirail_drivers.bus.capture import Capture
from trirail_drivers.bus.frames import packed
from trirail_drivers.interface import DriveGroup, MissingProtection

NESTED = b"\x91" * 5000
"""Deeper than a decoder goes."""
UNREADABLE = (b"\xa4\xff\xfe\xfd\xfc", NESTED)
"""What a packet may have instead of a string: bytes that are not UTF-8, and lists within lists."""
COMMANDS = [bytes(message(CommandRequest(9, "ann", Command.STOP)))[1:].replace(b"\xa3ann", each) for each in UNREADABLE]
COMMANDS.append(bytes(message(CommandRequest(9, "ann", Command.STOP)))[1:-1] + NESTED)


class Shell:
    """A loop over the simulated drives, cycled by hand, with a gateway at its port."""

    def __init__(self, rig: Rig, folder: Path) -> None:
        self.rig = rig
        self.folder = folder
        names = ("gateway", "recorder", "planner")
        self.ports = Ports(*(Port(links.listen(folder / name)) for name in names))
        self.gateway: PacketLink = links.connect(folder / "gateway")
        self.recorder: PacketLink = links.connect(folder / "recorder")
        self.planner: PacketLink = links.connect(folder / "planner")
        self.motion_planner = MotionPlanner(rig.config)
        self.serves = True
        """Whether the planner answers what it is asked before the next cycle."""
        self.heartbeats = Heartbeats.create()
        self.loop = Loop(rig.config, rig.driver, self.ports, self.heartbeats, now=lambda: round(rig.now * 1e9))
        self.loop.control.start(rig.control.measured.feedback)

    def close(self) -> None:
        for each in (self.gateway, self.recorder, self.planner, *self.ports):
            each.close()

    def cycles(self, number: int, missed: int = 0) -> None:
        for _ in range(number):
            self.rig.now += self.rig.config.period
            self.rig.sent.clear()
            self.loop.cycle(Tick(round(self.rig.now * 1e9), 0, missed))
            while self.serves and (packet := self.planner.receive()) is not None:
                self.planner.send(encode(self.motion_planner.plan(decode_plan_request(packet))))

    def enabled(self) -> None:
        self.cycles(self.rig.config.loop.rate_hz // BATCHES_PER_SECOND)  # by then the gateway is accepted
        self.gateway.send(message(CommandRequest(1, "ann", Command.ENABLE)))
        self.cycles(20)
        assert self.loop.control.state.mode is Mode.HOLDING

    def mode(self) -> Mode:
        return self.loop.control.state.mode

    def received(self, by: PacketLink | None = None) -> list[bytes]:
        packets = []
        while (packet := (by or self.gateway).receive()) is not None:
            packets.append(packet)
        return packets

    def said(self, by: PacketLink | None = None) -> list[Answer]:
        """What the gateway, or another, was told since the last time, records aside."""
        return [decode_answer(packet[1:]) for packet in self.received(by) if packet[0] == Kind.MESSAGE]

    def events(self) -> list[Event]:
        return [answer.event for answer in self.said() if isinstance(answer, EventReport)]

    def send(self, ticket: int, name: str, goal: PoseGoal) -> None:
        """The gateway passes a goal of ann's on."""
        self.gateway.send(message(GoalRequest(ticket, "ann", name, goal, round(self.rig.now * 1e9))))


@pytest.fixture
def shell(rig: Rig, tmp_path: Path) -> Iterator[Shell]:
    with closing(Shell(rig, tmp_path)) as made:
        yield made


def test_every_cycle_has_its_record_and_every_event_its_number(shell: Shell) -> None:
    shell.enabled()
    shell.cycles(40)
    packets = shell.received()
    cycles = [int(c) for packet in packets if packet[0] == Kind.RECORDS for c in unpack(packet[1:])["cycle"]]
    assert cycles == list(range(cycles[0], cycles[0] + len(cycles)))
    said = [decode_answer(packet[1:]) for packet in packets if packet[0] == Kind.MESSAGE]
    assert isinstance(said[0], Welcome)
    assert [answer.event.seq for answer in said if isinstance(answer, EventReport)] == [1, 2]


@pytest.mark.parametrize("part", ["observe", "solve", "_check_arrival", "goal_queue"])
def test_a_program_that_is_wrong_stops_the_robot_in_that_cycle(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    """In whichever part of the cycle, and where it decides what comes next."""
    shell.enabled()

    def wrong(*_given: object) -> None:
        raise ZeroDivisionError("a bug")

    if part == "goal_queue":
        monkeypatch.setattr(shell.loop.control.goal_queue, "step", wrong)
    else:
        monkeypatch.setattr(shell.loop.control, part, wrong)
    shell.cycles(1)
    assert shell.loop.control.state.mode is Mode.FAULT
    assert "a bug" in (shell.loop.control.fault or "")
    quick = {frame.arbitration_id - 0x200 for frame in shell.rig.sent if frame.data and frame.data[0] & 0b110 == 0b010}
    assert {1, 2, 3} <= quick


def test_the_bus_load_is_measured(shell: Shell) -> None:
    shell.enabled()
    shell.cycles(2100)
    measured = [answer.bus_load for answer in shell.said() if isinstance(answer, Status)][-1]
    assert measured == pytest.approx(shell.rig.driver.bus_load, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize("in_motion", [False, True])
def test_a_cycle_that_changes_nothing_takes_no_memory(shell: Shell, in_motion: bool) -> None:
    """With a gateway that gives signs of life, and records that go to it and to the recorder."""
    shell.enabled()
    if in_motion:
        shell.send(2, "g-1", PoseGoal(0.1, 0.02, 0.1, speed=0.02))
        beating(shell, 50)
    drives = Followers(shell.loop.control.measured.feedback)
    shell.loop._drives = shell.loop.control._drives = cast(DriveGroup, drives)
    heart, tick = shell.heartbeats.heart("gateway"), Tick(round(shell.rig.now * 1e9), 0, 0)

    def cycle() -> None:
        heart.beat()
        shell.loop.cycle(tick)

    def takes_none() -> None:
        grown, in_use = what_memory_takes(cycle, 500)
        assert shell.mode() is (Mode.MOVING if in_motion else Mode.HOLDING)
        assert grown <= 256
        assert in_use <= 4096

    alone(takes_none)


def test_missed_ticks_are_counted(shell: Shell) -> None:
    shell.enabled()
    shell.cycles(1, missed=3)
    shell.cycles(20)
    rows = [unpack(packet[1:]) for packet in shell.received() if packet[0] == Kind.RECORDS]
    assert int(rows[-1]["overruns"][-1]) == 3


def test_a_gateway_that_comes_anew_is_told_everything(shell: Shell, tmp_path: Path) -> None:
    shell.enabled()
    shell.gateway.close()  # with all that it had not read
    shell.cycles(30)
    shell.gateway = links.connect(tmp_path / "gateway")
    shell.cycles(30)
    said = shell.said()
    assert isinstance(said[0], Welcome)
    events = [answer.event for answer in said if isinstance(answer, EventReport)]
    assert [event.mode for event in events] == ["enabling", "holding"]
    assert said[0].newest_event == events[-1].seq


def test_a_lost_gateway_is_noticed(shell: Shell) -> None:
    shell.enabled()
    shell.gateway.close()
    shell.cycles(1)
    assert not shell.ports[0].connected
    shell.cycles(5)
    assert shell.loop.control.state.mode is Mode.HOLDING  # it stood: nothing to stop


def beating(shell: Shell, cycles: int) -> None:
    """Cycles of a loop whose gateway gives its signs of life."""
    for _ in range(cycles // 50):
        shell.heartbeats.heart("gateway").beat()
        shell.cycles(50)


def moving(shell: Shell) -> None:
    shell.enabled()
    shell.send(2, "g-1", PoseGoal(0.08, 0.02, 0.2, speed=0.2))
    beating(shell, 150)
    assert shell.mode() is Mode.MOVING


def test_a_frozen_gateway_is_a_controlled_stop_that_says_so(shell: Shell) -> None:
    moving(shell)
    shell.cycles(249)
    assert shell.mode() is Mode.MOVING  # 0.3 s are not over
    shell.cycles(3)
    assert shell.mode() is Mode.STOPPING
    shell.cycles(1000)
    assert shell.mode() is Mode.HOLDING
    events = shell.events()
    assert [event.message for event in events if event.level == "warning"] == [
        "the gateway is frozen, without a sign of life for 0.3 s: controlled stop"
    ]
    assert [(event.id, event.outcome) for event in events if event.outcome] == [("g-1", "stopped")]


def test_what_a_frozen_gateway_has_left_is_not_taken_until_it_serves_again(shell: Shell) -> None:
    shell.enabled()
    beating(shell, 50)
    shell.cycles(300)
    shell.send(2, "g-1", PoseGoal(0.01, 0.0, 0.0))
    shell.cycles(500)
    assert shell.mode() is Mode.HOLDING
    beating(shell, 50)
    assert shell.mode() is Mode.MOVING


def test_what_a_frozen_gateway_has_left_dies_with_it(shell: Shell, tmp_path: Path) -> None:
    shell.enabled()
    beating(shell, 50)
    shell.cycles(300)
    shell.send(2, "g-1", PoseGoal(0.01, 0.0, 0.0))
    shell.gateway.close()
    shell.heartbeats.heart("gateway").rest()
    shell.cycles(30)
    shell.gateway = links.connect(tmp_path / "gateway")
    shell.cycles(300)  # the next one takes its time to serve
    beating(shell, 500)
    assert shell.mode() is Mode.HOLDING


@pytest.mark.parametrize("goes", ["closes", "says what cannot be read", "freezes"])
def test_what_was_read_of_a_gateway_moves_nothing_once_it_is_lost(shell: Shell, goes: str) -> None:
    shell.enabled()
    beating(shell, 50)
    if goes == "freezes":
        shell.cycles(299)
    shell.send(2, "g-1", PoseGoal(0.01, 0.0, 0.0))
    if goes == "says what cannot be read":
        shell.gateway.send(bytes((Kind.MESSAGE,)) + b"nonsense")
    shell.cycles(1)
    if goes != "says what cannot be read":
        shell.cycles(1 if goes == "freezes" else 0)
        shell.gateway.close()
    before = shell.loop.control.commanded
    shell.cycles(300)
    assert shell.mode() is Mode.HOLDING
    assert shell.loop.control.commanded == before


@given(durations=st.lists(st.integers(0, 5_000_000)))
def test_a_budget_follows_the_longest_recent_duration_within_its_limits(durations: list[int]) -> None:
    shortest, longest = 150_000, 1_000_000
    budget = TimeBudget(shortest, longest)
    for duration in durations:
        before = budget.ns
        budget.note(duration)
        assert min(duration, longest) <= budget.ns <= max(before, duration)
        assert shortest <= budget.ns <= longest
        assert budget.ns >= 0.9 * before
    for _ in range(200):
        budget.note(0)
    assert budget.ns == shortest


def test_batches_of_records_are_full_and_without_a_gap(shell: Shell) -> None:
    shell.enabled()
    shell.received()
    shell.cycles(400)
    batches = [unpack(packet[1:])["cycle"].tolist() for packet in shell.received() if packet[0] == Kind.RECORDS]
    cycles = [cycle for batch in batches for cycle in batch]
    assert cycles == [*range(cycles[0], cycles[0] + len(cycles))]
    assert {len(batch) for batch in batches} == {shell.rig.config.loop.rate_hz // BATCHES_PER_SECOND}
    assert len(batches) >= 400 // len(batches[0]) - 1


def test_a_machine_that_stands_still_is_no_frozen_gateway(shell: Shell) -> None:
    moving(shell)
    shell.rig.now += 0.09
    shell.cycles(1, missed=90)
    beating(shell, 300)
    assert shell.mode() is Mode.MOVING


def test_the_loop_gives_signs_of_life_while_it_turns(shell: Shell) -> None:
    watch = Watch(shell.heartbeats.heart("loop"), 2)
    for _ in range(20):
        shell.cycles(20)
        assert not watch.silent()
        assert watch.has_beat
    assert [watch.silent() for _ in range(3)] == [False, False, True]


def test_it_ends_when_the_robot_has_no_power(shell: Shell) -> None:
    shell.enabled()
    shell.loop.ending = True
    shell.cycles(1)
    assert shell.loop.control.state.mode is Mode.DISABLED
    assert not shell.loop._has_ended()  # the drives have not said so yet
    shell.cycles(5)
    assert shell.loop._has_ended()


KEEPING = "A drop rpdo1 rpdo2 rpdo3 sdo-request nmt"
"""Fault with which drive A receives nothing that would remove its power."""
GENTLE = msgspec.structs.replace(CONFIG.limits.platform, acceleration=(0.01, 0.01, 0.1), jerk=(0.1, 0.1, 1.0))
"""Limits with which a controlled stop takes longer than the service's end allows."""


@contextmanager
def ending_shell(config: Config, **drives: float) -> Iterator[Shell]:
    """A loop at 100 Hz, whose drives are configured like this."""
    loop = msgspec.structs.replace(CONFIG.loop, rate_hz=100)
    config = msgspec.structs.replace(config, loop=loop, drives=msgspec.structs.replace(config.drives, **drives))
    with TemporaryDirectory() as folder, closing(Shell(Rig(config), Path(folder))) as shell:
        shell.enabled()
        yield shell
    shell.rig.bus.shutdown()


def end(shell: Shell) -> float:
    """End the loop, and return how long that took [s]."""
    began, shell.loop.ending = shell.rig.now, True
    while not shell.loop._has_ended():
        shell.cycles(1)
    return shell.rig.now - began


@example(5.0, True)
@given(st.floats(0.1, 8.0), st.booleans())
@settings(max_examples=10)
def test_power_that_a_drive_keeps_at_the_end_is_told(stop_timeout: float, keeps: bool) -> None:
    with ending_shell(CONFIG, stop_timeout=stop_timeout) as shell:
        if keeps:
            shell.rig.bus.faults.add(KEEPING)
        assert end(shell) <= ending.stops_within(shell.rig.config.drives)
        faults = [event.fault for event in shell.events() if event.fault is not None]
        assert [(fault.cause, fault.drive) for fault in faults] == ([("timeout", "A")] if keeps else [])
        assert shell.loop.control.measured.powered == keeps


@given(st.floats(0.006, 10.0))
@settings(max_examples=10)
def test_a_controlled_stop_that_takes_too_long_at_the_end_becomes_a_quick_stop(deceleration: float) -> None:
    """The quick stop has as much time as any other."""
    config = msgspec.structs.replace(CONFIG, limits=msgspec.structs.replace(CONFIG.limits, platform=GENTLE))
    with ending_shell(config, stop_timeout=8.0, quick_stop_deceleration=deceleration) as shell:
        shell.send(2, "long", PoseGoal(0.12, 0.0, 0.0))
        shell.cycles(350)
        assert shell.mode() is Mode.MOVING
        assert end(shell) > ending.MAX_SHUTDOWN_S
        faults = [event for event in shell.events() if event.fault is not None]
        assert [(event.event_code, event.params) for event in faults] == [(EventCode.SHUTDOWN_SLOW, {"timeout": 3.0})]
        assert not shell.loop.control.measured.powered


def test_who_enables_while_the_service_ends_moves_nothing(shell: Shell) -> None:
    shell.enabled()
    shell.loop.ending = True
    shell.cycles(1)
    assert shell.mode() is Mode.DISABLED
    shell.gateway.send(message(CommandRequest(2, "ann", Command.ENABLE)))
    shell.cycles(2)
    for ticket in range(3, 40):
        shell.send(ticket, f"g-{ticket}", PoseGoal(0.05, 0.0, 0.0))
        shell.cycles(1)
        assert shell.mode() in (Mode.ENABLING, Mode.HOLDING, Mode.DISABLED)
    shell.cycles(20)
    assert shell.mode() is Mode.DISABLED
    assert shell.loop._has_ended()


def test_the_recorder_is_told_what_the_control_was_given_and_when(shell: Shell) -> None:
    shell.enabled()
    shell.rig.drives[1].fail(0x4310)
    shell.cycles(3)
    shell.gateway.close()
    shell.cycles(2)
    shell.loop.ending = True
    shell.cycles(20)  # a batch of records: what was given goes with it
    said = shell.said(shell.recorder)
    given = [answer for answer in said if isinstance(answer, ControlInput)]
    assert [type(what.given) for what in given] == [CommandRequest, DrivesFault, Disturbance, Disturbance]
    assert [what.seq for what in given] == [1, 2, 3, 4]
    assert [what.given.event for what in given if isinstance(what.given, Disturbance)] == ["GATEWAY_LOST", "SHUTDOWN"]
    events = {answer.event.kind: answer.event for answer in said if isinstance(answer, EventReport)}
    assert isinstance(given[1].given, DrivesFault)
    assert given[1].given.message == events["fault"].message
    assert given[1].cycle == events["fault"].cycle


@example(300, [])
@given(st.integers(0, 300), st.lists(st.integers(1, 20), max_size=20))
@settings(max_examples=10)
def test_a_restarted_gateway_gets_all_events_in_order_few_in_a_cycle(before: int, later: list[int]) -> None:
    """Sending all of them in one cycle would delay the SYNCs that follow."""

    def announce(number: int) -> None:
        notices.extend(Notice("service", "info", "output switched") for _ in range(number))

    with TemporaryDirectory() as folder, closing(Shell(Rig(), Path(folder))) as shell:
        notices = shell.loop.control.ledger.notices
        announce(before)
        shell.cycles(2 + before // SENT_TOGETHER)
        shell.gateway.close()
        shell.cycles(2)
        shell.gateway = links.connect(shell.folder / "gateway")
        told: list[int] = []
        while later or not shell.loop._reports.idle or not told:
            announce(later.pop() if later else 1 - min(1, len(told)))
            shell.cycles(1)
            new = [event.seq for event in shell.events()]
            assert len(new) <= 2 * SENT_TOGETHER  # after the setpoints, and after the decisions
            told += new
        assert told == list(range(1, len(told) + 1))
        assert len(told) >= before
    shell.rig.bus.shutdown()


@given(read=st.integers(0, 20), unread=st.integers(0, 20), absent=st.integers(0, 20))
@settings(max_examples=10)
def test_a_restarted_recorder_gets_every_event_that_was_not_written(read: int, unread: int, absent: int) -> None:
    """The recorder before it may have been killed, or frozen, with unread packets in its socket."""
    with TemporaryDirectory() as folder, closing(Shell(Rig(), Path(folder))) as shell:

        def announce(number: int) -> None:
            notices = shell.loop.control.ledger.notices
            notices.extend(Notice("service", "info", "output switched") for _ in range(number))
            shell.cycles(5 + number // SENT_TOGETHER)

        def received() -> list[int]:
            return [answer.event.seq for answer in shell.said(shell.recorder) if isinstance(answer, EventReport)]

        shell.enabled()
        announce(read)
        written = max(received())
        shell.recorder.send(message(EventsWritten(written)))
        announce(unread)
        shell.recorder.close()
        announce(absent)
        shell.recorder = links.connect(shell.folder / "recorder")
        shell.cycles(30)
        assert received() == list(range(written + 1, shell.loop._reports._events + 1))
    shell.rig.bus.shutdown()


def test_a_recorder_that_has_read_nothing_for_a_while_gets_every_event_and_the_newest_status(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its disk may be slow. Without the event of the fault, there would be no black box."""
    monkeypatch.setattr(links, "_BUFFER", 212_992)  # as large as a usual kernel allows
    shell.enabled()
    while not shell.ports.recorder.dropped:
        shell.cycles(20)
        shell.received()
    shell.loop.control.modes.trip(coded("drive B: silent", EventCode.OTHER), FaultCause.QUICK_STOP)
    shell.cycles(20)
    told: list[Answer] = []
    for _ in range(20):
        told += shell.said(shell.recorder)
        shell.cycles(20)
    events = [answer.event for answer in told if isinstance(answer, EventReport)]
    assert [event.seq for event in events] == list(range(1, len(events) + 1))
    assert [event.message for event in events if event.kind == "fault"] == ["drive B: silent"]
    assert [answer.fault for answer in told if isinstance(answer, Status)][-1] == "drive B: silent"


def test_captured_frames_wait_for_a_recorder_that_has_read_nothing_for_a_while(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(links, "_BUFFER", 212_992)  # as large as a usual kernel allows
    shell.loop._reports._capture = capture = Capture()
    shell.enabled()
    count, told = 0, list[float]()
    while not shell.ports.recorder.dropped:
        capture.note(packed(can.Message(arbitration_id=0x181, data=bytes(8))), float(count))
        count += 1
        shell.cycles(20)
        shell.received()
    for _ in range(20):
        packets = shell.received(shell.recorder)
        told += [t for each in packets if each[0] == Kind.FRAMES for t, _ in CAPTURED.iter_unpack(each[1:])]
        shell.cycles(20)
    assert told == list(range(count))


def test_what_the_recorder_says_is_told_to_everyone(shell: Shell) -> None:
    shell.enabled()
    notice = message(Announcement(Notice("service", "warning", "the disk is full")))
    unreadable = [notice.replace(b"\xb0the disk is full", each) for each in UNREADABLE]
    for packet in (notice, b"\x02nonsense", *unreadable):
        shell.recorder.send(packet)
        shell.cycles(60)
    full, *invalid = shell.events()[2:]
    assert (full.level, full.message) == ("warning", "the disk is full")
    assert len(invalid) == 1 + len(unreadable)
    assert all(event.message.startswith("the recorder has sent an invalid packet") for event in invalid)
    assert shell.loop.control.state.mode is Mode.HOLDING


def test_that_nothing_is_recorded_stands_in_the_status_while_it_is_so(shell: Shell) -> None:
    def standing() -> list[str]:
        shell.cycles(60)
        return [answer.unrecorded for answer in shell.said() if isinstance(answer, Status)]

    shell.enabled()
    shell.recorder.send(message(Announcement(Notice("service", "info", "recording to x.rrd"))))
    assert set(standing()) == {""}
    shell.recorder.send(message(Unrecorded("nothing is recorded: /rec is full")))
    assert standing() == ["nothing is recorded: /rec is full"]
    shell.recorder.send(message(Unrecorded("")))
    assert standing() == [""]
    shell.recorder.send(message(Unrecorded("\x1b[2J" + "x" * 60_000)))
    (told,) = standing()
    assert len(told) <= MAX_TEXT
    assert "\x1b" not in told
    shell.recorder.close()
    assert standing() == ["the recorder has died: nothing is recorded until it has restarted"]
    shell.recorder = links.connect(shell.folder / "recorder")
    shell.cycles(60)
    shell.recorder.send(message(Announcement(Notice("service", "info", "recording to y.rrd"))))
    assert standing()[-1] == ""


def test_whatever_the_fault_says_the_gateway_and_the_recorder_can_read_it(shell: Shell) -> None:
    """It is told anew whenever one of them is started again: one that it ended would end for good."""
    shell.enabled()
    shell.received()
    shell.loop.control.modes.trip(coded("x" * 200_000 + "\n\x1b[2J", EventCode.OTHER), "internal")
    shell.cycles(60)
    for link in (shell.gateway, shell.recorder):
        said = shell.said(link)
        (told,) = [answer.event for answer in said if isinstance(answer, EventReport) and answer.event.kind == "fault"]
        assert told.message.startswith("xxx")
        faults = [answer.fault for answer in said if isinstance(answer, Status) and answer.fault]
        assert all(fault.startswith("xxx") and fault.isprintable() for fault in faults)
        assert faults


def answered(shell: Shell) -> list[int]:
    """Tickets of the commands that are confirmed, in order."""
    return [answer.ticket for answer in shell.said() if isinstance(answer, CommandDone)]


def test_a_stop_behind_a_flood_of_commands_is_carried_out_while_they_arrive(shell: Shell) -> None:
    shell.enabled()
    shell.send(2, "g-1", PoseGoal(0.08, 0.02, 0.2))
    shell.cycles(100)
    assert shell.mode() is Mode.MOVING
    for ticket in range(100, 200):
        shell.gateway.send(message(CommandRequest(ticket, "eve", Command.OVERRIDE, Override(100.0))))
    shell.gateway.send(message(CommandRequest(200, "ann", Command.STOP)))
    shell.cycles(100 // REQUESTS_A_CYCLE + 1)
    assert shell.mode() is Mode.STOPPING
    shell.cycles(400)
    assert answered(shell)[1:] == list(range(100, 201))


@pytest.mark.parametrize("name", [command for command in Command if command.stops])
def test_an_urgent_stop_takes_effect_in_its_cycle_whatever_was_sent_before_it(shell: Shell, name: Command) -> None:
    """The loop may have been kept waiting while goals and commands came, as many as the gateway sends ahead."""
    shell.enabled()
    shell.send(2, "g-1", PoseGoal(0.08, 0.02, 0.2))
    shell.cycles(100)
    assert shell.mode() is Mode.MOVING
    for ticket in range(100, 100 + MAX_GOALS):
        shell.send(ticket, f"g{ticket}", PoseGoal(-0.08, 0.02, 0.2))
    for ticket in range(200, 200 + MAX_COMMANDS):
        shell.gateway.send(message(CommandRequest(ticket, "eve", Command.OVERRIDE, Override(100.0))))
    with shell.heartbeats.urgent_section():
        shell.gateway.send(message(CommandRequest(300, "ann", name)))
    shell.cycles(1)
    assert shell.mode() is not Mode.MOVING
    shell.cycles(400)
    assert shell.mode() is not Mode.MOVING, "goals that were sent before it do not begin"


def test_an_answer_waits_for_a_gateway_that_is_slow(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    shell.enabled()
    shell.received()
    with monkeypatch.context() as full:
        full.setattr(shell.ports[0], "send", lambda _packet: False)
        for ticket in range(100, 130):
            shell.gateway.send(message(CommandRequest(ticket, "ann", Command.STOP)))
        shell.cycles(50)
    shell.cycles(10)
    assert answered(shell) == list(range(100, 130))


def test_nobody_is_told_what_a_gateway_that_is_gone_was_asked(shell: Shell, tmp_path: Path) -> None:
    shell.enabled()
    shell.gateway.send(message(CommandRequest(100, "ann", Command.STOP)))
    shell.gateway.close()
    shell.cycles(30)
    shell.gateway = links.connect(tmp_path / "gateway")
    shell.cycles(30)
    assert answered(shell) == []


# ---------------------------------------------------------------------- the planner


def sent_in_motion(shell: Shell) -> None:
    """A robot on its way to g-1, whose planner serves no more, that has just been sent g-2."""
    moving(shell)
    shell.serves = False
    shell.send(3, "g-2", PoseGoal(0.0, 0.05, 0.0))
    shell.cycles(1)


def refusals(shell: Shell) -> list[tuple[int, str]]:
    return [(answer.ticket, answer.code) for answer in shell.said() if isinstance(answer, Refused)]


def test_a_planner_that_dies_is_noticed_in_the_next_cycle(shell: Shell) -> None:
    sent_in_motion(shell)
    shell.planner.close()
    shell.cycles(1)
    assert refusals(shell) == [(3, "planner_lost")]
    assert shell.mode() is Mode.MOVING


def test_a_planner_that_is_not_there_costs_the_goal_and_the_next_one_is_taken(shell: Shell, tmp_path: Path) -> None:
    shell.enabled()
    shell.serves = False
    shell.planner.close()
    beating(shell, 50)
    shell.send(2, "g-1", PoseGoal(0.05, 0.0, 0.0))
    shell.cycles(2)
    assert refusals(shell) == [(2, "planner_lost")]
    shell.planner, shell.serves = links.connect(tmp_path / "planner"), True
    beating(shell, 50)
    shell.send(3, "g-2", PoseGoal(0.05, 0.0, 0.0))
    shell.cycles(3)
    assert shell.mode() is Mode.MOVING


@pytest.mark.parametrize("full", [False, True])
def test_a_request_that_does_not_reach_the_planner_is_refused_with_the_reason(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, full: bool
) -> None:
    """A planner that dies between the reading of its answers and the request is known to be dead by the request."""
    shell.enabled()
    shell.serves = False
    shell.received()
    read = shell.loop._planner.read

    def read_before_the_end(*given: Any) -> None:
        read(*given)
        shell.planner.close()

    if full:
        while shell.ports.planner.send(bytes(10_000)):
            pass
    else:
        monkeypatch.setattr(shell.loop._planner, "read", read_before_the_end)
    shell.send(2, "g-1", PoseGoal(0.05, 0.0, 0.0))
    shell.cycles(2)
    (text,) = (answer.message for answer in shell.said() if isinstance(answer, Refused))
    assert text.startswith(
        "the queue of requests to the planner is full" if full else "the planner is not running and is being restarted"
    )


@pytest.mark.parametrize(
    "junk",
    [
        *(b"", b"\x00", b"nonsense", message(Announcement(Notice("service", "info", "hello"))), b"\xff" * 1000),
        *(encode(NotPlanned(1, 1, RefusalCode.NO_PLAN, "text")).replace(b"\xa4text", each) for each in UNREADABLE),
        b"\x81\xa1x" + NESTED,
    ],
)
def test_what_is_no_answer_ends_the_planner_and_not_the_robot(shell: Shell, junk: bytes) -> None:
    """An empty packet is how an end looks; after anything else the loop hangs up, and the supervisor starts another."""
    sent_in_motion(shell)
    shell.planner.send(junk)
    shell.cycles(1)
    assert refusals(shell) == [(3, "planner_lost")]
    shell.cycles(20)
    assert not shell.ports.planner.connected
    with pytest.raises(LinkClosed):
        shell.received(shell.planner)
    assert shell.mode() is Mode.MOVING


def test_a_planner_that_floods_the_loop_is_not_read(shell: Shell) -> None:
    """Nobody asked: what it says stands in the socket, and costs it its life once it is asked."""
    moving(shell)
    while shell.planner.send(b"junk" * 100):
        pass
    shell.gateway.send(message(CommandRequest(9, "ann", Command.STOP)))
    shell.cycles(600)
    assert answered(shell)[-1] == 9
    assert shell.mode() is Mode.HOLDING


def test_an_answer_to_what_was_asked_before_is_not_the_last(shell: Shell) -> None:
    """The motion has changed since: what was asked from it is answered, and then what was asked from the new one."""
    sent_in_motion(shell)
    shell.gateway.send(message(CommandRequest(4, "ann", Command.OVERRIDE, Override(80.0))))
    shell.cycles(3)
    asked = [decode_plan_request(packet) for packet in shell.received(shell.planner)]
    assert len(asked) == 2
    for _ in range(5):  # a request whose answer came too late is followed by another
        for request in asked:
            shell.planner.send(encode(shell.motion_planner.plan(request)))
            shell.cycles(1)
        shell.cycles(1)
        asked = [decode_plan_request(packet) for packet in shell.received(shell.planner)]
    shell.cycles(20)
    target = shell.loop.control.target
    assert target is not None
    assert target == pytest.approx((0.0, 0.05, 0.0), abs=1e-6)


def test_the_recorder_has_every_answer_with_the_cycle_in_which_it_was_taken(shell: Shell) -> None:
    shell.enabled()
    shell.send(2, "g-1", PoseGoal(0.05, 0.0, 0.0))
    shell.cycles(3)
    said = shell.said(shell.recorder)
    goal, planned = [answer for answer in said if isinstance(answer, ControlInput)][-2:]
    assert isinstance(goal.given, GoalRequest)
    assert isinstance(planned.given, PreemptingMotion)
    assert planned.cycle == goal.cycle + 1


@pytest.mark.parametrize("words", [b"", b"{}", b"\x93\x01\xff", bytes(range(256)), *COMMANDS])
def test_a_gateway_that_says_what_cannot_be_read_is_let_go(shell: Shell, words: bytes) -> None:
    shell.enabled()
    shell.received(shell.recorder)
    shell.gateway.send(bytes((Kind.MESSAGE,)) + words)
    shell.cycles(25)  # a batch of records: what was given goes with it
    assert not shell.ports.gateway.connected
    given = [answer.given for answer in shell.said(shell.recorder) if isinstance(answer, ControlInput)]
    assert [what.event for what in given if isinstance(what, Disturbance)] == ["GATEWAY_LOST"]
    assert shell.loop.control.fault is None
    assert shell.loop.control.state.mode is Mode.HOLDING


# ---------------------------------------------------------------------- a gateway after another


class Asking:
    """The requests of a gateway, and what their senders were answered."""

    def __init__(self, shell: Shell) -> None:
        self.shell = shell
        self.answered: dict[str, Any] = {}
        loop_death = LoopDeath(CONFIG.period, lambda: None)
        self.requests = Requests(CONFIG, shell.gateway, Guard(CONFIG), self, loop_death, nullcontext)  # type: ignore[arg-type]

    def answer(self, incoming: Incoming, content: msgspec.Struct) -> None:
        self.answered[incoming.id] = content

    def hear(self) -> None:
        for said in self.shell.said():
            if isinstance(said, CommandDone):
                self.requests.answer(said.ticket, CommandReply(said.name, said.mode, said.cycle))
            elif isinstance(said, Accepted | Checked):
                self.requests.answer(said.ticket, said.reply)
            elif isinstance(said, Refused):
                self.requests.answer(said.ticket, said)


def came(name: str) -> Incoming:
    return Incoming("cmd", "trirail/demo/cmd/ann", 0, b"", "", None, 0, id=name)


def test_a_gateway_is_not_told_what_the_gateway_before_it_was_owed(shell: Shell, tmp_path: Path) -> None:
    moving(shell)
    before = Asking(shell)
    before.requests.command(came("stop"), "ann", Command.STOP, None)
    shell.cycles(2)  # the robot brakes, which takes longer than the restart of the gateway
    shell.gateway.close()
    shell.cycles(21)
    shell.gateway = links.connect(tmp_path / "gateway")
    shell.cycles(21)
    after = Asking(shell)
    after.requests.check(came("check"), "ann", PoseGoal(0.0, 0.02, 0.0))
    shell.serves = False  # the planner takes its time
    beating(shell, 300)
    after.hear()
    assert after.answered == {}
    shell.serves = True
    beating(shell, 50)
    after.hear()
    assert isinstance(after.answered["check"], GoalReply)


def test_what_changes_while_a_new_gateway_starts_reaches_it(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The past events fill the socket of a gateway that does not read yet, as large as a usual kernel allows."""
    monkeypatch.setattr(links, "_BUFFER", 212_992)
    shell.enabled()
    notice = Notice("service", "info", "something happened that is told in a line of a usual length " * 3)
    for _ in range(600):
        shell.gateway.send(message(Announcement(notice)))
        shell.cycles(1)
        shell.received()
    shell.gateway.close()
    shell.cycles(30)
    shell.gateway = links.connect(tmp_path / "gateway")
    shell.cycles(100)  # it imports its modules
    shell.loop.control.modes.trip(coded("the emergency stop is pressed", EventCode.OTHER), FaultCause.QUICK_STOP)
    missing = (MissingProtection("A", "0x1016", "no heartbeat"),)
    with monkeypatch.context() as patched:
        patched.setattr(type(shell.rig.driver), "missing_protections", missing)
        shell.loop._reports.report_protections()
    shell.cycles(300)
    told: list[Answer] = []
    for _ in range(20):  # and then reads everything
        told += shell.said()
        shell.cycles(30)
    assert shell.mode() is Mode.FAULT
    assert [said.fault for said in told if isinstance(said, Status)][-1] == "the emergency stop is pressed"
    assert [said.missing_protections for said in told if isinstance(said, Welcome)][-1] == missing
