"""Homing, from the command down to the frames: incremental encoders, whose positions mean nothing at first."""

from __future__ import annotations

import itertools
import math
import random
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import can
import canopen
import msgspec
import numpy as np
import pytest
from canopen.profiles.p402 import BaseNode402
from conftest import Delay, Rig, a_cycle, changed, one_drive_late, part_of_a_cycle
from control.test_plan_requests import Meddler
from control_rig import CONFIG
from drivers.test_foreign import MAKES
from edsfiles import make_eds
from refusals import refusal
from trirail.config import Config, geometry
from trirail.control.modes import ModeEvent
from trirail.kinematics.robot import inverse
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.goals import PoseGoal
from trirail.wire.packets import Accepted, CommandDone, CommandRequest
from trirail.wire.vocabulary import Command, Mode
from trirail_drivers import config
from trirail_drivers.bus.frames import Frame
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.axis import Cia402Axis
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.cia402.eds import SERVO
from trirail_drivers.cia402.homing import SETPOINT_SYNCS, HomingSequence
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.interface import PowerState
from trirail_drivers.simulated import Servo, SimulatedBus, SimulatedDrive
from trirail_drivers.simulated.dictionary import ObjectEntry
from trirail_drivers.simulated.faults import Faults
from trirail_drivers.simulated.homing import HomingMode, Phase
from trirail_drivers.simulated.profile import MakersRules
from waiting import WITHIN

pytestmark = pytest.mark.long
Robots = Callable[..., Rig]

PERIOD = CONFIG.period
HOMES = (-0.01, 0.012, 0.02)
"""Where the sliders' switches are [m]."""
START = (0.004, -0.003, 0.001)
"""Where the sliders stand at power-on [m]; the drives do not know."""
HOMING = config.Homing(method=19, speed_switch=0.05, speed_zero=0.01, acceleration=2.0, timeout=5.0)


def incremental(method: int = 19, homes: Sequence[float] = HOMES, **keys: object) -> Config:
    """A robot of drives that are to be homed, and that count from 0 at power-on."""
    robot = changed(CONFIG, start=START)
    homing = msgspec.structs.replace(HOMING, method=method, **keys)
    drives = robot.drives
    for name, home in zip("ABC", homes, strict=True):
        drive = msgspec.structs.replace(getattr(drives, name), offset=home, homing=homing)
        drives = msgspec.structs.replace(drives, **{name: drive})
    return msgspec.structs.replace(robot, drives=drives)


@pytest.fixture
def rig(robots: Robots) -> Rig:
    return robots(incremental())


def true_positions(rig: Rig) -> list[float]:
    """Where the sliders are, whatever the drives count: the switch is where the configuration says [m]."""
    found = []
    for device, drive in zip(rig.drives, rig.config.drives.each, strict=True):
        assert device.homing.switch is not None
        beyond = device.servo.position - device.homing.switch
        found.append(drive.direction * beyond / drive.counts_per_metre + drive.offset)
    return found


def modes(rig: Rig) -> list[int]:
    return [drive.objects[0x6061, 0].value for drive in rig.drives]


def is_homed(rig: Rig) -> None:
    """Home it; then it is where it says."""
    assert isinstance(rig.command("home"), CommandDone)
    assert rig.control.measured.feedback.homed == (True, True, True)
    assert rig.control.measured.feedback.position == pytest.approx(true_positions(rig), abs=2e-7)


def begin(rig: Rig, cycles: int = 0) -> None:
    """Send home, and let so many cycles pass."""
    rig.cycle(CommandRequest(99, "ann", Command.HOME))
    assert rig.mode is Mode.HOMING
    rig.cycles(cycles)


def settled(rig: Rig) -> None:
    """Every drive follows setpoints and stands, and goes on standing."""
    assert modes(rig) == [8, 8, 8]
    assert rig.control.measured.feedback.follows == (True, True, True)
    before = true_positions(rig)
    rig.cycles(200)
    assert true_positions(rig) == pytest.approx(before, abs=2e-7)


# ---------------------------------------------------------------------- what it comes to


@pytest.mark.parametrize("method", [17, 18, 19, 20, 21, 22])
@pytest.mark.parametrize("start", [START, (-0.03, 0.03, 0.03)])
def test_afterwards_positions_are_true(robots: Robots, method: int, start: tuple[float, float, float]) -> None:
    rig = robots(changed(incremental(method), start=start))
    rig.enable()
    assert rig.control.measured.feedback.position == HOMES  # what counts of 0 stand for: not where they are
    is_homed(rig)
    assert rig.mode is Mode.HOLDING
    assert true_positions(rig) == pytest.approx(HOMES, abs=1e-4)  # it brakes behind the edge
    settled(rig)
    assert isinstance(rig.goal("g1", 0.02, 0.01, 0.1), Accepted)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.control.measured.pose == pytest.approx((0.02, 0.01, 0.1), abs=1e-6)


@pytest.mark.parametrize("method", [35, 37])
def test_home_is_where_it_stands(robots: Robots, method: int) -> None:
    rig = robots(incremental(method))
    rig.enable()
    rig.command("home")
    assert rig.control.measured.feedback.homed == (True, True, True)
    assert rig.control.measured.feedback.position == pytest.approx(HOMES, abs=2e-7)
    assert true_positions(rig) == pytest.approx(START)
    settled(rig)


def test_only_what_is_not_absolute_is_homed(robots: Robots) -> None:
    drives = msgspec.structs.replace(incremental().drives, B=CONFIG.drives.B)
    rig = robots(msgspec.structs.replace(incremental(), drives=drives))
    assert rig.control.measured.feedback.homed == (False, True, False)
    rig.enable()
    seen = set()
    rig.cycle(CommandRequest(99, "ann", Command.HOME))
    while rig.mode is Mode.HOMING:
        seen.add(tuple(modes(rig)))
        rig.cycle()
    assert seen == {(8, 8, 8), (6, 8, 8), (8, 8, 6)}
    assert rig.control.measured.feedback.homed == (True, True, True)


# ---------------------------------------------------------------------- how it gets there


@pytest.mark.core
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("method", [19, 37])
@pytest.mark.parametrize("delay", [None, part_of_a_cycle, a_cycle, one_drive_late])
def test_one_moves_at_a_time_and_none_jumps(robots: Robots, delay: Delay | None, method: int, direction: int) -> None:
    robot = incremental(method)
    turned = msgspec.structs.replace(robot.drives.B, direction=direction)
    rig = robots(msgspec.structs.replace(robot, drives=msgspec.structs.replace(robot.drives, B=turned)), delay)
    rig.enable()
    rig.cycles(5)
    begin(rig)
    order: list[int] = []
    targets: list[tuple[int, int]] = []
    while rig.mode is Mode.HOMING:
        before, was, counted = true_positions(rig), modes(rig), [drive.servo.position for drive in rig.drives]
        rig.cycle()
        for n, (b, now) in enumerate(zip(before, true_positions(rig), strict=True)):
            if was[n] == 6 and n not in order:
                order.append(n)
            if was[n] == 8 or method == 37:
                assert method == 37 or abs(now - b) < 2e-7  # it follows setpoints, which hold it
            assert abs(now - b) <= HOMING.speed_switch * PERIOD * 1.001 or method == 37
        for n, drive in enumerate(rig.drives):
            if was[n] == 6 and modes(rig)[n] == 8:
                targets.append((drive.objects[0x607A, 0].value, drive.objects[0x6064, 0].value))
                assert drive.objects[0x60B1, 0].value == 0
                assert abs(drive.servo.position - counted[n]) <= 1
        assert sum(mode == 6 for mode in modes(rig)) <= 1
    assert rig.control.fault is None
    assert order == [0, 1, 2]
    assert len(targets) == 3
    for target, actual in targets:
        assert abs(target - actual) <= 1  # counts of 0.1 µm
    settled(rig)


def test_the_frames_of_one_drive(rig: Rig) -> None:
    """Mode 6, start, mode 8, each only when the one before is done; and setpoints in every cycle.

    CiA 301, SDO, initiate download and upload: e = s = 1 and n = 3 unused bytes; unused bits and bytes are zero.
    """
    rig.enable()
    begin(rig)
    frames, said, asked = rig.sent.copy(), list[str](), list[str]()
    word = canopen_frames.ENABLE_OPERATION
    while not rig.control.measured.feedback.homed[0]:
        rig.cycle()
        setpoints = [m.arbitration_id for m in rig.sent if m.arbitration_id & 0x780 == canopen_frames.RPDO2]
        assert setpoints == [canopen_frames.RPDO2 + node for node in (1, 2, 3)]
        frames += rig.sent
    for message in frames:
        if message.arbitration_id == canopen_frames.SDO_REQUEST + 1:
            if message.data[0] == 0x2F:
                said.append(f"mode {message.data[4]}")
            if asked[-1:] != [message.data.hex()]:
                asked.append(message.data.hex())
        elif message.arbitration_id == canopen_frames.RPDO1 + 1:
            before, (word,) = word, canopen_frames.CONTROLWORD.unpack(message.data)
            if word != before:  # else it is sent again, for it may have got lost
                said.append(f"controlword {word:04X}")
    assert said == ["mode 6", "controlword 001F", "controlword 000F", "mode 8"]
    to_6, to_8, display, status = "2f60600006000000", "2f60600008000000", "4061600000000000", "4041600000000000"
    assert asked == [to_6, display, status, to_8, display, status]


@pytest.mark.parametrize("word", [0x1F, 0x0F, 0x10F])
def test_a_controlword_that_gets_lost_is_sent_again(rig: Rig, monkeypatch: pytest.MonkeyPatch, word: int) -> None:
    rig.enable()
    receive = rig.drives[0].receive
    lost: list[bytes] = []

    def lose(can_id: int, data: bytes, now: float) -> None:
        if can_id == canopen_frames.RPDO1 + 1 and data == canopen_frames.CONTROLWORD.pack(word) and not lost:
            lost.append(data)
        else:
            receive(can_id, data, now)

    begin(rig, 0 if word == 0x1F else 30)
    monkeypatch.setattr(rig.drives[0], "receive", lose)
    if word == 0x10F:
        rig.command("stop")
    rig.until(rig.holds, 2000)
    assert lost
    settled(rig)
    is_homed(rig)


@pytest.mark.parametrize("method", [19, 37])
def test_a_drive_in_mode_7_starts_its_homing_when_it_is_told_to(robots: Robots, tmp_path: Path, method: int) -> None:
    """In mode 7, bit 4 of the controlword enables interpolation; with it, the change to mode 6 would start homing."""
    robot = incremental(method)
    eds = str(make_eds(tmp_path, "elmo_gold", {(0x6502, 0): 0x60}))
    keys = {name: msgspec.structs.replace(getattr(robot.drives, name), eds=eds) for name in "ABC"}
    rig = robots(msgspec.structs.replace(robot, drives=msgspec.structs.replace(robot.drives, **keys)))
    rig.enable()
    assert modes(rig) == [7, 7, 7]
    words: list[int] = []
    for drive in rig.drives:
        mode_written, word = drive._profile._mode_written, drive.objects[0x6040, 0]

        def written(entry: ObjectEntry, old: int, of: Any = mode_written, word: ObjectEntry = word) -> None:
            if entry.value == 6:
                words.append(word.value)
            of(entry, old)

        drive.objects.on_write(0x6060, written)
    assert isinstance(rig.command("home"), CommandDone)
    assert rig.control.measured.feedback.homed == (True, True, True)
    assert words == [canopen_frames.ENABLE_OPERATION] * 3
    assert modes(rig) == [7, 7, 7]


@pytest.mark.parametrize("method", [19, 37])
@pytest.mark.parametrize("make", ["elmo_gold", "maxon_epos4_compact50_5", "nanotec_pd4n", "ros2_cia402_slave"])
def test_drives_of_several_makes_are_homed(
    robots: Robots, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, make: str, method: int
) -> None:
    with_target_reached(monkeypatch)
    robot = incremental(method)
    keys = {"eds": str(make_eds(tmp_path, make)), **MAKES[make].keys}
    if not make.startswith("maxon"):  # the others do not tell it
        keys["velocity_unit"] = "counts/s"
    each = {name: msgspec.structs.replace(getattr(robot.drives, name), **keys) for name in "ABC"}
    rig = robots(msgspec.structs.replace(robot, drives=msgspec.structs.replace(robot.drives, **each)), part_of_a_cycle)
    rig.enable()
    assert isinstance(rig.command("home"), CommandDone)
    assert rig.control.measured.feedback.homed == (True, True, True)
    expected = true_positions(rig) if method == 19 else HOMES
    assert rig.control.measured.feedback.position == pytest.approx(expected, abs=1e-6)


def test_an_earlier_homing_is_not_taken_for_this_one(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = rig.drives[0]
    forget = drive.homing.forget

    def keep() -> None:  # a drive that tells of its last homing until the next one is started
        attained = drive.homing.attained
        forget()
        drive.homing.attained = attained and drive.objects[0x6040, 0].value & canopen_frames.HOMING_START == 0

    monkeypatch.setattr(drive.homing, "forget", keep)
    rig.enable()
    rig.command("home")
    begin(rig, 1)
    moved = 0.0
    before = true_positions(rig)[0]
    while not rig.control.measured.feedback.homed[0]:
        rig.cycle()
        moved = max(moved, abs(true_positions(rig)[0] - before))
    assert moved > 5e-5
    rig.until(lambda: rig.mode is Mode.HOLDING)


def with_target_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let drives show bit 10 at standstill in their setpoint mode too, as some makers do."""
    publish = SimulatedDrive._publish

    def shown(self: SimulatedDrive) -> None:
        publish(self)
        if self._profile.mode.value == 8 and self.servo.velocity == 0.0:
            self._profile.statusword.value |= 1 << 10

    monkeypatch.setattr(SimulatedDrive, "_publish", shown)


@pytest.mark.core
def test_a_statusword_of_the_setpoint_mode_that_comes_after_the_start_ends_no_homing(rig: Rig) -> None:
    rig.enable()
    begin(rig)
    rig.until(lambda: rig.drives[0].homing.under_way)
    rig.bus._emit(canopen_frames.TPDO1 + 1, canopen_frames.STATUSWORD.pack(0x1637))
    rig.until(lambda: rig.mode is not Mode.HOMING)
    assert rig.control.measured.feedback.homed == (True, True, True)
    assert rig.control.measured.feedback.position == pytest.approx(true_positions(rig), abs=2e-7)


LATEST = 0.0125
"""How late statuswords come at most [s]: that of a drive that updates its PDO every 12.5 ms."""


@pytest.mark.parametrize("keeps", [False, True])
@pytest.mark.parametrize("method", [19, 37])
@pytest.mark.parametrize("reordered", [False, True])
@pytest.mark.generated(2, 0, 1)
def test_late_statuswords_end_no_homing(
    robots: Robots, monkeypatch: pytest.MonkeyPatch, seed: int, reordered: bool, method: int, keeps: bool
) -> None:
    """Bits 12 and 10 of a statusword of the setpoint mode, or of the last homing, do not show that home was found."""
    drawn, late, arrivals = random.Random(seed), False, dict[int, float]()
    share = drawn.random()
    rig: Rig

    def delay(message: can.Message) -> float:
        can_id, waits = message.arbitration_id, 0.0
        if can_id & 0x780 != canopen_frames.TPDO1 or not late:
            return 0.0
        if drawn.random() < share:
            waits = drawn.uniform(0.0, LATEST)
        if not reordered:
            waits = max(waits, arrivals.get(can_id, 0.0) - rig.now)
        arrivals[can_id] = rig.now + waits
        return waits

    with_target_reached(monkeypatch)
    rig = robots(incremental(method), delay)
    rig.enable()
    for drive in rig.drives if keeps else ():
        # A drive that shows its last homing until the next one starts.
        monkeypatch.setattr(drive.homing, "forget", partial(setattr, drive.homing, "phase", Phase.IDLE))
        monkeypatch.setattr(drive.homing, "start", partial(started_again, drive.homing))
    for goal in ("g1", "g2"):
        late = True
        rig.cycles(drawn.randrange(100))
        begin(rig)
        begun = [False] * 3
        while rig.mode is Mode.HOMING:
            rig.cycle()
            for n, homed in enumerate(rig.control.measured.feedback.homed):
                begun[n] = begun[n] or rig.drives[n].homing.phase is not Phase.IDLE or method == 37
                assert begun[n] or not homed
        rig.cycles(50)
        if reordered and "does not follow setpoints" in (rig.control.fault or ""):
            return  # a statusword of homing mode came last; the robot has stopped
        assert rig.control.fault is None
        assert rig.control.measured.feedback.homed == (True, True, True)
        expected = true_positions(rig) if method == 19 else HOMES
        assert rig.control.measured.feedback.position == pytest.approx(expected, abs=2e-7)
        late = False
        rig.cycles(50)
        settled(rig)
        assert isinstance(rig.goal(goal, 0.01, 0.0, 0.05), Accepted)
        rig.until(rig.holds)


def started_again(homing: HomingMode, *given: Any) -> None:
    """Start homing; only this clears the result of the last homing."""
    homing.attained = homing.failed = False
    HomingMode.start(homing, *given)


@pytest.mark.parametrize("method", [35, 37])
def test_homing_in_place_again_succeeds_with_drives_that_show_the_last_homing_until_the_next(
    robots: Robots, monkeypatch: pytest.MonkeyPatch, method: int
) -> None:
    rig = robots(incremental(method))
    for drive in rig.drives:
        # The start itself attains home, so that no statusword shows bit 12 clear.
        monkeypatch.setattr(drive.homing, "forget", lambda: None)
    rig.enable()
    rig.command("home")
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert isinstance(rig.goal("g1", 0.02, 0.01, 0.1), Accepted)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    rig.cycles(100)
    assert rig.control.measured.feedback.position != pytest.approx(HOMES, abs=1e-3)
    rig.command("home")
    assert rig.control.measured.feedback.homed == (True, True, True)
    assert rig.control.measured.feedback.position == pytest.approx(HOMES, abs=2e-7)
    settled(rig)


def test_a_statusword_of_homing_mode_does_not_show_that_the_drive_follows_setpoints(
    robots: Robots, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit 12 means "homing attained" in mode 6; afterwards this drive needs a while until it follows setpoints."""
    mute = late = 0.0  # until when the drive sends no statusword by itself, and until when it follows no setpoints [s]
    rig = robots(
        incremental(),
        lambda message: math.inf if message.arbitration_id == canopen_frames.TPDO1 + 1 and now() < mute else 0.0,
    )
    drive, following = rig.drives[0], vars(SimulatedDrive)["_follows_command"].fget

    def now() -> float:
        return rig.now

    def follows(self: SimulatedDrive) -> bool:
        return bool(following(self)) and (self is not drive or now() >= late)

    monkeypatch.setattr(SimulatedDrive, "_follows_command", property(follows))
    rig.enable()
    begin(rig)
    rig.until(lambda: modes(rig)[0] == 6)
    rig.until(lambda: drive.homing.attained)
    rig.cycles(2)
    mute, late = now() + 0.02, now() + 1.5 * canopen_frames.STATUS_PERIOD
    rig.until(lambda: rig.mode is not Mode.HOMING)
    assert rig.control.fault is None
    assert rig.control.measured.feedback.homed == (True, True, True)
    settled(rig)


def test_an_earlier_homing_error_is_not_taken_for_one_of_this_homing(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    drive, homing = rig.drives[0], rig.drives[0].homing
    forget = homing.forget

    def keep() -> None:  # a drive that tells of its last homing until the next one is started
        failed = homing.failed
        forget()
        homing.failed = failed and drive.objects[0x6040, 0].value & canopen_frames.HOMING_START == 0

    monkeypatch.setattr(homing, "forget", keep)
    rig.enable()
    begin(rig, 100)
    homing.failed = True
    homing.interrupt()
    rig.until(lambda: rig.mode is Mode.FAULT, 50)
    rig.cycles(300)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.enable()
    assert homing.failed
    is_homed(rig)
    settled(rig)


# ---------------------------------------------------------------------- what stops it


WHEN = [0, 1, 3, 8, 21, 150, 301, 460]
"""Cycles after the command: while the mode changes, under way, at the edge, between two drives."""


@pytest.mark.parametrize("when", WHEN)
@pytest.mark.parametrize(
    ("event", "end"),
    [
        ("stop", Mode.HOLDING),
        ("disable", Mode.DISABLED),
        (ModeEvent.GATEWAY_LOST, Mode.HOLDING),
        (ModeEvent.LATE, Mode.HOLDING),
        (ModeEvent.SHUTDOWN, Mode.DISABLED),
    ],
)
def test_a_stop_halts_it_and_it_can_begin_again(robots: Robots, event: str | ModeEvent, end: Mode, when: int) -> None:
    rig = robots(incremental(), part_of_a_cycle if when % 2 else None)
    rig.enable()
    begin(rig, when)
    if isinstance(event, ModeEvent):
        rig.control.modes.handle_disturbance(event, coded("it happened", EventCode.OTHER))
        rig.until(lambda: rig.mode is end, 400)
    else:
        assert isinstance(rig.command(event), CommandDone)
    assert rig.mode is end
    assert rig.control.fault is None
    assert not all(rig.control.measured.feedback.homed)
    assert refusal(next(a for a in rig.answers if getattr(a, "ticket", None) == 99)).code == "failed"
    settled(rig)
    if end is Mode.DISABLED:
        rig.enable()
    assert refusal(rig.goal("g1", 0.0, 0.0, 0.1)).code == "not_homed"
    is_homed(rig)


def braking_slowly(acceleration: float) -> Config:
    """Drives whose quick-stop ramp, by which simulated ones halt as well, is a tenth of a metre per second squared."""
    robot = incremental(acceleration=acceleration)
    return msgspec.structs.replace(robot, drives=msgspec.structs.replace(robot.drives, quick_stop_deceleration=0.1))


def halted_at_rest(rig: Rig) -> None:
    """Stop; a drive that is halted follows setpoints again only when it stands, and from where it stands."""
    rig.order("stop")
    while rig.mode is not Mode.HOLDING:
        was, speeds = modes(rig), [drive.servo.velocity for drive in rig.drives]
        rig.cycle()
        for drive, speed, before, now in zip(rig.drives, speeds, was, modes(rig), strict=True):
            if (before, now) == (6, 8):
                assert speed == 0.0
                assert abs(drive.objects[0x607A, 0].value - drive.servo.position) <= 1
    assert rig.control.fault is None
    settled(rig)


@pytest.mark.parametrize("delay", [None, part_of_a_cycle, a_cycle, one_drive_late])
@pytest.mark.parametrize("when", [2, 5, 30, 300])
def test_a_drive_that_brakes_slowly_follows_setpoints_only_when_it_stands(
    robots: Robots, delay: Delay | None, when: int
) -> None:
    rig = robots(braking_slowly(acceleration=0.1), delay)
    rig.enable()
    begin(rig, when)
    halted_at_rest(rig)


@pytest.mark.parametrize("when", range(2, 10))
def test_a_standstill_from_before_the_start_is_not_taken_for_that_of_the_halt(robots: Robots, when: int) -> None:
    """Statuswords come three cycles late, from a drive that is fast at once and brakes slowly."""

    def late_status(message: can.Message) -> float:
        return 3.0 * PERIOD if message.arbitration_id == canopen_frames.TPDO1 + 1 else 0.0

    rig = robots(braking_slowly(acceleration=50.0), late_status)
    rig.enable()
    rig.cycles(5)
    begin(rig, when)
    halted_at_rest(rig)


def test_the_held_setpoint_is_taken_up_before_setpoints_are_followed(rig: Rig) -> None:
    """Where an encoder flickers by some counts, the drive has the one position that is held from then on."""
    held: list[bytes] = []
    asked: list[int] = []
    receive, flicker = rig.bus.recv, itertools.cycle((0, 7, -5))

    def recv(timeout: float | None = None) -> can.Message | None:
        message = receive(timeout)
        if message is not None and message.arbitration_id == canopen_frames.TPDO2 + 1 and not asked:
            (counts,) = canopen_frames.POSITION.unpack(message.data)
            message.data[:] = canopen_frames.POSITION.pack(counts + next(flicker))
        return message

    rig.bus.recv = recv  # type: ignore[method-assign]
    rig.enable()
    begin(rig, 40)
    rig.order("stop")
    while rig.mode is not Mode.HOLDING:
        rig.cycle()
        held += [bytes(message.data) for message in rig.sent if message.arbitration_id == canopen_frames.RPDO2 + 1]
        if any(
            m.arbitration_id == canopen_frames.SDO_REQUEST + 1 and m.data[:5] == b"\x2f\x60\x60\0\x08" for m in rig.sent
        ):
            asked.append(len(held))  # the setpoint of this cycle goes out after the request
    (since,) = asked
    # Those of this cycle, of the two SYNCs before it, and of the one at which the drive's place was read.
    assert len(set(held[since - 4 :])) == 1
    assert held[since - 5] != held[since - 4]


def test_goals_that_have_not_begun_are_stopped_by_homing(rig: Rig) -> None:
    """They would begin from another place than they were meant to."""
    rig.enable()
    is_homed(rig)
    Meddler(rig).delays = [50]
    for number in range(2):
        rig.post(f"g{number}", PoseGoal(0.01, 0.0, 0.0))
    begin(rig)
    assert rig.outcomes() == [("g0", "stopped"), ("g1", "stopped")]
    rig.until(rig.holds, 20_000)
    assert rig.outcomes() == [("g0", "stopped"), ("g1", "stopped")]


def test_after_a_stop_no_other_drive_is_begun(rig: Rig) -> None:
    rig.enable()
    begin(rig, 100)
    assert modes(rig) == [6, 8, 8]
    rig.order("stop")
    while rig.mode is not Mode.HOLDING:
        rig.cycle()
        assert modes(rig)[1:] == [8, 8]


def test_a_stop_when_the_last_drive_is_home_comes_too_late(rig: Rig) -> None:
    rig.enable()
    begin(rig)
    rig.until(lambda: rig.drives[2].homing.attained)
    assert isinstance(rig.command("stop"), CommandDone)
    assert rig.mode is Mode.HOLDING
    assert rig.control.measured.homed
    settled(rig)
    assert isinstance(rig.goal("g1", 0.02, 0.01, 0.1), Accepted)


@pytest.mark.parametrize("when", WHEN)
@pytest.mark.parametrize("cause", ["quick_stop", "emergency", "silent"])
def test_a_fault_stops_it_at_once_and_it_can_begin_again(rig: Rig, cause: str, when: int) -> None:
    rig.enable()
    begin(rig, when)
    if cause == "quick_stop":
        rig.cycle(CommandRequest(7, "ann", Command.QUICK_STOP))
    elif cause == "emergency":
        rig.drives[1].fail(0x4310)
    else:
        rig.drives[2].silent = True
    rig.until(lambda: rig.mode is Mode.FAULT, 4)
    words = {m.arbitration_id - canopen_frames.RPDO1 for m in rig.sent if m.data[:2] == b"\x02\x00"}
    assert words == {1, 2, 3}
    assert not any(m.arbitration_id & 0x780 == canopen_frames.RPDO2 for m in rig.sent)
    rig.cycles(400)  # one that does not hear has stopped by its own watch on SYNC
    rig.drives[2].silent = False
    rig.cycles(150)  # it tells its state from time to time
    rig.until(lambda: not rig.control.measured.unready)  # and is configured again, where it was silent
    assert not any(drive.state is PowerState.OPERATION_ENABLED for drive in rig.drives)
    assert not any(drive.servo.velocity for drive in rig.drives)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.enable()
    settled(rig)
    is_homed(rig)


@pytest.mark.parametrize("when", WHEN)
def test_drives_that_show_their_mode_only_with_power_return_from_a_homing_that_was_broken_off(
    robots: Robots, monkeypatch: pytest.MonkeyPatch, when: int
) -> None:
    """Without power, they still show the mode of homing."""
    rig = robots(incremental())
    monkeypatch.setattr(MakersRules, "shows_mode_with_power_alone", property(lambda _: True))
    for axis in cast(Cia402, rig.driver)._axes:
        axis.exchange = replace(axis.exchange, mode_shown=False)
    rig.enable()
    begin(rig, when)
    rig.cycle(CommandRequest(7, "ann", Command.QUICK_STOP))
    rig.until(lambda: rig.mode is Mode.FAULT, 4)
    rig.cycles(400)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.enable()
    settled(rig)
    is_homed(rig)


def test_no_drive_gets_power_in_homing_mode(rig: Rig) -> None:
    rig.enable()
    begin(rig, 100)
    rig.command("quick_stop")
    rig.command("reset")
    assert modes(rig) == [6, 8, 8]
    rig.drives[0].objects.on_write(0x6060, lambda entry, old: None)  # takes no mode any more
    answer = refusal(rig.command("enable"))
    assert "drive A: homing: object 6061:00 (Modes of operation display): expected 8, found 6" in answer.message
    assert all(drive.state is PowerState.SWITCH_ON_DISABLED for drive in rig.drives)


def test_a_homing_error_is_named(rig: Rig) -> None:
    rig.enable()
    begin(rig, 100)
    rig.drives[0].homing.failed = True
    rig.drives[0].homing.interrupt()
    rig.until(lambda: rig.mode is Mode.FAULT, 50)
    assert "drive A: homing: the drive reports a homing error (statusword" in (rig.control.fault or "")


def test_an_object_that_is_not_answered_about_is_waited_for_until_its_time_is_over() -> None:
    """Then what is asked for beside it, as the state of a drive that sends no PDO, has its turn again."""
    drives = incremental().drives
    sent: list[Frame] = []
    a, b, c = (
        Cia402Axis(name, drive.node, scale_of(name, drive), drives)
        for name, drive in zip("ABC", drives.each, strict=True)
    )
    homing = HomingSequence((a, b, c), drives, sent.append)
    homing.start()
    assert homing.step(10.0) is None
    a.syncs += SETPOINT_SYNCS
    for now in (10.0, 10.0 + drives.sdo_timeout - 1e-6):
        assert homing.step(now) is None
        assert a.sdo_asked == (0x6060).to_bytes(2, "little")
    fault = homing.step(10.0 + drives.sdo_timeout)
    assert fault is not None
    assert "drive A: homing: no answer for object 6060:00" in fault.message
    assert a.sdo_asked is None
    assert len(sent) == 1
    assert not homing.under_way


def test_homes_outside_the_limits_are_warned_of(robots: Robots) -> None:
    outside = inverse(geometry(CONFIG.geometry), np.array([0.2, 0.0, 0.0])).position.tolist()
    rig = robots(changed(incremental(homes=outside), start=[value + 0.002 for value in outside]))
    rig.enable()
    begin(rig)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert any("the robot is outside its limits, and only motion back" in said.message for said in rig.notices)


# ---------------------------------------------------------------------- what is refused


def test_absolute_encoders_need_none(robots: Robots) -> None:
    rig = robots()
    for mode in (Mode.DISABLED, Mode.HOLDING):
        if mode is Mode.HOLDING:
            rig.enable()
        answer = refusal(rig.command("home"))
        assert (answer.code, answer.message) == ("nothing_to_home", "the encoders are absolute: homing is not needed")


def test_goals_and_homing_in_the_wrong_mode(rig: Rig) -> None:
    assert refusal(rig.command("home")).code == "not_enabled"
    rig.enable()
    assert refusal(rig.goal("g1", 0.0, 0.0, 0.1)).code == "not_homed"
    begin(rig)
    assert refusal(rig.goal("g2", 0.0, 0.0, 0.1)).code == "homing"
    rig.until(lambda: rig.mode is Mode.HOLDING)
    rig.goal("g3", 0.05, 0.0, 0.0)
    assert refusal(rig.command("home")).code == "moving"
    assert rig.outcomes()[:2] == [("g1", "rejected"), ("g2", "rejected")]


def test_a_robot_that_does_not_know_where_it_is_holds(rig: Rig) -> None:
    """Its counts may belong to no pose at all."""
    rig.enable()
    rig.cycles(500)
    assert rig.mode is Mode.HOLDING
    settled(rig)
    assert np.max(np.ptp(rig.setpoints()[:, 0], axis=0)) < 1e-12


# ---------------------------------------------------------------------- by a master that this project did not write


class Shared(SimulatedBus):
    """The simulated bus for a master with a thread of its own."""

    def __init__(self, drives: list[SimulatedDrive]) -> None:
        self._lock = threading.Lock()
        super().__init__(drives, time.monotonic, Faults(drives, [1.0] * len(drives), {}))

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        with self._lock:
            super().send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        end = time.monotonic() + (timeout or 0.0)
        while True:
            with self._lock:
                message = super().recv(0.0)
            if message is not None or time.monotonic() >= end:
                return message
            time.sleep(0.0005)


@pytest.mark.parametrize("method", [19, 37])
def test_a_stock_canopen_master_homes_the_simulated_drive(method: int) -> None:
    servo = Servo(0, time_constant=0.0, max_velocity=1e6, max_acceleration=1e8)
    drive = SimulatedDrive(5, servo, home_switch=2000)
    network = canopen.Network(Shared([drive]))
    network.connect()
    try:
        node = BaseNode402(5, str(SERVO))  # type: ignore[no-untyped-call]
        network.add_node(node)
        node.sdo.RESPONSE_TIMEOUT = WITHIN
        for name in ("SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE"):
            setattr(node, f"TIMEOUT_{name}", WITHIN)  # a busy machine may take its time
        node.sdo[0x6098].raw = method
        node.sdo[0x6099][1].raw = 50_000
        node.sdo[0x6099][2].raw = 10_000
        node.sdo[0x609A].raw = 2_000_000
        node.state = "SWITCH ON DISABLED"
        assert node.homing(timeout=WITHIN)  # type: ignore[no-untyped-call]
        assert node.sdo[0x6041].raw & 0x3400 == 0x1400
        assert node.op_mode == "HOMING"
        assert node.sdo[0x6064].raw <= 0  # behind the edge; how far is up to how often the machine lets it move
        node.state = "SWITCH ON DISABLED"
    finally:
        network.disconnect()
