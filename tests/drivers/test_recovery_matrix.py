"""Drives that lose their supply and come back, over every protocol: which, when, for how long, and what comes back.

Each row ends in holding after reset and enable, or in a refusal that names the reason. Nothing moves before a goal.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

import numpy as np
import pytest
from conftest import changed
from control_rig import CONFIG
from drivers.test_faults import INCREMENTAL
from drivers.test_odrive import odrives
from drivers.test_recovery import ENDS, RecoveryRig, disabled, holding
from numpy.typing import NDArray
from trirail.config import Config
from trirail.wire.packets import CommandDone, Refused
from trirail.wire.vocabulary import Mode
from trirail_drivers.interface import PowerState
from trirail_drivers.odrive.cansimple import Error
from trirail_drivers.odrive.protections import WATCHDOG
from trirail_drivers.simulated import SimulatedDrive, SimulatedOdrive

pytestmark = pytest.mark.usefixtures("absolute_odrives")

REAL = changed(CONFIG, missed_syncs=3)
STILL: Final = 1e-6
"""A slider that moves by less than this does not move [m]: a servo settles, and counts are whole."""
COARSE: Final = 0.25
"""Cycle in which long absences pass [s]: shorter than three heartbeats."""
SHORT, LONG = 0.2, 600.0


class Row(NamedTuple):
    """One recovery."""

    protocol: str
    drives: tuple[int, ...]
    when: str
    """The mode, or "configuring", in which they are lost."""
    away: float
    """For how long [s]."""
    back: str
    """What comes back."""

    def __str__(self) -> str:
        names = "".join("ABC"[drive] for drive in self.drives)
        return f"{self.protocol} {names} {self.when} {self.away:g}s {self.back}"


class MatrixRig(RecoveryRig):
    """Watches that nothing gets power or moves, once all drives stand without power in a fault."""

    def __init__(self, config: Config) -> None:
        self.stood: NDArray[np.float64] | None = None
        """Positions in which the sliders stand [m]; None where they may move."""
        super().__init__(config)

    @property
    def places(self) -> NDArray[np.float64]:
        scale = np.array([drive.counts_per_metre for drive in self.config.drives.each])
        turned: NDArray[np.float64] = np.array([drive.servo.position for drive in self.bus.drives]) / scale
        return turned

    def watch(self) -> None:
        """From now on nothing moves."""
        self.until(lambda: not any(drive.servo.velocity for drive in self.bus.drives))
        self.assert_unpowered()
        self.stood = self.places

    def wait(self, seconds: float) -> None:
        """Let so much time pass, in as few cycles as three heartbeats allow where it is long."""
        short = min(seconds, 1.5)
        self.cycles(round(short / self.config.period))
        for _ in range(round((seconds - short) / COARSE)):
            self.now += COARSE - self.config.period
            self.cycle()

    def cycle(self, *given: object, **named: object) -> None:
        super().cycle(*given, **named)  # type: ignore[arg-type]
        if self.stood is not None:
            assert self.places == pytest.approx(self.stood, abs=STILL)


def enabling(rig: RecoveryRig) -> None:
    rig.order("enable")
    rig.cycles(1)
    assert rig.mode is Mode.ENABLING


def homing(rig: RecoveryRig) -> None:
    holding(rig)
    rig.order("home")
    rig.cycles(100)
    assert rig.mode is Mode.HOMING


def moving(rig: RecoveryRig) -> None:
    holding(rig)
    rig.goal("g1", 0.03, 0.02, 0.05, speed=0.3)
    rig.cycles(100)
    assert rig.mode is Mode.MOVING


def stopping(rig: RecoveryRig) -> None:
    moving(rig)
    rig.order("stop")
    assert rig.mode is Mode.STOPPING


def fault(rig: RecoveryRig) -> None:
    holding(rig)
    rig.order("quick_stop")
    rig.cycles(100)
    assert rig.mode is Mode.FAULT


def configuring(rig: RecoveryRig) -> None:
    """All three are being configured."""
    disabled(rig)
    rig.cut(0, 1, 2)
    rig.cycles(300)
    rig.supply(0, 1, 2)
    rig.until(lambda: bool(rig.asked))


WHEN: dict[str, Callable[[RecoveryRig], None]] = {
    each.__name__: each for each in (disabled, enabling, homing, holding, moving, stopping, fault, configuring)
}
STEPS: Final = {"cia402": 800, "odrive": 150}
"""Cycles that the configuration of three drives takes, or some more."""
SAME, TWICE, AGAIN = "same", "boots twice", "lost again"
OTHERS: Final = {
    ("cia402", "other serial number"): "the drive has been replaced: serial number",
    ("cia402", "other firmware"): "the drive has been replaced: revision",
    ("cia402", "lost settings"): "",
    ("odrive", "other serial number"): "the drive has been replaced: serial number",
    ("odrive", "other firmware"): "the drive has been replaced: firmware 0.6.9, was 0.6.10",
    ("odrive", "lost settings"): f"enable_watchdog, its stop when the host is silent: {WATCHDOG} is False",
}
"""What is said of a drive that comes back otherwise; "" where it is set up all the same."""
BACK: Final = (SAME, TWICE, AGAIN, *dict.fromkeys(back for _, back in OTHERS))
DRIVES: Final = tuple(chosen for n in (1, 2, 3) for chosen in itertools.combinations(range(3), n))
ROWS: Final = [
    Row(protocol, drives, when, away, back)
    for protocol, when, back, drives, away in itertools.product(STEPS, WHEN, BACK, DRIVES, (SHORT, LONG))
    if (protocol, when) != ("odrive", "homing")
]


def change(rig: RecoveryRig, index: int, back: str, *, undo: bool = False) -> None:
    """Have another drive, or one of other settings, in the place of one."""
    drive, step = rig.bus.drives[index], -1 if undo else 1
    if isinstance(drive, SimulatedOdrive):
        match back:
            case "other serial number":
                drive.serial += step
            case "other firmware":
                major, minor, revision = drive.version.firmware
                drive.version = drive.version._replace(firmware=(major, minor, revision - step))
            case "lost settings":
                drive.settings[WATCHDOG] = undo
    elif isinstance(drive, SimulatedDrive) and not undo:  # its restart has brought all objects back
        match back:
            case "other serial number":
                drive.objects[0x1018, 4].value += step
            case "other firmware":
                drive.objects[0x1018, 3].value += step
            case "lost settings":
                drive.objects[0x6085, 0].value += step
                drive.objects[0x605A, 0].value = 0


def play(row: Row, seed: int) -> None:
    draw = random.Random(seed)
    robot = INCREMENTAL if row.when == "homing" else REAL
    rig = MatrixRig(odrives(robot) if row.protocol == "odrive" else robot)
    WHEN[row.when](rig)
    if row.when == "configuring":
        rig.cycles(draw.randrange(STEPS[row.protocol]))
    rig.cut(*row.drives)
    rig.wait(row.away)
    assert rig.mode is Mode.FAULT
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    rig.watch()
    said = OTHERS.get((row.protocol, row.back), "")
    for index in row.drives:
        rig.supply(index)
        change(rig, index, row.back)
        rig.cycles(draw.choice((0, 0, 7, 300)))
    if row.back == TWICE:
        rig.supply(*row.drives)
        rig.until(lambda: not rig.ready())  # it may have been configured already, and boots in a few cycles
    if row.back == AGAIN:
        rig.cycles(draw.randrange(STEPS[row.protocol]))
        rig.cut(*row.drives)
        rig.wait(SHORT)
        rig.supply(*row.drives)
    if said:
        refused_by_name(rig, row, said)
    rig.until(rig.ready, ENDS)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.assert_unpowered()
    begun = len(rig.rows)
    rig.enable()
    rig.cycles(50)
    assert rig.holds()
    assert np.ptp(np.array(rig.rows[begun:])[:, 0], axis=0).max() < STILL
    rig.bus.shutdown()


def refused_by_name(rig: MatrixRig, row: Row, said: str) -> None:
    """Each drive is refused by name; then what was there before comes back."""
    names = ["ABC"[index] for index in row.drives]

    def all_told() -> bool:
        told = rig.control.measured.unready
        return all(any(text.startswith(f"drive {name}") and said in text for text in told) for name in names)

    rig.until(all_told, ENDS)
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    assert said in answer.message
    assert f"drive {names[0]}" in answer.message
    assert f"drives.{names[0]}.a" in answer.message  # allow_replacement or accept_without
    assert rig.mode is Mode.FAULT
    rig.cut(*row.drives)
    rig.cycles(300)
    for index in row.drives:
        rig.supply(index)
        change(rig, index, row.back, undo=True)


def thinned(rows: Iterable[Row]) -> list[Row]:
    """Choose one row for each mode and what may come back, few of them long."""
    draw, groups = random.Random(0), dict[tuple[str, str], list[Row]]()
    for row in rows:
        if row.away == SHORT or draw.random() < 0.3:
            groups.setdefault((row.when, row.back), []).append(row)
    return [draw.choice(group) for group in groups.values()]


@pytest.mark.generated(*range(12))
def test_drives_come_back(seed: int) -> None:
    """Rows drawn of the whole matrix."""
    play(random.Random(seed).choice(ROWS), seed)


@pytest.mark.long
@pytest.mark.parametrize("row", thinned(ROWS), ids=str)
def test_drives_come_back_in_every_mode(row: Row) -> None:
    """Each mode with everything that may come back."""
    play(row, len(str(row)))


# ---------------------------------------------------------------------- Safe Torque Off, without a loss of supply

STO_CODE: Final = 0x5441
"""EMCY of a contactor, by which some drives tell of it."""


def take_torque(rig: RecoveryRig, index: int, *, told: bool) -> None:
    """Take the power of a drive's stage away; a CiA 402 drive may say so by EMCY."""
    drive = rig.bus.drives[index]
    if isinstance(drive, SimulatedOdrive):
        drive.fail(Error.ESTOP_REQUESTED)
    elif isinstance(drive, SimulatedDrive):
        if told:
            drive.errors.report(STO_CODE)
        drive._change(PowerState.SWITCH_ON_DISABLED)


def give_torque(rig: RecoveryRig, index: int) -> None:
    drive = rig.bus.drives[index]
    if isinstance(drive, SimulatedDrive):
        drive.errors.clear(STO_CODE)


@pytest.mark.generated(*range(8))
def test_safe_torque_off_needs_a_reset_and_an_enable(seed: int) -> None:
    """Nothing is configured again, for no drive has lost its supply."""
    draw = random.Random(seed)
    protocol = draw.choice(list(STEPS))
    rig = MatrixRig(odrives(REAL) if protocol == "odrive" else REAL)
    draw.choice((holding, moving, stopping))(rig)
    struck, told = draw.choice(DRIVES), draw.random() < 0.5
    for index in struck:
        take_torque(rig, index, told=told)
    rig.until(lambda: rig.mode is Mode.FAULT, 200)
    rig.cycles(400)
    rig.watch()
    name = "ABC"[struck[0]]
    reason = rig.control.fault or ""
    assert f"drive {name}" in reason
    expected = "ESTOP_REQUESTED" if protocol == "odrive" else f"{STO_CODE:04X}" if told else "left operation enabled"
    assert expected in reason
    for index in struck:
        give_torque(rig, index)
    rig.cycles(20)
    assert isinstance(rig.command("reset"), CommandDone)
    assert rig.asked == []
    rig.assert_unpowered()
    rig.enable()
    rig.cycles(50)
    assert rig.mode is Mode.HOLDING
    rig.bus.shutdown()
