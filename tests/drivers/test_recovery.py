"""Drives that lose their supply and come back: configured in the background, reset, enabled, without a restart."""

from __future__ import annotations

import errno
import math
import random
from collections.abc import Iterator
from itertools import pairwise

import can
import msgspec
import pytest
from conftest import Rig, changed
from control_rig import CONFIG
from drivers.test_homing import incremental
from drivers.test_odrive import odrives
from trirail.config import Config
from trirail.control.feedback import CAN_MOVE
from trirail.errors import RefusalCode
from trirail.wire.packets import CommandDone, Refused, Request
from trirail.wire.vocabulary import Mode
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.axis import ANSWER_TIME
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.driver.recovery import RETRY_AFTER, STEP_BITS
from trirail_drivers.interface import PowerState
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.flat_endpoints import KNOWN_TABLES, Version
from trirail_drivers.odrive.protections import ABSOLUTE_SETPOINTS, POSITION_STATUS, PROTECTIONS, RELATIVE_MODE, WATCHDOG
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import SimulatedOdrive
from trirail_drivers.simulated.device import Nmt

pytestmark = pytest.mark.usefixtures("absolute_odrives")

REAL = changed(CONFIG, missed_syncs=3)
ODRIVES = odrives(REAL)
ENDS = 8000
"""Cycles within which drives that are back are configured: the longest pause between two questions is 0.5 s."""
_SET_UP = {cansimple.GET_VERSION, cansimple.ADDRESS, cansimple.RX_SDO}
_POLLED = {bytes(canopen_frames.STATUSWORD_UPLOAD[:4]), bytes(canopen_frames.CONTROLWORD_DOWNLOAD)}


class RecoveryRig(Rig):
    """Watches that set-up is sent to drives without power only, one request in two cycles at most."""

    def __init__(self, config: Config = REAL) -> None:
        self.asked: list[int] = []
        """Cycles in which a request of a set-up was sent."""
        self.rows = []  # cycles are counted by them, and the set-up at the start sends before the first
        super().__init__(config)

    def _note(self, message: can.Message, timeout: float | None = None) -> None:
        if self.rows and self.mode is Mode.FAULT and self._is_set_up(message):
            self.asked.append(len(self.rows))
            self.assert_unpowered()
        super()._note(message, timeout)

    def _is_set_up(self, message: can.Message) -> bool:
        """Whether only set-up sends such a frame."""
        if self.config.drives.protocol == "odrive":
            return message.arbitration_id % 32 in _SET_UP
        node = message.arbitration_id - canopen_frames.SDO_REQUEST
        is_abort = bool(message.data) and message.data[0] == 0x80
        return 0 < node < 0x80 and not is_abort and bytes(message.data[:4]) not in _POLLED

    def cycle(self, request: Request | None = None) -> None:
        super().cycle(request)
        bits = self.config.period * self.config.can.bitrate
        assert all(later - earlier >= max(1, STEP_BITS / bits) for earlier, later in pairwise(self.asked[-3:]))

    def cut(self, *drives: int) -> None:
        """Take the supply away."""
        for index in drives:
            self.bus.drives[index].restart(self.now)  # a CiA 402 drive's brake holds its axis then
            self.bus.drives[index].silent = True

    def supply(self, *drives: int) -> None:
        """Give it back."""
        for index in drives:
            self.bus.drives[index].silent = False
            self.bus.drives[index].restart(self.now)

    def ready(self) -> bool:
        return self.mode is Mode.FAULT and not self.control.measured.unready and not self.control.measured.powered

    def recover(self) -> None:
        """Every drive is configured; reset, enable and a goal follow, and nothing has power before."""
        self.until(self.ready, ENDS)
        self.assert_unpowered()
        assert isinstance(self.command("reset"), CommandDone)
        self.assert_unpowered()
        self.enable()
        self.goal("after", 0.005, 0.0, 0.0)
        self.until(lambda: ("after", "done") in self.outcomes())
        assert self.mode is Mode.HOLDING

    def assert_unpowered(self) -> None:
        assert not any(drive.power in CAN_MOVE for drive in self.bus.drives)

    def said(self, words: str) -> list[str]:
        return [notice.message for notice in self.notices if words in notice.message]


def disabled(rig: Rig) -> None:
    rig.cycles(20)


def holding(rig: Rig) -> None:
    rig.enable()


def moving(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.05, 0.03, 0.1)
    rig.cycles(100)
    assert rig.mode is Mode.MOVING


@pytest.fixture
def config() -> Config:
    """CiA 402 drives, where a test does not ask for others."""
    return REAL


@pytest.fixture
def rig(config: Config) -> Iterator[RecoveryRig]:
    made = RecoveryRig(config)
    yield made
    made.bus.shutdown()


either = pytest.mark.parametrize("config", [REAL, ODRIVES], ids=["cia402", "odrive"])
"""The same over both protocols."""


def test_no_drive_is_configured_while_another_still_brakes_because_of_its_fault(rig: RecoveryRig) -> None:
    moving(rig)
    braking = rig.drives[1]
    braking.objects[0x6085, 0].value = round(braking.objects[0x6085, 0].value * 0.05)  # a long ramp
    braking.fail(0x2310)
    rig.cycles(2)
    rig.bus.faults.add("A reboot")
    rig.cycles(200)
    assert braking.state is PowerState.FAULT_REACTION_ACTIVE
    assert not rig.asked
    rig.until(rig.ready, ENDS)
    assert rig.asked


@pytest.mark.parametrize("after", [0, 60, 150])
@pytest.mark.long
def test_an_error_that_begins_during_the_set_up_of_a_returning_drive_is_reported_until_it_ends(
    rig: RecoveryRig, after: int
) -> None:
    holding(rig)
    rig.bus.faults.add("A reboot")
    rig.cycles(2)
    rig.until(lambda: bool(rig.asked))
    rig.cycles(after)
    assert rig.control.measured.unready
    rig.bus.faults.add("A emcy 7380 for 3")
    rig.until(rig.ready, ENDS)
    rig.command("reset")
    rig.cycles(600)
    assert rig.mode is Mode.FAULT
    assert "drive A: emergency 0x7380" in (rig.control.fault or "")
    rig.cycles(3000)
    rig.recover()


@either
def test_reset_is_refused_with_drive_and_progress(rig: RecoveryRig) -> None:
    counted, work, number, asked = {
        "cia402": ("objects", "configuring", 100, 20),
        "odrive": ("answers", "checking its settings", 15, 8),
    }[rig.config.drives.protocol]
    moving(rig)
    rig.cut(1)
    rig.cycles(10)
    rig.supply(1)
    rig.until(lambda: len(rig.asked) > asked)
    rig.cycles(1)
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    assert answer.code is RefusalCode.FAULT
    expected = rig.control.measured.feedback.unready[1]
    assert expected is not None
    assert expected.objects >= asked
    assert expected.expected > number
    assert f"the cause of the fault persists: drive B has restarted: {work} (" in answer.message
    assert f" of {expected.expected} {counted})" in answer.message
    rig.recover()
    assert rig.said(f"drive B has restarted: {work}") == [f"drive B has restarted: {work}", *rig.said("reset refused")]
    assert rig.said("drive B is configured") == [
        "drive B is configured, and so are the others: send reset, then enable"
    ]


@either
@pytest.mark.parametrize("away", [(1,), (0, 1, 2)], ids=["one", "all"])
@pytest.mark.long
def test_drives_return_to_a_slow_machine(away: tuple[int, ...], rig: RecoveryRig) -> None:
    """Every cycle is late, so that many frames of a drive arrive between two steps of its set-up."""
    holding(rig)
    rig.cut(*away)
    rig.cycles(20)
    rig.supply(*away)
    rig.driver._duration = lambda _: 2.0 * rig.config.period  # type: ignore[attr-defined]
    rig.until(rig.ready, 3 * ENDS)


def test_no_set_up_is_sent_while_another_drive_has_power(rig: RecoveryRig) -> None:
    """It has until stop_timeout to stop; where it keeps its power, nothing is configured, and reset says why."""
    holding(rig)
    rig.bus.faults.add("A runaway 0.05")
    rig.bus.faults.add("C drop rpdo1")
    rig.bus.faults.add("C drop sdo-request")
    rig.cut(1)
    rig.supply(1)
    rig.cycles(500)
    assert rig.drives[2].power is PowerState.OPERATION_ENABLED
    assert rig.asked == []
    assert "once no drive has power" in "; ".join(rig.control.measured.unready)
    rig.bus.faults.clear()
    rig.recover()


def test_a_drive_in_the_place_of_another_is_refused_by_name(rig: RecoveryRig) -> None:
    holding(rig)
    rig.cut(2)
    rig.cycles(200)
    rig.supply(2)
    rig.drives[2].objects[0x1018, 4].value += 1
    rig.until(lambda: bool(rig.said("the drive has been replaced: serial number")), ENDS)
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    assert "drive C: the drive has been replaced: serial number" in answer.message
    assert "allow_replacement" in answer.message
    asked = len(rig.asked)
    rig.cycles(round(0.9 * RETRY_AFTER / rig.config.period))
    assert len(rig.asked) == asked
    rig.cycles(round(RETRY_AFTER / rig.config.period))
    assert len(rig.asked) > asked
    assert rig.mode is Mode.FAULT
    rig.assert_unpowered()
    rig.cut(2)
    rig.cycles(200)
    rig.supply(2)  # the old one again
    rig.recover()


SCALING: dict[tuple[int, int], tuple[int, int, int, str]] = {
    (0x607E, 0): (8, 0xC0, 0, "polarity) is 00h, was C0h"),
    (0x608F, 1): (32, 4096, 1, "position encoder resolution) is 1, was 4096"),
    (0x6091, 1): (32, 10, 1, "gear ratio) is 1, was 10"),
    (0x6092, 2): (32, 2, 1, "feed constant) is 1, was 2"),
    (0x6097, 1): (32, 10, 1, "acceleration factor) is 1, was 10"),
    (0x60A8, 0): (32, 0x00AC_0000, 0x00B5_0000, "position unit) is 00B50000h, was 00AC0000h"),
    (0x60A9, 0): (32, 0xFFB5_0300, 0x00B5_0300, "velocity unit) is 00B50300h, was FFB50300h"),
    (0x60AA, 0): (32, 0xFFB5_5700, 0x00B5_5700, "acceleration unit) is 00B55700h, was FFB55700h"),
}
"""Length of an object, its value before the supply is lost and after, and what is said of it."""


@pytest.mark.parametrize("key", SCALING, ids=lambda key: f"{key[0]:04X}:{key[1]}")
@pytest.mark.long
def test_a_drive_that_lost_its_direction_or_scale_is_refused_until_it_is_as_it_was(
    rig: RecoveryRig, key: tuple[int, int]
) -> None:
    """Such as parameters that the manufacturer's tool has written but not saved: the drive would move otherwise."""
    bits, before, after, said = SCALING[key]
    drive = rig.drives[1]
    for other in {key, (key[0], 1), (key[0], 2)} if key[1] else {key}:
        drive.objects.add(*other, bits, signed=False)
        drive.objects[other].value = drive.objects[other].default = 2
    drive.objects[key].value = drive.objects[key].default = before
    rig.driver.configure(rig.config.period)  # the first set-up of a service
    holding(rig)
    rig.cut(1)
    drive.objects[key].default = after
    rig.cycles(20)
    rig.supply(1)
    rig.until(lambda: bool(rig.said("the drive has lost its settings")), ENDS)
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    assert f"drive B: the drive has lost its settings: object {key[0]:04X}:{key[1]:02X} ({said}; " in answer.message
    assert "save them in the drive, or restart the service" in answer.message
    rig.cycles(round(1.1 * RETRY_AFTER / rig.config.period))
    assert rig.mode is Mode.FAULT
    assert not rig.ready()
    drive.objects[key].value = before
    rig.recover()


def test_a_replaced_drive_with_other_settings_is_said_to_be_replaced(rig: RecoveryRig) -> None:
    holding(rig)
    rig.cut(2)
    rig.cycles(20)
    rig.supply(2)
    rig.drives[2].objects[0x1018, 4].value += 1
    rig.drives[2].objects[0x60A8, 0].value = 0x00AC_0000
    rig.until(lambda: bool(rig.said("the drive has been replaced: serial number")), ENDS)
    assert not rig.said("lost its settings")


SETTINGS = (*range(0x1005, 0x1018), *range(0x1400, 0x1C00), 0x605A, 0x6065, 0x6085)
"""Objects that set-up writes, but for the mode; a restart loses them."""


@pytest.mark.generated(*range(6))
def test_a_drive_that_restarts_while_it_is_configured_has_all_settings_in_the_end(rig: RecoveryRig, seed: int) -> None:
    """It answers again at once, and lets no time-out pass: its boot-up message alone tells."""

    def settings() -> dict[object, object]:
        entries = rig.drives[0].objects._entries
        return {place: entry.value for place, entry in entries.items() if place[0] in SETTINGS}

    draw, before = random.Random(seed), settings()
    rig.cycles(20)
    rig.supply(0)
    assert settings() != before
    rig.until(lambda: bool(rig.asked), ENDS)
    for _ in range(draw.choice((1, 2))):
        rig.cycles(draw.randrange(240))
        rig.supply(0)
        rig.cycles(3)
    rig.until(rig.ready, round(0.6 * RETRY_AFTER / rig.config.period))  # begun again, not refused and tried later
    rig.recover()
    assert settings() == before


@pytest.mark.parametrize("subindex", [3, 4])
def test_a_drive_may_be_replaced_where_the_configuration_allows_it(subindex: int) -> None:
    """Serial number and firmware may differ, the product may not."""
    drives = REAL.drives
    drive = msgspec.structs.replace(drives.C, allow_replacement=True)
    rig = RecoveryRig(msgspec.structs.replace(REAL, drives=msgspec.structs.replace(drives, C=drive)))
    holding(rig)
    rig.cut(2)
    rig.cycles(20)
    rig.supply(2)
    rig.drives[2].objects[0x1018, 2].value += 1
    rig.until(lambda: bool(rig.said("the drive has been replaced: product code")), ENDS)
    rig.cut(2)
    rig.cycles(20)
    rig.supply(2)
    rig.drives[2].objects[0x1018, subindex].value += 1
    rig.recover()
    rig.bus.shutdown()


def test_an_odrive_may_be_replaced_where_the_configuration_allows_it() -> None:
    """Serial number and firmware may differ, the hardware may not."""
    drives = ODRIVES.drives
    drive = msgspec.structs.replace(drives.C, allow_replacement=True, accept_without=("endpoints",))
    rig = RecoveryRig(msgspec.structs.replace(ODRIVES, drives=msgspec.structs.replace(drives, C=drive)))
    holding(rig)
    rig.cut(2)
    odrive = rig.bus.drives[2]
    assert isinstance(odrive, SimulatedOdrive)
    before = odrive.version
    odrive.version = before._replace(hardware=(5, 2, 0))
    rig.supply(2)
    rig.until(lambda: bool(rig.said("the drive has been replaced: hardware 5.2.0, was 4.4.58; restart")), ENDS)
    rig.cut(2)
    odrive.version, odrive.serial = before._replace(firmware=(0, 6, 99)), 7
    rig.supply(2)
    rig.until(rig.ready, ENDS)
    assert isinstance(rig.command("reset"), CommandDone)
    assert not rig.control.measured.homed
    assert rig.said("drive C: lacks endpoints")
    rig.bus.shutdown()


def test_settings_that_read_back_different_are_named_and_the_service_stays() -> None:
    """With the key, what was found and expected, and the remedy; right ones are found without a restart."""
    rig = RecoveryRig(ODRIVES)
    holding(rig)
    rig.cut(1)
    odrive = rig.bus.drives[1]
    assert isinstance(odrive, SimulatedOdrive)
    path = "axis0.config.can.heartbeat_msg_rate_ms"
    odrive.settings[path] = 50
    rig.supply(1)
    rig.until(lambda: bool(rig.said(f"{path} is 50, expected 100, drives.heartbeat")), ENDS)
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    remedy = 'drives.B.accept_without = ["heartbeat_msg_rate_ms"]'
    assert answer.message.endswith(f"; set them with odrivetool. To use it without them, set {remedy}")
    odrive.settings[path] = 100
    rig.recover()
    rig.bus.shutdown()


def test_an_odrive_that_does_not_say_who_it_is_is_asked_again() -> None:
    rig = RecoveryRig(ODRIVES)
    drive = rig.bus.drives[2]
    assert isinstance(drive, SimulatedOdrive)
    answer, left = drive._answer, [4]

    def lose_addresses(command: int) -> None:
        if command == cansimple.ADDRESS and left[0]:
            left[0] -= 1
            return
        answer(command)

    holding(rig)
    rig.cut(2)
    rig.cycles(300)
    drive._answer = lose_addresses  # type: ignore[method-assign]
    rig.supply(2)
    rig.recover()
    assert left == [0]
    assert not rig.said("has been replaced")
    rig.bus.shutdown()


def relative_rig() -> AbsentRig:
    """A robot of ODrives, of which drive A has a relative position."""
    rig = AbsentRig((0,), ODRIVES)
    drive = rig.bus.drives[0]
    assert isinstance(drive, SimulatedOdrive)
    drive.version = Version((5, 2, 0), (0, 6, 8))  # tells it
    drive.settings[POSITION_STATUS] = RELATIVE_MODE
    rig.supply(0)
    rig.recover()
    return rig


@pytest.mark.parametrize(("turns", "moved", "homed"), [(2.5, 0.0, True), (2.5, 0.2, False), (0.5, 0.0, False)])
def test_an_odrive_that_does_not_tell_whether_it_keeps_its_position_is_homed_only_where_that_is_seen(
    turns: float, moved: float, homed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for table in KNOWN_TABLES:
        monkeypatch.delitem(table.endpoints, ABSOLUTE_SETPOINTS)
    rig = RecoveryRig(ODRIVES)
    for drive in rig.bus.drives:
        drive.servo.position = turns
    rig.cycles(300)
    rig.cut(0)
    rig.bus.drives[0].servo.position += moved
    rig.cycles(300)
    rig.supply(0)
    rig.until(rig.ready, ENDS)
    assert isinstance(rig.command("reset"), CommandDone)
    assert rig.control.measured.homed is homed
    rig.bus.shutdown()


def test_an_odrive_whose_position_is_relative_is_not_homed_after_a_restart() -> None:
    """Its position at the first set-up counts, whenever it appears."""
    rig = relative_rig()
    assert rig.said("drive A: axis0.pos_vel_mapper.status is 9, relative")
    rig.cut(0)
    rig.cycles(300)
    rig.supply(0)
    rig.until(rig.ready, ENDS)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.enable()
    answer = rig.goal("g", 0.01, 0.0, 0.0)
    assert isinstance(answer, Refused)
    assert answer.code is RefusalCode.NOT_HOMED
    assert rig.said("slider A: the position is unknown because the drive was configured again")
    answer = rig.command("home")
    assert isinstance(answer, Refused)
    assert answer.message.endswith("to accept the positions as they are, restart the service")
    rig.bus.shutdown()


@pytest.mark.parametrize("line", ["A silent for 0.2", "A silent for 2", "bus-off for 0.4"])
@pytest.mark.long
def test_an_odrive_whose_position_is_relative_is_not_homed_after_silence(line: str) -> None:
    """It may have lost its supply, and have booted before it was heard again."""
    rig = relative_rig()
    rig.command("disable")
    rig.bus.faults.add(line)
    rig.cycles(200)
    rig.until(rig.ready, ENDS)
    assert isinstance(rig.command("reset"), CommandDone)
    assert not rig.control.measured.homed
    rig.bus.shutdown()


def test_an_odrive_whose_position_is_relative_keeps_it_through_a_short_silence() -> None:
    rig = relative_rig()
    rig.command("disable")
    rig.bus.faults.add("A silent for 0.1")
    rig.cycles(200)
    rig.until(rig.ready, ENDS)
    assert isinstance(rig.command("reset"), CommandDone)
    assert rig.control.measured.homed
    rig.enable()
    rig.bus.shutdown()


@pytest.mark.parametrize("state", [Nmt.PRE_OPERATIONAL, Nmt.OPERATIONAL, Nmt.STOPPED])
@pytest.mark.parametrize("heard", [True, False], ids=["boot-up heard", "boot-up lost"])
def test_a_drive_may_return_in_any_nmt_state(rig: RecoveryRig, state: Nmt, heard: bool) -> None:
    holding(rig)
    rig.cut(0)
    rig.cycles(300)
    if heard:
        rig.supply(0)
    rig.drives[0].silent = False
    rig.drives[0]._enter(state)
    rig.recover()


@either
def test_a_slider_that_was_moved_while_its_drive_was_off_is_told(rig: RecoveryRig) -> None:
    holding(rig)
    rig.cut(0, 1, 2)
    rig.cycles(300)
    counts = rig.config.drives.B.counts_per_metre * rig.config.drives.B.direction
    rig.bus.drives[1].servo.position += 0.003 * counts
    rig.supply(0, 1, 2)
    rig.recover()
    assert rig.said("moved while its drive was off") == [
        "slider B: moved while its drive was off, from 0.000 mm to 3.000 mm"
    ]


def test_an_incremental_encoder_makes_the_robot_not_homed() -> None:
    rig = RecoveryRig(incremental())
    rig.enable()
    assert isinstance(rig.command("home"), CommandDone)
    rig.cut(0)
    rig.cycles(300)
    rig.supply(0)
    rig.until(rig.ready, ENDS)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.enable()
    answer = rig.goal("g", 0.01, 0.0, 0.0)
    assert isinstance(answer, Refused)
    assert answer.code is RefusalCode.NOT_HOMED
    assert rig.said("slider A: the position is unknown because the drive was configured again; send home")
    assert isinstance(rig.command("home"), CommandDone)
    rig.goal("g2", 0.01, 0.0, 0.0)
    rig.until(lambda: ("g2", "done") in rig.outcomes())
    rig.bus.shutdown()


def test_another_home_offset_makes_the_robot_not_homed(rig: RecoveryRig) -> None:
    holding(rig)
    rig.cut(0)
    rig.cycles(300)
    rig.supply(0)
    rig.drives[0].objects[0x607C, 0].value = 500
    rig.until(rig.ready, ENDS)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.enable()
    answer = rig.goal("g", 0.01, 0.0, 0.0)
    assert isinstance(answer, Refused)
    assert answer.code is RefusalCode.NOT_HOMED
    assert rig.said("drive A: object 607C:00 (home offset) is 500, was 0")
    # It is not forgotten when the supply is lost once more, and over when the offset is what it was.
    for offset, code in ((500, RefusalCode.NOT_HOMED), (0, None)):
        rig.order("disable")
        rig.cycles(50)
        rig.cut(0)
        rig.cycles(300)
        rig.supply(0)
        rig.drives[0].objects[0x607C, 0].value = offset
        rig.until(rig.ready, ENDS)
        assert isinstance(rig.command("reset"), CommandDone)
        rig.enable()
        answer = rig.goal(f"g{offset}", 0.01, 0.0, 0.0)
        assert getattr(answer, "code", None) is code


class AbsentRig(RecoveryRig):
    """A robot whose service starts while drives are off."""

    def __init__(self, absent: tuple[int, ...], config: Config = REAL, queue: int = 1000) -> None:
        """`queue`: frames that the interface takes while nobody acknowledges them."""
        self.rows = []
        self.asked = []
        self.now = 90.0  # the cycles begin at 100
        self.sent, self.seen = [], []
        self.bus = simulated_bus(config.can, config.drives, lambda: self.now)
        receive = self.bus.recv

        def recv(timeout: float | None = None) -> can.Message | None:
            if (message := receive(0.0)) is None and not self.rows:
                self.now += timeout or 0.0
            return message

        self.bus.recv = recv  # type: ignore[method-assign]
        self._send = self.bus.send
        waiting = 0

        def send(message: can.Message, timeout: float | None = None) -> None:
            nonlocal waiting
            waiting = waiting + 1 if all(drive.silent for drive in self.bus.drives) else 0
            if waiting > queue:
                raise OSError(errno.ENOBUFS, "No buffer space available")
            self._send(message, timeout)

        self.bus.send = send  # type: ignore[assignment,method-assign]
        self.cut(*absent)
        driver = PROTOCOLS[config.drives.protocol].driver(self.bus, config.can.timing, config.drives, lambda: self.now)
        driver.configure(config.period, awaits=True)
        self.bus.send = self._note  # type: ignore[assignment,method-assign]
        super(Rig, self).__init__(config, driver)


@either
@pytest.mark.parametrize(("absent", "queue"), [((0, 1, 2), 10), ((0, 1, 2), 0), ((1,), 10), ((0, 2), 10)])
def test_a_service_that_starts_without_drives_configures_them_when_they_appear(
    absent: tuple[int, ...], queue: int, config: Config
) -> None:
    rig = AbsentRig(absent, config, queue=queue)
    rig.cycles(700)
    assert rig.mode is Mode.FAULT
    names = ["ABC"[index] for index in absent]
    assert rig.control.measured.unready == tuple(f"drive {name} does not answer" for name in names)
    wanted = f"drives {', '.join(names)} do not answer" if len(names) > 1 else f"drive {names[0]} does not answer"
    assert wanted in (rig.control.fault or "")
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    assert f"drive {names[0]} does not answer" in answer.message
    for index in absent:
        rig.cycles(100)
        rig.supply(index)
    rig.recover()
    rig.bus.shutdown()


def test_a_wrong_drive_that_appears_later_is_named_and_the_service_stays() -> None:
    rig = AbsentRig((1,))
    rig.supply(1)
    rig.drives[1].objects[0x1000, 0].value = 0x0002_0191
    rig.until(lambda: bool(rig.said("expected a drive, profile 402")), ENDS)
    answer = rig.command("reset")
    assert isinstance(answer, Refused)
    assert "drive B: object 1000:00 (device type)" in answer.message
    rig.drives[1].objects[0x1000, 0].value = 0x0002_0192
    rig.recover()
    rig.bus.shutdown()


def test_protections_of_drives_that_are_set_up_later_are_known() -> None:
    one = msgspec.structs.replace(ODRIVES.drives.A, accept_without=tuple(PROTECTIONS))
    rig = AbsentRig((0, 1, 2), msgspec.structs.replace(ODRIVES, drives=msgspec.structs.replace(ODRIVES.drives, A=one)))
    drive = rig.bus.drives[0]
    assert isinstance(drive, SimulatedOdrive)
    drive.settings[WATCHDOG] = 0
    rig.supply(0, 1, 2)
    rig.recover()
    assert [(missing.drive, missing.object) for missing in rig.driver.missing_protections] == [("A", "enable_watchdog")]
    assert len(rig.said("lacks enable_watchdog")) == 1
    rig.cut(0)
    rig.until(lambda: not rig.ready(), ENDS)
    rig.supply(0)
    rig.recover()
    assert len(rig.said("lacks enable_watchdog")) == 1


@pytest.mark.generated(*range(8))
def test_no_drive_is_asked_for_something_else_before_it_has_answered(
    rig: RecoveryRig, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """CiA 301: a server has room for one transfer. Controlwords that go by SDO are answered late here."""
    draw = random.Random(seed)
    asked: dict[int, tuple[bytes, float]] = {}
    mistaken: list[str] = []
    send, receive = rig.bus.send, rig.bus.recv

    def sent(message: can.Message, timeout: float | None = None) -> None:
        node = message.arbitration_id - canopen_frames.SDO_REQUEST
        if 0 < node < 0x80 and message.data[0] != 0x80:
            thing = bytes(message.data)
            before, at = asked.get(node, (b"", -math.inf))
            stops = thing != before and thing.startswith(canopen_frames.CONTROLWORD_DOWNLOAD)
            if rig.now < at + ANSWER_TIME and not stops:
                mistaken.append(f"{rig.now:.3f} s: node {node} is asked for {thing.hex()}, not answered {before.hex()}")
            asked[node] = thing, rig.now
        send(message, timeout)

    def received(timeout: float | None = None) -> can.Message | None:
        message = receive(timeout)
        if message is not None:
            asked.pop(message.arbitration_id - canopen_frames.SDO_ANSWER, None)
        return message

    monkeypatch.setattr(rig.bus, "send", sent)
    monkeypatch.setattr(rig.bus, "recv", received)
    draw.choice((disabled, holding, moving))(rig)
    for drive in rig.drives:
        drive.silent = True
    rig.cycles(draw.randrange(250, 800))
    for name in "ABC":
        rig.bus.faults.add(f"{name} delay {draw.choice((0.002, 0.011, 0.05, 0.2))} sdo-answer")
    asked.clear()
    for drive in rig.drives:
        drive.silent = False
    rig.cycles(1500)
    assert any(rig.asked)
    assert mistaken == []
    rig.bus.faults.clear()
    rig.recover()
