"""The CiA 402 driver on a bus with simulated drives, by a clock that the tests turn."""

from __future__ import annotations

import errno
import math
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import can
import canopen
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs import OFF, START, STEP, Bus, Clock, Closing, DriverRig, frame, ideal_servo
from trirail_drivers.cia402 import backup, canopen_frames, inspection
from trirail_drivers.cia402.axis import STANDSTILL_TIME_S
from trirail_drivers.cia402.drives import REPEAT_AFTER, Cia402
from trirail_drivers.cia402.eds import SERVO
from trirail_drivers.cia402.settings import interpolation_periods
from trirail_drivers.config import NO_IO, DigitalIo, Drive, Drives, Homing
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import ConfigurationRefused, DriveError
from trirail_drivers.interface import PowerState
from trirail_drivers.simulated import SimulatedDrive
from trirail_drivers.simulated.device import Nmt
from trirail_drivers.simulated.dictionary import ObjectEntry
from trirail_drivers.timing import BusTiming

P = PowerState
PERIOD = STEP
ZERO = (0.0, 0.0, 0.0)
CONFIG = Drives(
    protocol="cia402",
    A=Drive(node=1, counts_per_metre=1e6),
    B=Drive(node=5, counts_per_metre=2e6, direction=-1, offset=0.1),
    C=Drive(node=9, counts_per_metre=1e6),
    sdo_timeout=0.01,
)
SCALE = scale_of("A", CONFIG.A)
HOMING = Homing(method=19, speed_switch=0.02, speed_zero=0.005, acceleration=0.5)


WATCHED = (0x1006, 0x1016, 0x6007, 0x605A, 0x605E, 0x6065, 0x6066, 0x6085)
"""Objects of the protections that a set-up gives a drive."""
STORABLE = (*WATCHED, *range(0x1400, 0x1402), *range(0x1600, 0x1602), *range(0x1800, 0x1802), *range(0x1A00, 0x1A02),
            0x6060, 0x60C2)  # fmt: skip


def changed(name: str, **keys: object) -> Drives:
    """The configuration, with one drive's keys changed."""
    return msgspec.structs.replace(CONFIG, **{name: msgspec.structs.replace(getattr(CONFIG, name), **keys)})


class Rig(DriverRig[SimulatedDrive, Cia402]):
    """CiA 402 drives, and what each was told."""

    enabled_within = 10
    off = canopen_frames.DISABLE_VOLTAGE
    positions = "tpdo2"
    first_asked = r"object 1000:00 \(Device type\)"
    keeps_power = "is operation enabled 1 s after {}; expected switch on disabled"

    def __init__(self, config: Drives = CONFIG, io: Sequence[DigitalIo] = NO_IO) -> None:
        super().__init__(config, partial(Cia402, io=io))

    def device(self, drive: Drive, counts: float) -> SimulatedDrive:
        return SimulatedDrive(drive.node, ideal_servo(drive, round(counts)))

    def sent_to(self, base: int) -> list[list[bytes]]:
        """What each drive was sent on the identifiers of one service."""
        return [[data for can_id, data in self.bus.sent if can_id == base + d.node] for d in self.devices]

    def commands(self) -> list[list[int]]:
        """Controlwords."""
        return [
            [canopen_frames.CONTROLWORD.unpack(data)[0] for data in each] for each in self.sent_to(canopen_frames.RPDO1)
        ]

    def keep_power(self, index: int) -> None:
        self.devices[index].objects.on_write(0x6040, lambda entry, old: None)

    def get_power(self, index: int) -> None:
        self.devices[index].state = P.OPERATION_ENABLED

    def keep_fault(self, index: int) -> Callable[[], None]:
        device = self.devices[index]
        control, on_write = device._control, device.objects.on_write
        on_write(0x6040, lambda entry, old: None if device.state is P.FAULT else control(entry, old))
        return lambda: on_write(0x6040, control)


@pytest.fixture
def new() -> Iterator[Rig]:
    """Drives that were just switched on."""
    rig = Rig()
    yield rig
    rig.drives.close()


class TestConfigure:
    def test_drives_hold_what_the_cycle_needs(self, ready: Rig) -> None:
        for device, drive in zip(ready.devices, CONFIG.each, strict=True):
            wanted = {
                (0x1006, 0): 1000,
                (0x1016, 1): 126 << 16 | 300,
                (0x1017, 0): 100,
                (0x1029, 1): 0,
                (0x6007, 0): 3,
                (0x605A, 0): 2,
                (0x605E, 0): 2,
                (0x6060, 0): 8,
                (0x6061, 0): 8,
                (0x60C2, 1): 1,
                (0x60C2, 2): -3,
                (0x6065, 0): round(0.005 * drive.counts_per_metre),
                (0x6085, 0): round(10.0 * drive.counts_per_metre),
                (0x1400, 1): 0x200 + drive.node,
                (0x1400, 2): 255,
                (0x1600, 0): 1,
                (0x1600, 1): 0x60400010,
                (0x1401, 1): 0x300 + drive.node,
                (0x1401, 2): 1,
                (0x1601, 0): 2,
                (0x1601, 1): 0x607A0020,
                (0x1601, 2): 0x60B10020,
                (0x1800, 2): 255,
                (0x1800, 5): 100,
                (0x1A00, 0): 1,
                (0x1A00, 1): 0x60410010,
                (0x1801, 2): 1,
                (0x1A01, 0): 1,
                (0x1A01, 1): 0x60640020,
            }
            assert {key: device.objects[key].value for key in wanted} == wanted
            assert device.objects[0x1800, 1].value & 0x8000_07FF == 0x180 + drive.node
            assert device.objects[0x1801, 1].value & 0x8000_07FF == 0x280 + drive.node

    def test_leaves_them_operational_and_without_power(self, ready: Rig) -> None:
        assert [device.nmt for device in ready.devices] == [canopen_frames.OPERATIONAL] * 3
        assert [device.state for device in ready.devices] == [P.SWITCH_ON_DISABLED] * 3
        assert ready.drives.bus_load == pytest.approx(0.75, abs=0.001)

    def test_takes_power_off_that_was_left_on(self, new: Rig) -> None:
        device = new.devices[1]
        for word in (canopen_frames.SHUTDOWN, canopen_frames.SWITCH_ON, canopen_frames.ENABLE_OPERATION):
            device.objects[0x6040, 0].write(word)
        assert device.state is P.OPERATION_ENABLED
        new.drives.configure(PERIOD)
        assert new.drives.read().state == OFF

    def test_wrong_device_type(self, new: Rig) -> None:
        new.devices[2].objects[0x1000, 0].value = 401
        with pytest.raises(DriveError, match=r"drive C: .*profile 401; expected a drive, profile 402"):
            new.drives.configure(PERIOD)

    def test_refused_write_tells_the_drives_reason(self, new: Rig) -> None:
        ramp = new.devices[2].objects[0x6085, 0]
        ramp.value, ramp._limits = 5, None
        with pytest.raises(
            DriveError, match=r"drive C lacks .* cannot write 10000000 to object 6085:00 .*read only .*06010002"
        ):
            new.drives.configure(PERIOD)

    def test_refusal_names_object_wanted_and_found(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Of every object that is set: a drive that says it took the value and did not."""
        objects = canopen.import_od(str(SERVO))
        told, take = ObjectEntry.encode, ObjectEntry.write
        other = Rig()
        other.drives.configure(PERIOD)
        writes = [
            data
            for can_id, data in other.bus.sent
            if can_id == canopen_frames.SDO_REQUEST + 1 and data[0] & 0xE2 == 0x22
        ]
        settings = [*dict.fromkeys((int.from_bytes(data[1:3], "little"), data[3]) for data in writes)]
        settings = [key for key in settings if key not in ((0x6040, 0), (0x6060, 0))]  # 6041 and 6061 tell
        other.drives.close()
        assert {index for index, _ in settings} >= {0x6065, 0x1006, 0x1016, 0x1017}
        assert {index for index, _ in settings} >= {0x1401, 0x1601, 0x1800, 0x1801, 0x1A01}
        for index, subindex in settings:
            rig = Rig()
            lying = rig.devices[0].objects[index, subindex]
            written: list[ObjectEntry] = []

            def encode(entry: ObjectEntry, lying: ObjectEntry = lying, written: list[ObjectEntry] = written) -> bytes:
                truth = told(entry)
                return bytes([truth[0] ^ 1]) + truth[1:] if entry is lying and lying in written else truth

            def write(entry: ObjectEntry, value: int, written: list[ObjectEntry] = written) -> None:
                written.append(entry)
                take(entry, value)

            monkeypatch.setattr(ObjectEntry, "encode", encode)
            monkeypatch.setattr(ObjectEntry, "write", write)
            with pytest.raises(ConfigurationRefused) as refused:
                rig.drives.configure(PERIOD)
            variable = objects.get_variable(index, subindex)
            assert variable is not None
            assert str(refused.value).startswith(
                f"drive A: object {index:04X}:{subindex:02X} ({variable.qualname}): expected "
            )
            assert ", found " in str(refused.value)
            rig.drives.close()

    def test_drives_of_other_makes_by_their_own_eds(self, closing: Closing, tmp_path: Path) -> None:
        text = SERVO.read_text().replace("[6085]\nParameterName=Quick stop deceleration", "[6085]\nParameterName=Ramp")
        (tmp_path / "other.eds").write_text(text)
        rig = closing(Rig(changed("B", eds=str(tmp_path / "other.eds"))))
        entry = rig.devices[1].objects[0x6085, 0]
        entry.on_write = lambda entry, old: setattr(entry, "value", 1)
        with pytest.raises(ConfigurationRefused, match=r"drive B: object 6085:00 \(Ramp\): expected 20000000, found 1"):
            rig.drives.configure(PERIOD)

    def test_eds_that_is_not_there(self) -> None:
        with pytest.raises(DriveError, match=r"drive C: cannot read EDS /nowhere/x\.eds: No such file or directory"):
            Rig(changed("C", eds="/nowhere/x.eds")).drives.configure(PERIOD)

    @pytest.mark.parametrize(
        "content", [b"hello", b"\xff\xfe\x00", b"[DeviceInfo]\n[1000]\nObjectType=0x7\nDataType=zz\n"]
    )
    def test_eds_that_is_none(self, tmp_path: Path, content: bytes) -> None:
        (tmp_path / "x.eds").write_bytes(content)
        with pytest.raises(
            DriveError, match=r"^drive A: \S*x\.eds(?: is not an EDS according to CiA 306)?: .+"
        ) as refused:
            Rig(changed("A", eds=str(tmp_path / "x.eds"))).drives.configure(PERIOD)
        assert "\n" not in str(refused.value)

    def test_what_an_eds_leaves_out_the_drive_is_asked_for(self, closing: Closing, tmp_path: Path) -> None:
        text = SERVO.read_text()
        begin = text.index("[6085]")
        (tmp_path / "x.eds").write_text(text[:begin] + text[text.index("[6098]") :].replace("0x6085", "0x60F4"))
        rig = closing(Rig(changed("A", eds=str(tmp_path / "x.eds"))))
        rig.devices[0].objects[0x6085, 0].value = 5
        rig.drives.configure(PERIOD)
        assert rig.devices[0].objects[0x6085, 0].value == 10_000_000

    @given(
        held=st.one_of(st.sampled_from((0x080, 0x081, 0x085, 0x089, 0x181)), st.integers(0x0A0, 0x0FF)),
        off=st.booleans(),
        read_only=st.booleans(),
    )
    def test_an_emcy_is_received_as_that_of_its_drive(self, held: int, off: bool, read_only: bool) -> None:
        """`held` is the identifier that drive B, node 5, has at first, as after the set-up of another drive."""
        rig = Rig()
        entry = rig.devices[1].objects[0x1014, 0]
        entry.value = entry.default = held | off << 31
        if read_only:
            entry._limits = None
        if read_only and not off and held in (0x080, 0x081, 0x089, 0x181):
            with pytest.raises(DriveError, match=f"drive [BC]: shares with (SYNC|drive .) the identifier {held:03X}h"):
                rig.drives.configure(PERIOD)
            return
        rig.drives.configure(PERIOD)
        rig.cycles(2)
        assert entry.value == (held | off << 31 if read_only else 0x085)
        rig.devices[1].errors.report(0x4210)
        fault = rig.cycle().fault
        assert (fault is None) is (read_only and off)
        assert fault is None or fault[:3] == ("B", "emcy", 0x4210)
        rig.drives.close()

    @pytest.mark.parametrize("guarded", [0x00, 0x80])
    def test_a_drive_in_nmt_stopped_is_not_called_absent(self, guarded: int) -> None:
        """`guarded` is the toggle bit of an answer to node guarding."""
        rig = Rig()
        b = rig.devices[1]
        b._enter(Nmt.STOPPED)
        b.objects[0x1017, 0].value = 10
        b._error_control._heartbeat_due = rig.clock.now
        send = b._transmit
        b._transmit = lambda can_id, data: send(can_id, bytes([data[0] | guarded]) if can_id == 0x705 else data)
        ends = inspection.inspect(rig.bus, CONFIG, PERIOD, rig.clock, apply=False)
        assert [each["refused"].partition(";")[0] for each in ends] == [
            "",
            "drive B: is in NMT stopped, in which it answers no requests",
            "",
        ]
        (saved,) = backup.save(rig.bus, CONFIG, rig.clock, ["B"]).values()
        assert "is in NMT stopped" in str(saved)
        rig.drives.configure(PERIOD)  # the set-up of the service makes it pre-operational

    def test_homing_is_set_where_the_encoder_is_not_absolute(self, closing: Closing) -> None:
        rig = closing(Rig(changed("B", homing=HOMING)))
        rig.drives.configure(PERIOD)
        objects = rig.devices[1].objects
        keys = [(0x6098, 0), (0x6099, 1), (0x6099, 2), (0x609A, 0), (0x607C, 0)]
        assert [objects[key].value for key in keys] == [19, 40_000, 10_000, 1_000_000, 0]
        assert rig.drives.read().homed == (True, False, True)
        assert [rig.devices[0].objects[key].value for key in keys] == [0] * 5

    def test_drive_without_homing_mode_is_not_homed(self, closing: Closing) -> None:
        rig = closing(Rig(changed("B", homing=HOMING)))
        rig.devices[1].objects[0x6502, 0].value = 0x80
        with pytest.raises(DriveError, match=r"drive B: object 6502:00 .* is 00000080, without homing mode"):
            rig.drives.configure(PERIOD)

    def test_homing_method_that_a_drive_has_not_is_refused(self, closing: Closing) -> None:
        rig = closing(Rig(changed("C", homing=msgspec.structs.replace(HOMING, method=33))))
        with pytest.raises(DriveError, match=r"drive C: cannot write 33 to object 6098:00 \(Homing method\)"):
            rig.drives.configure(PERIOD)

    @pytest.mark.parametrize(
        ("keys", "said"),
        [
            ({"B": CONFIG.A}, "must differ, but are drives.A.node = 1, drives.B.node = 1"),
            ({"A": Drive(0, 1e6)}, "drives.A.node = 0: on CANopen, 0 addresses all nodes"),
            ({"heartbeat": 0.0001}, "highest rate that fits"),
            ({"heartbeat": 30.0}, r"heartbeat .*0\.001 to 21\.845"),
        ],
    )
    def test_what_no_drives_can_be_is_refused(self, keys: dict[str, Any], said: str) -> None:
        with pytest.raises(DriveError, match=said):
            Cia402(Bus([], Clock(), {}), BusTiming(1_000_000), msgspec.structs.replace(CONFIG, **keys)).configure(
                PERIOD
            )

    @pytest.mark.parametrize(
        ("rate", "said"),
        [(1000, (1, -3)), (400, (25, -4)), (800, (125, -5)), (100, (10, -3)), (200, (5, -3)), (4000, (25, -5))],
    )
    def test_period_as_value_and_power_of_ten(self, rate: float, said: tuple[int, int]) -> None:
        assert interpolation_periods(1 / rate)[0] == said

    @pytest.mark.parametrize("rate", [16, 32, 64, 160, 300, 320, 700, 1600, 3000])
    def test_period_that_no_drive_can_be_told(self, rate: float) -> None:
        """The remedy is a rate that a file may have, and that drives can be told."""
        with pytest.raises(DriveError, match=r"60C2h .*set loop\.rate_hz = \d+, the nearest") as refused:
            interpolation_periods(1 / rate)
        remedy = re.search(r"rate_hz = (\d+)", str(refused.value))
        assert remedy is not None
        nearest = int(remedy[1])
        assert 1_000_000 % nearest == 0
        assert interpolation_periods(1 / nearest)
        assert nearest / 2 < rate < 2 * nearest


class TestPower:
    def test_controlwords_in_order_and_only_on_change(self, ready: Rig) -> None:
        ready.cycles(3)
        assert ready.commands() == [[], [], []]
        ready.enable()
        ready.cycles(5)
        assert ready.commands() == [[0x06, 0x07, 0x0F]] * 3

    def test_setpoints_come_before_each_step_of_power(self, ready: Rig) -> None:
        ready.drives.enable()
        assert ready.bus.sent == []
        ready.cycle()
        ids = [can_id for can_id, _ in ready.bus.sent]
        last_setpoint = max(i for i, can_id in enumerate(ids) if can_id & 0x780 == canopen_frames.RPDO2)
        first_controlword = min(i for i, can_id in enumerate(ids) if can_id & 0x780 == canopen_frames.RPDO1)
        assert last_setpoint < first_controlword

    def test_quick_stop_reaches_all_three_in_its_cycle_in_place_of_setpoints(self, enabled: Rig) -> None:
        enabled.clock.now += PERIOD
        enabled.drives.sync()
        feedback = enabled.drives.read()
        enabled.bus.sent.clear()
        enabled.drives.quick_stop()
        enabled.drives.write(feedback.position, ZERO)
        assert enabled.bus.sent == [(canopen_frames.RPDO1 + d.node, b"\x02\x00") for d in enabled.devices]

    def test_quick_stop_from_speed_ends_without_power_until_enabled(self, enabled: Rig) -> None:
        enabled.move(100, (0.5, 0.5, 0.5))
        enabled.drives.quick_stop()
        states = {enabled.cycle().state for _ in range(100)}
        assert (P.QUICK_STOP_ACTIVE,) * 3 in states
        feedback = enabled.cycles(50)
        assert (feedback.state, feedback.fault) == (OFF, None)
        assert enabled.enable().fault is None

    def test_a_controlword_that_got_lost_is_sent_again(self, enabled: Rig) -> None:
        enabled.bus.faults.add("B drop rpdo1 for 1 frame")
        enabled.drives.quick_stop()
        enabled.cycles(REPEAT_AFTER - 1)
        assert enabled.commands() == [[0x02]] * 3  # its statusword may still be on the way
        feedback = enabled.cycles(7)
        assert feedback.state == OFF
        assert enabled.commands() == [[0x02], [0x02, 0x02], [0x02]]

    def test_a_drive_that_does_not_come_to_stand_loses_its_power(self, enabled: Rig) -> None:
        enabled.devices[2].servo.forced_velocity = 1000.0
        enabled.drives.quick_stop()
        enabled.cycles(990)
        assert enabled.devices[2].state is P.QUICK_STOP_ACTIVE
        assert enabled.cycles(20).state == OFF
        assert enabled.devices[2].servo.velocity == 0.0

    def test_drive_that_stays_in_quick_stop_loses_its_power_once_it_stands(self, enabled: Rig) -> None:
        enabled.devices[2].objects[0x605A, 0].value = 6
        enabled.drives.quick_stop()
        enabled.cycles(1010)
        assert set(enabled.cycle().state) == {PowerState.SWITCH_ON_DISABLED}

    def test_drive_that_does_not_stop_after_a_fault_is_told_of_as_well(self, enabled: Rig) -> None:
        enabled.keep_power(1)
        enabled.devices[0].fail(0x4310)
        assert enabled.found("emcy", within=2).drive == "A"
        enabled.cycles(1010)
        assert enabled.found("timeout", within=1)[:3] == ("B", "timeout", 0)

    def test_drive_that_drops_out_unasked(self, enabled: Rig) -> None:
        enabled.devices[1].objects[0x6040, 0].write(canopen_frames.DISABLE_VOLTAGE)
        assert enabled.found("state", within=1).drive == "B"
        assert enabled.commands() == [[0x02]] * 3


class TestSetpoints:
    def test_are_latched_at_the_next_sync(self, enabled: Rig) -> None:
        target = enabled.devices[0].objects[0x607A, 0]
        before = target.value
        enabled.cycle((START[0] + 1e-5, START[1], START[2]))
        assert target.value == before
        enabled.drives.sync()
        assert target.value == before + 10

    def test_move_the_slider_with_scale_and_direction(self, enabled: Rig) -> None:
        goal = (START[0] + 2e-4, START[1] + 2e-4, START[2] - 2e-4)
        for _ in range(20):
            feedback = enabled.cycle(goal)
        assert feedback.position == pytest.approx(goal, abs=1e-6)
        assert feedback.fault is None

    def test_carry_velocity_as_feed_forward(self, enabled: Rig) -> None:
        enabled.cycle(START, (0.1, 0.1, -0.2))
        velocities = [canopen_frames.SETPOINT.unpack(each[-1])[1] for each in enabled.sent_to(canopen_frames.RPDO2)]
        assert velocities == [100_000, -200_000, -200_000]

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e9])
    @pytest.mark.parametrize("which", ["position", "velocity"])
    def test_bad_ones_are_never_sent_but_stop_everything(self, enabled: Rig, bad: float, which: str) -> None:
        enabled.clock.now += PERIOD
        enabled.drives.sync()
        enabled.drives.read()
        enabled.bus.sent.clear()
        if which == "position":
            enabled.drives.write((START[0], bad, START[2]), ZERO)
        else:
            enabled.drives.write(START, (0.0, bad, 0.0))
        assert enabled.bus.sent == [(canopen_frames.RPDO1 + d.node, b"\x02\x00") for d in enabled.devices]
        fault = enabled.drives.read().fault
        assert fault is not None
        assert (fault.drive, fault.cause) == ("B", "setpoint")


class TestFaults:
    def test_end_of_errors_is_no_fault(self, enabled: Rig) -> None:
        enabled.bus.inject(canopen_frames.EMCY + 1, bytes(8))
        assert enabled.cycle().fault is None

    def test_position_that_is_there_before_the_next_sync_answers_the_last_one(self, ready: Rig) -> None:
        ready.cycles(3)
        for device in ready.devices:
            device.silent = True
        for _ in range(5):
            ready.clock.now += PERIOD
            ready.drives.sync()
            assert ready.drives.read().fault is None
            for device in ready.devices:
                ready.bus.inject(canopen_frames.TPDO2 + device.node, bytes(4))
        ready.drives.sync()
        feedback = ready.drives.read()
        assert feedback.age == (1, 1, 1)
        assert feedback.fault is None
        for device in ready.devices:
            device.silent = False

    @pytest.mark.parametrize("code", [0x2310, 0x3220, 0x4310, 0x7380, 0xFF01])
    def test_an_error_from_before_the_set_up_is_reported_until_it_ends(self, new: Rig, code: int) -> None:
        """Without a fault state, by the error register and the error code."""
        device = new.devices[1]
        device.errors.report(code)
        device.objects[0x603F, 0].value = code
        new.drives.configure(PERIOD)
        fault = new.found("emcy", within=1)
        assert fault[:3] == ("B", "emcy", code)
        assert "is still in force" in fault.message
        new.drives.reset()
        new.cycles(490)
        assert new.found("emcy", within=20) == fault
        device.errors.clear(code)
        new.drives.reset()
        assert new.cycles(1000).fault is None

    def test_an_error_without_a_code_is_a_warning(self, new: Rig) -> None:
        new.devices[1].errors.report(0xFF01)
        new.devices[1].objects[0x603F, 0].value = 0
        new.drives.configure(PERIOD)
        feedback = new.cycle()
        assert feedback.fault is None
        assert [each for each in feedback.warnings if "drive B: its error register 1001h" in each]

    def test_a_communication_error_from_before_the_set_up_ends_with_it(self, new: Rig) -> None:
        new.devices[1].errors.report(0x8130)
        new.drives.configure(PERIOD)
        assert new.cycle().fault is None

    def test_emergency_in_force_is_no_matter_of_the_past(self, ready: Rig) -> None:
        ready.devices[1].errors.report(0x4210)
        ready.found("emcy", within=1)
        ready.drives.reset()
        assert ready.found("emcy", within=1)[:3] == ("B", "emcy", 0x4210)
        ready.devices[1].errors.clear(0x4210)
        ready.cycle()
        ready.drives.reset()
        assert ready.cycles(300).fault is None

    def test_a_drive_out_of_fault_has_no_error_whether_or_not_it_says_so(self, ready: Rig) -> None:
        ready.devices[1].fail(0x2310)
        ready.cycles(5)
        ready.bus.faults.add("B drop emcy")
        ready.drives.reset()
        assert ready.cycles(20).fault is None

    @pytest.mark.parametrize("command", [canopen_frames.NMT_PRE_OPERATIONAL, 2])
    def test_drive_that_left_operational_is_configured_again(self, ready: Rig, command: int) -> None:
        """Another master stops it or makes it pre-operational; its set-up is checked, and a reset is enough."""
        ready.cycles(150)
        ready.bus.send(frame(0, bytes([command, 9])))
        ready.found("silent", within=3)
        reason = ready.cycles(130).unready[2]
        assert reason is not None
        assert "drive C is not in NMT operational: configuring" in str(reason)
        feedback = ready.cycles(1000)
        assert (feedback.unready, ready.devices[2].nmt) == ((None,) * 3, Nmt.OPERATIONAL)
        ready.drives.reset()
        assert ready.cycles(200).fault is None
        ready.enable()

    @given(stored=st.sets(st.sampled_from(STORABLE)), homes=st.booleans(), boots_late=st.integers(0, 40))
    @pytest.mark.long
    def test_a_drive_whose_boot_up_message_is_lost_is_configured_again(
        self, stored: set[int], homes: bool, boots_late: int
    ) -> None:
        """It sends heartbeats after its restart, since it has `stored` their period and perhaps other objects."""
        rig = Rig(changed("A", homing=HOMING) if homes else CONFIG)
        rig.drives.configure(PERIOD)
        drive = rig.devices[0]
        axis = rig.drives._axes[0]
        axis.homed = True
        configured = {key: entry.value for key, entry in drive.objects._entries.items() if entry.writable}
        for (index, _), entry in drive.objects._entries.items():
            if index in (0x1017, *stored):
                entry.default = entry.value
        rig.enable()
        rig.cycles(50, START)
        drive.restart(rig.clock.now)
        rig.bus._arrived.clear()
        drive._error_control._heartbeat_due = rig.clock.now + 1e-3 * boots_late
        feedback = rig.cycles(1000)
        assert feedback.fault is not None
        assert not any(feedback.unready)
        rig.drives.reset()
        assert rig.cycles(100).fault is None
        assert {key: drive.objects[key].value for key in configured if key[0] in WATCHED} == {
            key: value for key, value in configured.items() if key[0] in WATCHED
        }
        assert rig.cycle().homed == (not homes, True, True)
        rig.enable()
        rig.drives.close()

    @pytest.mark.parametrize("state", [Nmt.PRE_OPERATIONAL, Nmt.STOPPED])
    def test_a_drive_that_left_operational_with_power_has_its_ramp_when_the_driver_closes(
        self, enabled: Rig, state: Nmt
    ) -> None:
        drive = enabled.devices[1]
        enabled.cycles(150)
        drive.objects[0x6007, 0].value = 0
        drive._enter(state)
        drive._send(0x700 + drive.node, bytes([state]))
        enabled.bus.faults.add("B drop sdo-request")
        assert "left NMT operational" in enabled.last_fault(1)
        enabled.bus.faults.clear()
        states: list[PowerState] = []
        control = drive._control

        def controlled(entry: ObjectEntry, old: int) -> None:
            control(entry, old)
            states.append(drive.state)

        drive.objects.on_write(0x6040, controlled)
        enabled.drives.close()
        assert states[0] is P.QUICK_STOP_ACTIVE
        assert drive.state is P.SWITCH_ON_DISABLED

    def test_closing_waits_only_until_a_drive_that_left_operational_shows_no_power(self, enabled: Rig) -> None:
        drive = enabled.devices[1]
        drive._enter(Nmt.PRE_OPERATIONAL)  # 6007h: it switches its power off by itself
        drive._send(0x700 + drive.node, bytes([Nmt.PRE_OPERATIONAL]))
        enabled.cycle()
        begun = enabled.clock()
        enabled.drives.close()
        assert enabled.clock() - begun < 0.2

    @pytest.mark.parametrize("told", [True, False], ids=["boot-up told", "boot-up lost"])
    @pytest.mark.parametrize("another", [True, False])
    @pytest.mark.long
    def test_a_drive_that_falls_silent_after_it_has_left_operational_returns(
        self, enabled: Rig, told: bool, another: bool
    ) -> None:
        """Its statusword has not been read, so that it counted as powered. Meanwhile, another drive may restart."""
        drive, other = enabled.devices[1:]
        drive.objects[0x6007, 0].value = 0
        drive._enter(Nmt.PRE_OPERATIONAL)
        drive._send(0x700 + drive.node, bytes([Nmt.PRE_OPERATIONAL]))
        enabled.bus.faults.add("B silent")
        assert str(enabled.cycles(2500).unready[1]) == "drive B does not answer"
        if another:
            other.restart(enabled.clock())
            assert enabled.cycles(1500).unready[2] is None
        if not told:
            drive.restart(enabled.clock())
            enabled.cycles(30)
        enabled.bus.faults.clear()
        if told:
            drive.restart(enabled.clock())
        assert enabled.cycles(2000).unready == (None, None, None)
        enabled.drives.reset()
        enabled.cycles(50)
        assert enabled.enable().state == (P.OPERATION_ENABLED,) * 3

    def test_a_full_queue_is_told_once_and_stops_first_what_must_stop(self, enabled: Rig) -> None:
        enabled.bus.broken = True
        assert "ip link set simulated drives txqueuelen 100" in enabled.cycle().warnings[0]
        assert enabled.cycle().warnings == ()
        enabled.drives.quick_stop()
        enabled.bus.broken = False
        enabled.bus.sent.clear()
        enabled.drives.sync()
        enabled.drives.write(enabled.drives.read().position, ZERO)
        order = [can_id & 0x780 for can_id, _ in enabled.bus.sent]
        assert order == [canopen_frames.SYNC, *[canopen_frames.RPDO1] * 3, *[canopen_frames.RPDO2] * 3]


class TestLateAnswers:
    """A real bus takes most of a cycle to carry the answers to a SYNC; they are read after the next one."""

    @pytest.fixture
    def late(self, ready: Rig) -> Iterator[Rig]:
        ready.bus.late = 0
        yield ready
        ready.bus.late = None

    def test_power_takes_the_same_steps(self, late: Rig) -> None:
        late.enable()
        assert late.cycles(20).fault is None
        assert late.commands() == [[0x06, 0x07, 0x0F]] * 3

    def test_position_is_that_of_the_sync_before(self, late: Rig) -> None:
        late.enable()
        late.cycle((START[0] + 1e-5, START[1], START[2]))
        positions = [late.cycle((START[0] + 1e-5, START[1], START[2])).position[0] for _ in range(4)]
        assert positions == pytest.approx([START[0], START[0], START[0] + 1e-5, START[0] + 1e-5], abs=1e-6)

    def test_positions_that_always_take_long_are_not_late(self, late: Rig) -> None:
        late.cycles(20)
        assert [(c.feedback_late, c.feedback_lost) for c in late.drives.counts] == [(0, 0)] * 3

    def test_age_counts_what_was_lost(self, late: Rig) -> None:
        late.cycles(3)
        late.devices[1].silent = True
        late.cycle()  # reads the last answer
        late.devices[1].silent = False
        assert late.cycle().age == (1, 2, 1)
        assert late.cycle().age == (1, 1, 1)

    def test_silence_is_three_answers_missing(self, late: Rig) -> None:
        late.cycles(5)
        late.devices[2].silent = True
        late.cycle()  # reads the last answer
        assert late.cycles(2).fault is None
        assert late.found("silent", within=1)[:3] == ("C", "silent", 0)

    def test_reset_does_not_take_an_old_statusword_for_a_new_fault(self, late: Rig) -> None:
        late.enable()
        late.devices[1].fail(0x3210)
        late.cycles(20)
        late.drives.reset()
        for _ in range(300):
            assert late.cycle().fault is None


class TestReset:
    def test_clears_the_drives_fault_and_gives_no_power(self, enabled: Rig) -> None:
        enabled.devices[2].fail(0x8611)
        enabled.cycles(20)
        enabled.drives.reset()
        feedback = enabled.cycles(3)
        assert (feedback.state, feedback.fault) == (OFF, None)
        assert enabled.commands() == [[0x02], [0x02], [0x02, 0x80, 0x02]]
        assert enabled.cycles(50).state == OFF
        assert enabled.enable().fault is None


class TestHeartbeat:
    def test_is_sent_from_the_cycle_at_its_period(self, ready: Rig) -> None:
        ready.cycles(1000)
        heartbeats = [data for can_id, data in ready.bus.sent if can_id == canopen_frames.HEARTBEAT + 126]
        assert heartbeats == [bytes([canopen_frames.OPERATIONAL])] * 10


class TestClose:
    def test_leaves_drives_without_power_and_pre_operational(self, enabled: Rig) -> None:
        enabled.drives.close()
        assert [device.state for device in enabled.devices] == [P.SWITCH_ON_DISABLED] * 3
        assert [device.nmt for device in enabled.devices] == [canopen_frames.PRE_OPERATIONAL] * 3
        assert enabled.commands() == [[0x02, 0x00]] * 3
        assert enabled.bus.shutdowns == 1

    @pytest.mark.parametrize("index", range(3))
    def test_takes_power_off_a_drive_that_is_deaf_to_pdos(self, enabled: Rig, index: int) -> None:
        """In NMT pre-operational, where a drive without object 6007h keeps its power, it hears SDOs only."""
        device = enabled.devices[index]
        device.objects[0x6007, 0].value = 0
        device.receive(
            canopen_frames.NMT,
            canopen_frames.NMT_COMMAND.pack(canopen_frames.NMT_PRE_OPERATIONAL, device.node),
            enabled.clock.now,
        )
        assert device.state is P.OPERATION_ENABLED
        enabled.drives.close()
        assert [device.state for device in enabled.devices] == [P.SWITCH_ON_DISABLED] * 3

    def test_while_moving_brakes_by_the_ramp_first(self, enabled: Rig) -> None:
        enabled.move(100, (0.5, 0.5, 0.5))
        before = enabled.clock.now
        enabled.drives.close()
        assert [device.state for device in enabled.devices] == [P.SWITCH_ON_DISABLED] * 3
        assert 0.5 / 10.0 <= enabled.clock.now - before < 0.5 / 10.0 + 0.02
        assert enabled.commands() == [[0x02, 0x00]] * 3

    def test_a_long_ramp_ends_without_a_lost_heartbeat(self, closing: Closing) -> None:
        rig = closing(Rig(msgspec.structs.replace(CONFIG, quick_stop_deceleration=0.6, stop_timeout=2.0)))
        rig.drives.configure(PERIOD)
        rig.enable()
        rig.move(100, (0.5, 0.5, 0.5))
        before = rig.clock.now
        rig.drives.close()
        assert [device.state for device in rig.devices] == [P.SWITCH_ON_DISABLED] * 3
        assert [device.objects[0x603F, 0].value for device in rig.devices] == [0] * 3
        assert 0.5 / 0.6 <= rig.clock.now - before < 0.5 / 0.6 + 0.02

    @pytest.mark.parametrize("option", [5, 6, 7, 8])
    def test_drives_that_keep_power_after_their_ramp_lose_it_at_standstill(self, enabled: Rig, option: int) -> None:
        for device in enabled.devices:
            device.objects[0x605A, 0].value = option
        enabled.move(100, (0.5, 0.5, 0.5))
        before = enabled.clock.now
        enabled.drives.close()
        assert [device.state for device in enabled.devices] == [P.SWITCH_ON_DISABLED] * 3
        ramp = 0.5 / 10.0 + STANDSTILL_TIME_S
        assert enabled.clock.now - before == pytest.approx(ramp, abs=0.02)

    def test_no_compiled_cycle_runs_until_drives_that_keep_power_after_their_ramp_have_lost_it(
        self, enabled: Rig
    ) -> None:
        """Python alone sees that they stand; no frame says so."""
        for device in enabled.devices:
            device.objects[0x605A, 0].value = 6
        enabled.move(100, (0.5, 0.5, 0.5))
        assert enabled.drives.prepare_tables()
        enabled.drives.quick_stop()
        waited = 0
        while enabled.cycle().state != OFF:
            assert not enabled.drives.prepare_tables()
            waited += 1
        assert waited > STANDSTILL_TIME_S / PERIOD

    def test_before_and_after_a_failed_set_up(self) -> None:
        rig = Rig()
        rig.devices[0].objects[0x1000, 0].value = 0
        with pytest.raises(DriveError):
            rig.drives.configure(PERIOD)
        rig.drives.close()
        assert rig.bus.shutdowns == 1
        rig = Rig()
        rig.drives.close()
        assert rig.bus.shutdowns == 1


@pytest.mark.parametrize("refused", [True, False])
def test_a_node_that_missed_its_start_is_configured_again(ready: Rig, refused: bool) -> None:
    """The start at the end of a set-up is lost, or does not fit into the queue."""
    ready.cycles(5)
    a, send = ready.devices[0], ready.bus.send

    def lose(message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id != canopen_frames.NMT or message.data[0] != canopen_frames.NMT_START:
            send(message, timeout)
        elif refused:
            raise can.CanOperationError("No buffer space available", errno.ENOBUFS)

    vars(ready.bus).update(send=lose)
    a._enter(Nmt.PRE_OPERATIONAL)
    ready.cycles(1000)
    assert a.nmt is Nmt.PRE_OPERATIONAL
    vars(ready.bus).update(send=send)
    for late in (None, 0):  # with 0, an answer is read one cycle later
        ready.bus.late = late
        ready.drives.reset()
        feedback = ready.cycles(1000)
        assert not any(feedback.unready)
    assert (a.nmt, feedback.fault) == (Nmt.OPERATIONAL, None)


@pytest.mark.parametrize("waits", range(4))
def test_a_reset_before_the_first_position_after_a_restart_suffices(ready: Rig, waits: int) -> None:
    """The drive is not configured a second time, and the fault of the restart ends."""
    ready.cycles(5)
    ready.devices[0].restart(ready.clock.now)
    assert ready.cycles(5).unready[0] is not None
    receive, node = ready.bus.recv, ready.devices[0].node

    def without_positions(timeout: float | None = None) -> can.Message | None:
        """The drive's positions and heartbeats arrive late, its answers to requests do not."""
        while (message := receive(timeout)) is not None and message.arbitration_id & 0x7F == node:
            if message.arbitration_id == canopen_frames.SDO_ANSWER + node:
                break
        return message

    vars(ready.bus).update(recv=without_positions)
    while ready.cycle().unready[0] is not None:
        pass
    for _ in range(waits):
        ready.cycle()
    ready.drives.reset()
    ready.cycle()
    vars(ready.bus).update(recv=receive)
    ready.cycle()
    ready.drives.reset()  # of "no position", if the drive was awaited for long enough
    for _ in range(200):
        assert ready.cycle().unready[0] is None
    assert ready.cycle().fault is None
