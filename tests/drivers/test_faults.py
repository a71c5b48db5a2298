"""The fault matrix: every fault on demand in every mode; what stops the robot, how soon, and what does not."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import NamedTuple

import can
import numpy as np
import pytest
from _pytest.mark import ParameterSet
from conftest import Rig, changed
from control_rig import CONFIG
from drivers.test_homing import incremental
from generated import thinned
from msgspec import structs
from trirail.config import Config
from trirail.control.cycle import MAX_DISTANCE_STEPS
from trirail.wire.packets import CommandDone, CommandRequest, Refused
from trirail.wire.vocabulary import Command, Mode
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.interface import PowerState

REAL = changed(CONFIG, missed_syncs=3)
"""Drives that miss SYNC as soon as real ones do."""
PERIOD = REAL.period
NODES = (1, 2, 3)
RAMP = 100
"""Cycles in which every motion here ends by the quick-stop ramp: 0.5 m/s at 10 m/s² takes 50."""
LONG = 350
INCREMENTAL = changed(incremental(), missed_syncs=3)
"""The same with drives that are to be homed."""


class FaultRig(Rig, ABC):
    """A robot whose faults come and go; how its drives are told depends on what they speak."""

    @property
    def nodes(self) -> set[int]:
        return {drive.node for drive in self.config.drives.each}

    def faulty(self) -> bool:
        return self.mode is Mode.FAULT

    def stands(self) -> bool:
        return all(
            drive.power is not PowerState.OPERATION_ENABLED and drive.servo.velocity == 0.0 for drive in self.bus.drives
        )

    @abstractmethod
    def told_to_stop(self) -> set[int]:
        """Nodes that were told in the last cycle to stop at once."""

    @abstractmethod
    def assert_no_jump(self) -> None:
        """No setpoint that was sent is a step."""

    def inject(self, line: str) -> None:
        self.bus.faults.add(line)

    def mend(self) -> None:
        """Take every cause away."""
        self.bus.faults.clear()


class Cia402Rig(FaultRig):
    """Keeps every setpoint that appeared on the bus, and whether its drive was enabled then.

    Drives that move by themselves take none: not a number.
    """

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.targets: dict[int, list[tuple[float, bool]]] = {node: [] for node in NODES}

    def _note(self, message: can.Message, timeout: float | None = None) -> None:
        super()._note(message, timeout)
        node = message.arbitration_id - canopen_frames.RPDO2
        if node in NODES:
            drive = self.drives[node - 1]
            enabled = drive.state is PowerState.OPERATION_ENABLED
            target = (
                canopen_frames.SETPOINT.unpack(message.data)[0] if drive.objects[0x6061, 0].value == 8 else math.nan
            )
            self.targets[node].append((target, enabled))

    def told_to_stop(self) -> set[int]:
        """By the quick stop command."""
        stop = canopen_frames.CONTROLWORD.pack(canopen_frames.QUICK_STOP)
        return {m.arbitration_id - canopen_frames.RPDO1 for m in self.sent if bytes(m.data) == stop}

    def assert_no_jump(self) -> None:
        """No step is above the velocity limit, and none of an enabled drive changes by more than the acceleration.

        But for one back from where no slider can be: it is that of a drive without power.
        """
        limits, counts = self.config.limits.slider, self.config.drives.A.counts_per_metre
        rounding = 2.0 / counts / PERIOD
        for targets in self.targets.values():
            position = np.array([target for target, _ in targets]) / counts
            enabled = np.array([enabled for _, enabled in targets])
            velocity = np.diff(position) / PERIOD
            back = ~(enabled[1:] | enabled[:-1]) & (
                np.abs(np.diff(position)) > MAX_DISTANCE_STEPS * limits.velocities[0] * PERIOD
            )
            assert np.nanmax(np.abs(velocity[~back])) <= limits.velocities[0] * 1.001 + rounding
            always = enabled[2:] & enabled[1:-1] & enabled[:-2]
            acceleration = np.diff(velocity)[always] / PERIOD
            assert np.nanmax(np.abs(acceleration)) <= limits.accelerations[0] * 1.001 + 2.0 * rounding / PERIOD


def holding(rig: FaultRig) -> None:
    rig.enable()
    rig.cycles(50)
    assert rig.mode is Mode.HOLDING


def moving(rig: FaultRig) -> None:
    rig.enable()
    rig.goal("g1", 0.08, 0.08, 0.3)
    rig.cycles(150)
    assert rig.mode is Mode.MOVING
    assert min(abs(velocity) for velocity in rig.control.measured.velocity) > 0.2


def stopping(rig: FaultRig) -> None:
    moving(rig)
    rig.cycle(CommandRequest(0, "ann", Command.STOP, None))
    assert rig.mode is Mode.STOPPING


def homing(rig: FaultRig) -> None:
    holding(rig)
    rig.cycle(CommandRequest(0, "ann", Command.HOME))
    rig.cycles(100)
    assert rig.mode is Mode.HOMING
    assert rig.control.measured.feedback.follows == (False, True, True)
    assert rig.drives[0].servo.velocity != 0.0


class Begin(NamedTuple):
    """How to get into a mode, and how what is under way then ends."""

    enter: Callable[[FaultRig], None]
    faulted: tuple[tuple[str, str], ...] = ()
    """Goals and their ends where a fault comes."""
    otherwise: tuple[tuple[str, str], ...] = ()
    """Goals and their ends where none comes."""
    config: Config = REAL


MODES = {
    "holding": Begin(holding),
    "moving": Begin(moving, (("g1", "faulted"),), (("g1", "done"),)),
    "stopping": Begin(stopping, (("g1", "stopped"),), (("g1", "stopped"),)),
    "homing": Begin(homing, config=INCREMENTAL),
}
"""One more mode is one more line."""


IN_MOTION = ("moving", "stopping")
NOT_HOMING = ("holding", *IN_MOTION)


class Case(NamedTuple):
    """A fault that stops the robot."""

    line: str
    within: int
    """Cycles from the fault to the stop of all three drives."""
    reason: str
    """Pattern of what is said: drive, cause, code."""
    modes: tuple[str, ...] = tuple(MODES)
    """Where it makes a difference: a slider that is stuck holds well."""
    stands: int = RAMP
    """Cycles from there to standstill."""
    lasts: bool = True
    """Whether it can be seen without power: then a reset is refused while it lasts."""
    curable: bool = True
    """Whether a reset helps once the cause is gone."""


STOP = [
    # frames that do not come, come late or come wrong
    Case("A drop tpdo2", 3, r"drive A: no position for 3 cycles in a row"),
    Case("B drop tpdo1", 400, r"drive B: no statusword for 0\.3\d* s"),
    Case("C drop heartbeat", 400, r"drive C: no heartbeat for 0\.3\d* s"),
    Case("A drop sync", 4, r"drive A: (no position for 3 cycles|emergency 0x8700)"),
    Case("all drop sync", 4, r"drive A: (no position for 3 cycles|emergency 0x8700)"),
    Case("B drop rpdo2", 150, r"slider B: following error", IN_MOTION, lasts=False),
    Case("B drop 0x77E", 400, r"drive B: emergency 0x8130"),
    Case("A delay 0.01 tpdo2", 3, r"drive A: no position for 3 cycles in a row", lasts=False),
    Case("A delay 0.05 rpdo2", 60, r"slider A: following error", IN_MOTION, lasts=False),
    Case("C corrupt tpdo2", 30, r"slider C: following error", lasts=False),
    Case("C corrupt rpdo2", 60, r"(slider C: following error|drive C: emergency 0x8611)", lasts=False),
    Case("B corrupt tpdo1", 400, r"drive B: (statusword \w{4} is|left operation|does not follow|fault)", lasts=False),
    Case("A dlc 3 tpdo2", 1, r"drive A: frame 281 has wrong length 3"),
    Case("A dlc 8 tpdo2", 1, r"drive A: frame 281 has wrong length 8"),
    Case("A dlc 1 tpdo1", 110, r"drive A: frame 181 has wrong length 1"),
    Case("A dlc 0 heartbeat", 110, r"drive A: frame 701 has wrong length 0"),
    Case("B dlc 7 rpdo2", 2, r"drive B: emergency 0x8210 .*, error register 0x11; find the other node"),
    Case("B dlc 1 sync", 1, r"drive B: emergency 0x8240 .*, error register 0x11; find the other node"),
    # drives
    Case("C silent", 3, r"drive C: no position for 3 cycles in a row"),
    Case("all silent", 3, r"drive A: no position for 3 cycles in a row"),
    Case("B emcy 4310 for 5", 1, r"drive B: emergency 0x4310 \(drive too hot\), error register 0x09; let it cool"),
    Case("B fault 2310 for 5", 1, r"drive B: emergency 0x2310 .*, error register 0x03; check motor"),
    Case("A stuck", 60, r"slider A: following error", IN_MOTION, lasts=False),
    Case("A lag 0.1", 100, r"slider A: following error", IN_MOTION, lasts=False),
    Case("C runaway 0.1", 100, r"slider C: following error", stands=1100, lasts=False),
    Case("C runaway -0.1", 100, r"slider C: following error", stands=1100, lasts=False),
    Case("B reboot", 1, r"drive B: has restarted and lost its set-up: wait until the drive", lasts=False),
    # the bus
    Case("bus-off", 1, r"CAN bus .* is down: bus-off"),
    Case("babble 001", 3, r"drive A: no position for 3 cycles in a row"),
]
STOP_HOMING = [
    Case("A stuck", 5500, r"drive A: homing: home was not reached within 5 s", lasts=False),
    Case("A runaway 0.001", 5500, r"drive A: homing: home was not reached within 5 s", stands=1100, lasts=False),
    Case("A drop 0x581", 2000, r"drive A: homing: no answer for object 60\w\w:00", lasts=False),
    Case("A drop 0x601", 2000, r"drive A: homing: no answer for object 60\w\w:00", lasts=False),
    Case("A corrupt tpdo2", 2000, r"slider A: following error", lasts=False),
]
"""Faults of the drive that is being homed."""


def begin(rig: FaultRig, mode: str, line: str) -> Begin:
    begun = MODES[mode]
    begun.enter(rig)
    rig.inject(line)
    return begun


def tried(mode: str, *more: object) -> ParameterSet:
    """Begin in this mode: of all of them, `make test` has motion alone."""
    return pytest.param(mode, *more, marks=() if mode == "moving" else pytest.mark.long)


@pytest.fixture
def mode() -> str:
    """Without a mode to begin in."""
    return "holding"


@pytest.fixture
def rig(mode: str) -> Iterator[Cia402Rig]:
    made = Cia402Rig(MODES[mode].config)
    yield made
    made.bus.shutdown()


@pytest.mark.parametrize(
    ("mode", "case"),
    [*(tried(mode, case) for case in STOP for mode in MODES), *(tried("homing", case) for case in STOP_HOMING)],
    ids=lambda value: value.line if isinstance(value, Case) else value,
)
def test_a_fault_stops_all_three_drives(rig: Cia402Rig, case: Case, mode: str) -> None:
    begun = begin(rig, mode, case.line)
    if mode in case.modes:
        assert_stops_until_reset(rig, case, begun)
    else:
        rig.cycles(LONG)
        assert rig.mode in (Mode.HOLDING, Mode.HOMING)


def assert_stops_until_reset(rig: FaultRig, case: Case, begun: Begin) -> None:
    """The fault stops all three in the cycle in which it is noticed; its reason stays, and it goes when it may."""
    rig.until(rig.faulty, case.within + 1)
    assert rig.told_to_stop() == rig.nodes
    reason = rig.control.fault
    assert reason is not None
    assert re.match(case.reason, reason)

    rig.until(rig.stands, case.stands)
    rig.cycles(LONG)
    assert rig.stands()
    assert rig.faulty()
    assert rig.control.fault == reason
    assert isinstance(rig.goal("g2", 0.0, 0.0, 0.0), Refused)

    if case.lasts:
        answer = rig.command("reset")
        assert isinstance(answer, Refused)
        assert (
            "the cause of the fault persists" in answer.message or "according to the last statusword" in answer.message
        )
        assert rig.faulty()
    rig.mend()
    rig.cycles(LONG)
    rig.until(lambda: not rig.control.measured.unready)
    assert isinstance(rig.command("reset"), CommandDone) is case.curable
    assert rig.stands()
    if case.curable:
        rig.enable()
        if not rig.control.measured.homed:
            assert isinstance(rig.command("home"), CommandDone)
        rig.goal("g3", 0.01, 0.0, 0.0)
        rig.until(lambda: rig.mode is Mode.HOLDING)
    expected = [*begun.faulted, ("g2", "rejected"), *([("g3", "done")] if case.curable else [])]
    assert rig.outcomes() == expected
    rig.assert_no_jump()


GO_ON = [
    *(f"A duplicate {kind} for 1 frames" for kind in ("sync", "rpdo2", "tpdo2", "tpdo1", "heartbeat")),
    *(f"B drop {kind} for 1 frames" for kind in ("sync", "rpdo2", "tpdo2", "tpdo1", "heartbeat", "0x77E")),
    "B drop tpdo2 for 2 frames",
    "all drop tpdo2 for 3 frames",
    "C drop heartbeat for 2 frames",
    "A duplicate",
    "A delay 0.0005 tpdo2",
    "A delay 0.0015 tpdo2",
    "all delay 0.0005 tpdo2",
    "B delay 0.0005 rpdo2",
    "A delay 0.05 heartbeat",
    "with 0.1 all delay 0.0005 tpdo2",
    "with 0.02 all drop rpdo2",
    "error-passive",
    "babble 7FF",
]


@pytest.mark.parametrize("mode", [*map(tried, MODES)])
@pytest.mark.parametrize("line", GO_ON)
def test_what_does_not_stop_the_robot(rig: Cia402Rig, line: str, mode: str) -> None:
    assert_goes_on(rig, begin(rig, mode, line))


def assert_goes_on(rig: FaultRig, begun: Begin, cycles: int = 800) -> None:
    """What is under way ends as if nothing had happened, and nothing happens in so many cycles."""
    rig.cycles(cycles)
    rig.until(rig.holds)
    assert [said.message for said in rig.notices if said.kind == "fault"] == []
    assert rig.control.measured.homed
    assert tuple(rig.outcomes()) == begun.otherwise
    rig.assert_no_jump()


def by_hand(rig: Cia402Rig, index: int, metres: float) -> None:
    """Move a slider that has no power."""
    drive = rig.drives[index]
    drive.servo.position += metres * rig.config.drives.A.counts_per_metre
    drive.servo.setpoint = drive.servo.position
    drive.objects[0x6064, 0].value = round(drive.servo.position)


def test_a_position_that_jumps_for_a_cycle_moves_no_setpoint(rig: Cia402Rig) -> None:
    rig.cycles(3)
    poses = []
    for moved in (0.1, -0.1, 0.0, 0.0):
        by_hand(rig, 0, moved)
        rig.cycle()
        poses.append(rig.control.measured.pose)
    assert {target for target, _ in rig.targets[1]} == {0}
    assert np.array(poses) == pytest.approx(np.zeros((4, 3)), abs=1e-9)


@pytest.mark.parametrize("before", ["new", "disable", "quick_stop"])
@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("metres", [0.03, -0.01])
@pytest.mark.parametrize("cycles", thinned([1, 2, 100], every=3))
def test_a_position_that_jumps_without_power_and_stays_is_reported_once(
    rig: Cia402Rig, before: str, index: int, metres: float, cycles: int
) -> None:
    if before != "new":
        rig.enable()
        rig.command(before)
        rig.cycles(100)
    rig.cycles(3)
    last = rig.control.measured.feedback.position[index]
    by_hand(rig, index, metres)
    rig.cycles(cycles)
    if cycles < 100:  # one or two wrong frames
        by_hand(rig, index, -metres)
    rig.cycles(20)
    moved = [notice for notice in rig.notices if notice.event_code == "slider_moved"]
    assert len(moved) == (cycles == 100)
    for notice in moved:
        assert notice.level == "warning"
        places = notice.params["position_before"], notice.params["position"]
        assert places == pytest.approx((last, last + metres), abs=1e-6)


def test_a_slider_moved_by_hand_is_followed_without_a_jump_before_it_is_enabled(rig: Cia402Rig) -> None:
    rig.cycles(3)
    for index in range(3):
        by_hand(rig, index, 0.02)
    rig.cycles(2)
    answer = rig.command("enable")
    assert isinstance(answer, Refused)
    assert answer.code == "not_at_rest"
    rig.cycles(30)
    rig.enable()
    rig.cycles(10)
    assert rig.control.measured.feedback.position == pytest.approx((0.02, 0.02, 0.02), abs=1e-6)
    rig.assert_no_jump()


def test_the_pose_is_found_again_after_sliders_that_belong_to_none(rig: Cia402Rig) -> None:
    for step in [8e-4] * 400 + [-8e-4] * 400:
        for index in range(3):
            by_hand(rig, index, step)
        rig.cycle()
    rig.cycles(3)
    assert rig.control.measured.pose == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("command", ["disable", "quick_stop"])
@pytest.mark.parametrize("before", ["disable", "quick_stop"])
@pytest.mark.long
def test_a_drive_under_local_control_that_has_power_is_named_and_commands_are_answered(
    rig: Cia402Rig, before: str, command: str
) -> None:
    holding(rig)
    rig.command(before)
    rig.cycles(1200)
    drive = rig.drives[1]
    drive.objects.on_write(0x6040, lambda entry, old: None)
    drive.state = PowerState.OPERATION_ENABLED
    rig.cycles(1300)
    assert rig.mode is Mode.FAULT
    fault = rig.control.measured.feedback.fault
    assert fault is not None
    assert fault.message.startswith("drive B: is operation enabled 1 s after it got power by itself")
    answer = rig.command(command)
    assert isinstance(answer, Refused)
    assert fault.message in answer.message


def test_a_drive_that_does_not_leave_its_fault_is_not_reset(rig: Cia402Rig) -> None:
    holding(rig)
    rig.drives[1].fail(0x2310)
    rig.until(rig.stands)
    rig.cycle()  # a reset is decided by what the drives have said before
    rig.drives[1].objects.on_write(0x6040, lambda entry, old: None)
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    assert "drive B: fault, error 0x2310 (continuous overcurrent of the motor)" in answer.message


@pytest.mark.parametrize(("missed_positions", "within"), [(3, 0.3), (300, 0.3), (600, 0.6)])
def test_statuswords_may_be_missing_for_as_long_as_positions(missed_positions: int, within: float) -> None:
    drives = structs.replace(REAL.drives, missed_positions=missed_positions)
    rig = Cia402Rig(structs.replace(REAL, drives=drives))
    holding(rig)
    rig.inject("B drop tpdo1")
    cycles = rig.until(rig.faulty, 800)
    assert within - 0.1 <= cycles * PERIOD <= within + 0.15  # the last one came up to 0.1 s ago
    assert rig.control.fault is not None
    assert "drive B: no statusword" in rig.control.fault
    rig.bus.shutdown()


def test_a_warning_of_the_bus_is_an_event(rig: Cia402Rig) -> None:
    rig.inject("error-passive")
    rig.cycles(10)
    told = [said.message for said in rig.notices if said.level == "warning"]
    assert len(told) == 1
    assert "error-passive: 128 transmit errors; check cable" in told[0]
