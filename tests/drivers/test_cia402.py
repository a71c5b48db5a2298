"""The CiA 402 driver on a bus with simulated drives, by a clock that the tests turn."""

from __future__ import annotations

import errno
import math
from collections.abc import Iterator
from pathlib import Path

import can
import canopen
import msgspec
import pytest
from rigs import START, STEP, Bus, Clock, DriverRig, ideal_servo
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.codes import words
from trirail_drivers.cia402.drives import REPEAT_AFTER, Cia402
from trirail_drivers.cia402.eds import SERVO
from trirail_drivers.cia402.settings import interpolation_periods
from trirail_drivers.config import Drive, Drives, Homing
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import BusError, ConfigurationRefused, DriveError, DriveTimeout
from trirail_drivers.interface import PowerState
from trirail_drivers.simulated import SimulatedDrive
from trirail_drivers.simulated.dictionary import ObjectEntry

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


def changed(name: str, **keys: object) -> Drives:
    """The configuration, with one drive's keys changed."""
    return msgspec.structs.replace(CONFIG, **{name: msgspec.structs.replace(getattr(CONFIG, name), **keys)})


class Rig(DriverRig[SimulatedDrive, Cia402]):
    """CiA 402 drives, and what each was told."""

    enabled_within = 10

    def __init__(self, config: Drives = CONFIG) -> None:
        super().__init__(config, Cia402)

    def device(self, drive: Drive, counts: float) -> SimulatedDrive:
        return SimulatedDrive(drive.node, ideal_servo(drive, round(counts)))

    def sent_to(self, base: int) -> list[list[bytes]]:
        """What each drive was sent on the identifiers of one service."""
        return [[data for can_id, data in self.bus.sent if can_id == base + d.node] for d in self.devices]

    def controlwords(self) -> list[list[int]]:
        return [
            [canopen_frames.CONTROLWORD.unpack(data)[0] for data in each] for each in self.sent_to(canopen_frames.RPDO1)
        ]


@pytest.fixture
def new() -> Iterator[Rig]:
    """Drives that were just switched on."""
    rig = Rig()
    yield rig
    rig.drives.close()


class TestConfigure:
    def test_drives_hold_what_the_cycle_needs(self, ready: Rig) -> None:
        for device, drive in zip(ready.devices, CONFIG.each, strict=True):
            value = {
                key: device.objects[key].value
                for key in [
                    (0x1006, 0), (0x1016, 1), (0x1017, 0), (0x1029, 1), (0x6007, 0), (0x605A, 0), (0x605E, 0),
                    (0x6060, 0), (0x6061, 0), (0x60C2, 1), (0x60C2, 2), (0x6065, 0), (0x6085, 0),
                    (0x1400, 1), (0x1400, 2), (0x1600, 0), (0x1600, 1),
                    (0x1401, 1), (0x1401, 2), (0x1601, 0), (0x1601, 1), (0x1601, 2),
                    (0x1800, 2), (0x1800, 5), (0x1A00, 0), (0x1A00, 1), (0x1801, 2), (0x1A01, 0), (0x1A01, 1),
                ]
            }  # fmt: skip
            assert value == {
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
            assert device.objects[0x1800, 1].value & 0x8000_07FF == 0x180 + drive.node
            assert device.objects[0x1801, 1].value & 0x8000_07FF == 0x280 + drive.node

    def test_leaves_them_operational_and_without_power(self, ready: Rig) -> None:
        assert [device.nmt for device in ready.devices] == [canopen_frames.OPERATIONAL] * 3
        assert [device.state for device in ready.devices] == [P.SWITCH_ON_DISABLED] * 3
        assert ready.drives.bus_load == pytest.approx(0.75, abs=0.001)

    def test_first_feedback_is_true_before_any_sync(self, ready: Rig) -> None:
        feedback = ready.drives.read()
        assert feedback.position == pytest.approx(START, abs=1e-6)
        assert feedback.state == (P.SWITCH_ON_DISABLED,) * 3
        assert feedback.fault is None
        assert not feedback.homing

    def test_takes_power_off_that_was_left_on(self, new: Rig) -> None:
        device = new.devices[1]
        for word in (canopen_frames.SHUTDOWN, canopen_frames.SWITCH_ON, canopen_frames.ENABLE_OPERATION):
            device.objects[0x6040, 0].write(word)
        assert device.state is P.OPERATION_ENABLED
        new.drives.configure(PERIOD)
        assert new.drives.read().state == (P.SWITCH_ON_DISABLED,) * 3

    def test_missing_drive(self) -> None:
        rig = Rig()
        rig.devices[1].silent = True
        with pytest.raises(DriveTimeout, match=r"drive B: .*1000:00 \(Device type\)") as caught:
            rig.drives.configure(PERIOD)
        assert caught.value.drive == "B"
        rig.drives.close()

    def test_wrong_device_type(self, new: Rig) -> None:
        new.devices[2].objects[0x1000, 0].value = 401
        with pytest.raises(DriveError, match=r"drive C: .*profile 401; wanted a drive, profile 402"):
            new.drives.configure(PERIOD)

    def test_value_that_does_not_stick(self, new: Rig) -> None:
        entry = new.devices[0].objects[0x6065, 0]
        entry.on_write = lambda entry, old: setattr(entry, "value", 4000)
        with pytest.raises(ConfigurationRefused, match=r"drive A: .*6065:00 .*wanted 5000, found 4000"):
            new.drives.configure(PERIOD)

    def test_mode_that_is_not_taken_up(self, new: Rig) -> None:
        new.devices[0].objects.on_write(0x6060, lambda entry, old: None)
        new.devices[0].objects[0x6061, 0].value = 3
        with pytest.raises(ConfigurationRefused, match=r"6061:00 .*wanted 8, found 3 after 0\.01\d* s"):
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
                f"drive A: object {index:04X}:{subindex:02X} ({variable.qualname}): wanted "
            )
            assert ", found " in str(refused.value)
            rig.drives.close()

    def test_drives_of_other_makes_by_their_own_eds(self, tmp_path: Path) -> None:
        text = SERVO.read_text().replace("[6085]\nParameterName=Quick stop deceleration", "[6085]\nParameterName=Ramp")
        (tmp_path / "other.eds").write_text(text)
        rig = Rig(changed("B", eds=str(tmp_path / "other.eds")))
        entry = rig.devices[1].objects[0x6085, 0]
        entry.on_write = lambda entry, old: setattr(entry, "value", 1)
        with pytest.raises(ConfigurationRefused, match=r"drive B: object 6085:00 \(Ramp\): wanted 20000000, found 1"):
            rig.drives.configure(PERIOD)
        rig.drives.close()

    def test_eds_that_is_not_there(self) -> None:
        with pytest.raises(DriveError, match=r"drive C: cannot read EDS /nowhere/x\.eds: No such file or directory"):
            Rig(changed("C", eds="/nowhere/x.eds")).drives.configure(PERIOD)

    @pytest.mark.parametrize(
        "content", [b"hello", b"\xff\xfe\x00", b"[DeviceInfo]\n[1000]\nObjectType=0x7\nDataType=zz\n"]
    )
    def test_eds_that_is_none(self, tmp_path: Path, content: bytes) -> None:
        (tmp_path / "x.eds").write_bytes(content)
        with pytest.raises(DriveError, match=r"^drive A: \S*x\.eds is not an EDS as CiA 306 has it: .+") as refused:
            Rig(changed("A", eds=str(tmp_path / "x.eds"))).drives.configure(PERIOD)
        assert "\n" not in str(refused.value)

    def test_what_an_eds_leaves_out_the_drive_is_asked_for(self, tmp_path: Path) -> None:
        text = SERVO.read_text()
        begin = text.index("[6085]")
        (tmp_path / "x.eds").write_text(text[:begin] + text[text.index("[6098]") :].replace("0x6085", "0x60F4"))
        rig = Rig(changed("A", eds=str(tmp_path / "x.eds")))
        rig.devices[0].objects[0x6085, 0].value = 5
        rig.drives.configure(PERIOD)
        assert rig.devices[0].objects[0x6085, 0].value == 10_000_000
        rig.drives.close()

    def test_homing_is_set_where_the_encoder_is_not_absolute(self) -> None:
        rig = Rig(changed("B", homing=HOMING))
        rig.drives.configure(PERIOD)
        objects = rig.devices[1].objects
        keys = [(0x6098, 0), (0x6099, 1), (0x6099, 2), (0x609A, 0), (0x607C, 0)]
        assert [objects[key].value for key in keys] == [19, 40_000, 10_000, 1_000_000, 0]
        assert rig.drives.read().homed == (True, False, True)
        assert [rig.devices[0].objects[key].value for key in keys] == [0] * 5
        rig.drives.close()

    def test_drive_without_homing_mode_is_not_homed(self) -> None:
        rig = Rig(changed("B", homing=HOMING))
        rig.devices[1].objects[0x6502, 0].value = 0x80
        with pytest.raises(DriveError, match=r"drive B: object 6502:00 .* is 00000080, without homing mode"):
            rig.drives.configure(PERIOD)
        rig.drives.close()

    def test_homing_method_that_a_drive_has_not_is_refused(self) -> None:
        rig = Rig(changed("C", homing=msgspec.structs.replace(HOMING, method=33)))
        with pytest.raises(DriveError, match=r"drive C: cannot write 33 to object 6098:00 \(Homing method\)"):
            rig.drives.configure(PERIOD)
        rig.drives.close()

    def test_drive_in_fault_is_set_up_all_the_same(self, new: Rig) -> None:
        new.devices[1].fail(0x3210)
        new.drives.configure(PERIOD)
        feedback = new.cycle()
        assert feedback.fault is not None
        assert feedback.fault[:3] == ("B", "fault", 0x3210)
        new.drives.reset()
        assert new.cycles(3).fault is None

    @pytest.mark.parametrize("bitrate", [500_000, 1_000])
    def test_full_bus_is_refused_with_the_rate_that_fits(self, new: Rig, bitrate: int) -> None:
        drives = Cia402(new.bus, bitrate, CONFIG, new.clock)
        with pytest.raises(BusError, match=r"1000 Hz takes .*%.* the highest rate that fits is \d+ Hz"):
            drives.configure(PERIOD)

    def test_two_nodes_of_one_number_are_refused(self) -> None:
        config = Drives(protocol="cia402", A=CONFIG.A, B=CONFIG.A, C=CONFIG.C)
        bus = Bus([], Clock(), {})
        with pytest.raises(DriveError, match=r"must differ, but are drives.A.node = 1, drives.B.node = 1"):
            Cia402(bus, 1_000_000, config).configure(PERIOD)

    def test_node_0_is_no_drives(self) -> None:
        config = Drives(protocol="cia402", A=Drive(node=0, counts_per_metre=1e6), B=CONFIG.B, C=CONFIG.C)
        with pytest.raises(DriveError, match=r"drives.A.node = 0: that is all nodes' on CANopen"):
            Cia402(Bus([], Clock(), {}), 1_000_000, config).configure(PERIOD)

    @pytest.mark.parametrize("heartbeat", [0.0001, 30.0])
    def test_heartbeat_beyond_a_drives_range_is_refused(self, heartbeat: float) -> None:
        config = Drives(protocol="cia402", A=CONFIG.A, B=CONFIG.B, C=CONFIG.C, heartbeat=heartbeat)
        with pytest.raises(DriveError, match=r"heartbeat .*0\.001 to 21\.845|highest rate that fits"):
            Cia402(Bus([], Clock(), {}), 1_000_000, config).configure(PERIOD)

    @pytest.mark.parametrize(
        ("rate", "said"),
        [(1000, (1, -3)), (400, (25, -4)), (800, (125, -5)), (100, (10, -3)), (200, (5, -3)), (4000, (25, -5))],
    )
    def test_period_as_value_and_power_of_ten(self, rate: float, said: tuple[int, int]) -> None:
        assert interpolation_periods(1 / rate)[0] == said

    @pytest.mark.parametrize("rate", [300, 3000, 700])
    def test_period_that_no_drive_can_be_told(self, rate: float) -> None:
        with pytest.raises(DriveError, match=r"60C2h .*the nearest is .* Hz\)"):
            interpolation_periods(1 / rate)


class TestPower:
    def test_controlwords_in_order_and_only_on_change(self, ready: Rig) -> None:
        ready.cycles(3)
        assert ready.controlwords() == [[], [], []]
        ready.enable()
        ready.cycles(5)
        assert ready.controlwords() == [[0x06, 0x07, 0x0F]] * 3

    def test_enabling_is_up_to_the_cycles(self, ready: Rig) -> None:
        ready.drives.enable()
        assert ready.bus.sent == []

    def test_setpoints_come_before_each_step_of_power(self, ready: Rig) -> None:
        ready.drives.enable()
        ready.cycle()
        ids = [can_id for can_id, _ in ready.bus.sent]
        last_setpoint = max(i for i, can_id in enumerate(ids) if can_id & 0x780 == canopen_frames.RPDO2)
        first_controlword = min(i for i, can_id in enumerate(ids) if can_id & 0x780 == canopen_frames.RPDO1)
        assert last_setpoint < first_controlword

    def test_disable_takes_power_off(self, enabled: Rig) -> None:
        enabled.drives.disable()
        assert enabled.controlwords() == [[0x00]] * 3
        feedback = enabled.cycle()
        assert feedback.state == (P.SWITCH_ON_DISABLED,) * 3
        assert feedback.fault is None

    def test_disabled_drives_can_be_enabled_again(self, enabled: Rig) -> None:
        enabled.drives.disable()
        enabled.cycle()
        assert enabled.enable().fault is None

    def test_quick_stop_reaches_all_three_in_its_cycle_in_place_of_setpoints(self, enabled: Rig) -> None:
        enabled.clock.now += PERIOD
        enabled.drives.sync()
        feedback = enabled.drives.read()
        enabled.bus.sent.clear()
        enabled.drives.quick_stop()
        enabled.drives.write(feedback.position, ZERO)
        assert enabled.bus.sent == [(canopen_frames.RPDO1 + d.node, b"\x02\x00") for d in enabled.devices]

    def test_quick_stop_from_speed_ends_without_power_until_enabled(self, enabled: Rig) -> None:
        position = list(START)
        for _ in range(100):
            position = [p + 0.5 * PERIOD for p in position]
            enabled.cycle((position[0], position[1], position[2]), (0.5, 0.5, 0.5))
        enabled.drives.quick_stop()
        states = {enabled.cycle().state for _ in range(100)}
        assert (P.QUICK_STOP_ACTIVE,) * 3 in states
        feedback = enabled.cycles(50)
        assert feedback.state == (P.SWITCH_ON_DISABLED,) * 3
        assert feedback.fault is None
        assert enabled.enable().fault is None

    def test_a_controlword_that_got_lost_is_sent_again(self, enabled: Rig) -> None:
        enabled.bus.faults.add("B drop rpdo1 for 1 frame")
        enabled.drives.quick_stop()
        enabled.cycles(REPEAT_AFTER - 1)
        assert enabled.controlwords() == [[0x02]] * 3  # its statusword may still be on the way
        feedback = enabled.cycles(7)
        assert feedback.state == (P.SWITCH_ON_DISABLED,) * 3
        assert enabled.controlwords() == [[0x02], [0x02, 0x02], [0x02]]

    def test_a_drive_that_does_not_come_to_stand_loses_its_power(self, enabled: Rig) -> None:
        enabled.devices[2].servo.forced_velocity = 1000.0
        enabled.drives.quick_stop()
        enabled.cycles(990)
        assert enabled.devices[2].state is P.QUICK_STOP_ACTIVE
        assert enabled.cycles(20).state == (P.SWITCH_ON_DISABLED,) * 3
        assert enabled.devices[2].servo.velocity == 0.0

    def test_drive_that_does_not_stop_is_named_with_its_state(self, enabled: Rig) -> None:
        enabled.devices[1].objects.on_write(0x6040, lambda entry, old: None)
        enabled.drives.quick_stop()
        feedback = enabled.cycles(round(CONFIG.stop_timeout / PERIOD) - 1)
        assert feedback.fault is None
        assert enabled.found("timeout", within=3).fault == (
            "B", "timeout", 0,
            "drive B: is operation enabled 1 s after quick stop; switch on disabled was expected",
        )  # fmt: skip

    def test_drive_that_stays_in_quick_stop_loses_its_power_once_it_stands(self, enabled: Rig) -> None:
        enabled.devices[2].objects[0x605A, 0].value = 6
        enabled.drives.quick_stop()
        enabled.cycles(1010)
        assert set(enabled.cycle().state) == {PowerState.SWITCH_ON_DISABLED}

    def test_drive_that_does_not_stop_after_a_fault_is_told_of_as_well(self, enabled: Rig) -> None:
        enabled.devices[1].objects.on_write(0x6040, lambda entry, old: None)
        enabled.devices[0].fail(0x4310)
        fault = enabled.found("emcy", within=2).fault
        enabled.cycles(1010)
        assert fault is not None
        assert fault.drive == "A"
        fault = enabled.cycle().fault
        assert fault is not None
        assert fault[:3] == ("B", "timeout", 0)

    def test_drive_that_keeps_its_power_when_disabled_is_named_with_its_state(self, enabled: Rig) -> None:
        enabled.devices[0].objects.on_write(0x6040, lambda entry, old: None)
        enabled.drives.disable()
        fault = enabled.found("timeout", within=1010).fault
        assert fault is not None
        assert fault.message == "drive A: is operation enabled 1 s after disable; switch on disabled was expected"

    def test_drive_that_keeps_its_power_after_a_reset_is_told_of_again(self, enabled: Rig) -> None:
        enabled.devices[1].objects.on_write(0x6040, lambda entry, old: None)
        enabled.drives.quick_stop()
        enabled.found("timeout", within=1010)
        enabled.drives.reset()
        assert enabled.cycles(round(CONFIG.stop_timeout / PERIOD) - 1).fault is None
        fault = enabled.found("timeout", within=3).fault
        assert fault is not None
        assert fault.message == "drive B: is operation enabled 1 s after reset; switch on disabled was expected"

    def test_drives_that_stop_and_lose_power_are_no_fault(self, enabled: Rig) -> None:
        enabled.drives.disable()
        assert enabled.cycles(1500).fault is None
        enabled.enable()
        enabled.drives.quick_stop()
        assert enabled.cycles(1500).fault is None
        assert enabled.enable().fault is None
        assert enabled.cycles(1500).fault is None

    def test_drive_that_drops_out_unasked(self, enabled: Rig) -> None:
        enabled.devices[1].objects[0x6040, 0].write(canopen_frames.DISABLE_VOLTAGE)
        feedback = enabled.found("state", within=1)
        assert feedback.fault is not None
        assert feedback.fault.drive == "B"
        assert "switch on disabled" in feedback.fault.message
        assert enabled.controlwords() == [[0x02]] * 3

    def test_impossible_statusword(self, enabled: Rig) -> None:
        enabled.bus.inject(canopen_frames.TPDO1 + 1, b"\x01\x00")
        assert enabled.drives.read().fault == (
            "A", "state", 0, "drive A: statusword 0001 is that of no CiA 402 state"
        )  # fmt: skip


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
    def test_emergency_names_drive_and_code_and_stops_the_others(self, enabled: Rig) -> None:
        enabled.devices[2].fail(0x8611)
        feedback = enabled.found("emcy", within=2)
        assert feedback.fault is not None
        assert feedback.fault[:3] == ("C", "emcy", 0x8611)
        assert "8611" in feedback.fault.message
        assert enabled.controlwords() == [[0x02]] * 3
        feedback = enabled.cycles(20)
        assert feedback.state == (P.SWITCH_ON_DISABLED, P.SWITCH_ON_DISABLED, P.FAULT)

    def test_end_of_errors_is_no_fault(self, enabled: Rig) -> None:
        enabled.bus.inject(canopen_frames.EMCY + 1, bytes(8))
        assert enabled.cycle().fault is None

    def test_fault_without_emergency(self, enabled: Rig) -> None:
        enabled.bus.inject(canopen_frames.TPDO1 + 5, b"\x18\x02")
        fault = enabled.drives.read().fault
        assert fault == ("B", "fault", 0, "drive B: fault")

    def test_the_first_fault_stays(self, enabled: Rig) -> None:
        enabled.devices[0].fail(0x2310)
        enabled.cycle()
        enabled.devices[1].fail(0x3210)
        fault = enabled.cycles(5).fault
        assert fault is not None
        assert fault[:3] == ("A", "emcy", 0x2310)

    def test_prompt_positions_have_no_age_and_lost_ones_leave_none(self, ready: Rig) -> None:
        assert ready.cycle().age == (0, 0, 0)
        ready.devices[1].silent = True
        assert [ready.cycle().age for _ in range(2)] == [(0, 1, 0), (0, 2, 0)]
        ready.devices[1].silent = False
        assert ready.cycle().age == (0, 0, 0)

    def test_position_that_is_there_before_the_next_sync_answers_the_last_one(self, ready: Rig) -> None:
        ready.cycles(3)
        for node in (1, 5, 9):
            ready.devices[(1, 5, 9).index(node)].silent = True
        for _ in range(5):
            ready.clock.now += PERIOD
            ready.drives.sync()
            assert ready.drives.read().fault is None
            for node in (1, 5, 9):
                ready.bus.inject(canopen_frames.TPDO2 + node, bytes(4))
        ready.drives.sync()
        feedback = ready.drives.read()
        assert feedback.age == (1, 1, 1)
        assert feedback.fault is None
        for device in ready.devices:
            device.silent = False

    def test_one_lost_position_is_not(self, ready: Rig) -> None:
        for _ in range(5):
            ready.devices[1].silent = True
            ready.cycles(2)
            ready.devices[1].silent = False
            assert ready.cycle().fault is None

    def test_emergency_in_force_is_no_matter_of_the_past(self, ready: Rig) -> None:
        ready.devices[1].errors.report(0x4210)
        ready.found("emcy", within=1)
        ready.drives.reset()
        fault = ready.cycle().fault
        assert fault is not None
        assert fault[:3] == ("B", "emcy", 0x4210)
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

    def test_lost_statuswords(self, ready: Rig) -> None:
        ready.cycle()
        ready.bus.faults.add("A drop tpdo1")
        feedback = ready.found("silent", within=350)
        assert feedback.fault is not None
        assert "no statusword" in feedback.fault.message

    def test_lost_heartbeat(self, ready: Rig) -> None:
        ready.cycle()
        ready.devices[0].objects[0x1017, 0].write(0)
        start = ready.clock.now
        feedback = ready.found("heartbeat", within=500)
        assert feedback.fault is not None
        assert feedback.fault.drive == "A"
        assert 0.2 <= ready.clock.now - start <= 0.3 + 2 * PERIOD

    @pytest.mark.parametrize(
        ("base", "data"),
        [
            (canopen_frames.TPDO2, b"\0\0\0"),
            (canopen_frames.TPDO1, b"\0\0\0"),
            (canopen_frames.EMCY, b"\0"),
            (canopen_frames.HEARTBEAT, b""),
        ],
    )
    def test_frame_of_wrong_length(self, ready: Rig, base: int, data: bytes) -> None:
        ready.cycle()
        ready.bus.inject(base + 9, data)
        fault = ready.drives.read().fault
        assert fault is not None
        assert (fault.drive, fault.cause) == ("C", "frame")

    def test_restarted_drive_stays_a_fault(self, ready: Rig) -> None:
        ready.cycle()
        ready.bus.send(can.Message(arbitration_id=0, data=[129, 5], is_extended_id=False))
        fault = ready.cycle().fault
        assert fault is not None
        assert (fault.drive, fault.cause) == ("B", "state")
        assert "restart" in fault.message
        assert ready.drives.read().state[1] is P.NOT_READY_TO_SWITCH_ON
        ready.drives.reset()
        assert ready.cycle().fault == fault

    def test_drive_that_left_operational_is_started_again_by_reset(self, ready: Rig) -> None:
        ready.cycles(150)
        ready.bus.send(can.Message(arbitration_id=0, data=[128, 9], is_extended_id=False))
        ready.found("silent", within=3)
        ready.cycles(150)
        ready.drives.reset()
        assert ready.cycles(200).fault is None

    def test_bus_that_takes_no_frame(self, enabled: Rig) -> None:
        enabled.bus.broken = True
        feedback = enabled.cycles(2)
        assert feedback.fault is None  # a queue that is full for a cycle or two
        assert [counts.setpoints_lost for counts in enabled.cycle().counts] == [2, 2, 2]
        feedback = enabled.found("bus", within=1)
        assert feedback.fault is not None
        assert feedback.fault.drive == ""
        assert "Transmit buffer full" in feedback.fault.message
        assert "txqueuelen" in feedback.fault.message
        enabled.bus.broken = False
        enabled.cycle()
        assert enabled.controlwords() == [[0x02]] * 3

    def test_interface_that_is_down_is_no_full_queue(self, enabled: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(msg: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN)

        monkeypatch.setattr(enabled.bus, "send", fail)
        fault = enabled.found("bus", within=1).fault
        assert fault is not None
        assert "ip link set DEV up" in fault.message
        monkeypatch.undo()

    def test_a_full_queue_is_told_once_and_stops_first_what_must_stop(self, enabled: Rig) -> None:
        enabled.bus.broken = True
        assert "txqueuelen" in enabled.cycle().warnings[0]
        assert enabled.cycle().warnings == ()
        enabled.drives.quick_stop()
        enabled.bus.broken = False
        enabled.bus.sent.clear()
        enabled.drives.sync()
        enabled.drives.write(enabled.drives.read().position, ZERO)
        order = [can_id & 0x780 for can_id, _ in enabled.bus.sent]
        assert order == [canopen_frames.SYNC, *[canopen_frames.RPDO1] * 3, *[canopen_frames.RPDO2] * 3]

    def test_a_controller_near_its_end_is_told_of_and_no_fault(self, enabled: Rig) -> None:
        for _ in range(3):
            enabled.bus.inject(0x004, b"\0\x20" + bytes(6), is_error_frame=True)
        feedback = enabled.cycle()
        assert feedback.fault is None
        assert len(feedback.warnings) == 1
        assert "error-passive" in feedback.warnings[0]
        assert enabled.cycles(3).warnings == ()

    def test_bus_that_gives_no_frame(self, enabled: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(timeout: float | None = None) -> can.Message | None:
            raise can.CanOperationError("Network is down")

        monkeypatch.setattr(enabled.bus, "recv", fail)
        fault = enabled.found("bus", within=1).fault
        assert fault is not None
        assert "Network is down" in fault.message
        monkeypatch.undo()

    def test_frames_of_others_are_no_concern(self, enabled: Rig) -> None:
        enabled.bus.inject(canopen_frames.TPDO2 + 20, b"\xff")
        enabled.bus.inject(canopen_frames.TPDO2 + 1, b"\xff" * 4, is_extended_id=True)
        enabled.bus.inject(canopen_frames.TPDO2 + 1, b"", is_remote_frame=True)
        enabled.bus.inject(canopen_frames.TPDO1 + 1, bytes(8), is_error_frame=True)
        feedback = enabled.cycle()
        assert feedback.fault is None
        assert feedback.position == pytest.approx(START, abs=1e-6)


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
        assert late.controlwords() == [[0x06, 0x07, 0x0F]] * 3

    def test_position_is_that_of_the_sync_before(self, late: Rig) -> None:
        late.enable()
        late.cycle((START[0] + 1e-5, START[1], START[2]))
        positions = [late.cycle((START[0] + 1e-5, START[1], START[2])).position[0] for _ in range(4)]
        assert positions == pytest.approx([START[0], START[0], START[0] + 1e-5, START[0] + 1e-5], abs=1e-6)

    def test_positions_that_always_take_long_are_not_late(self, late: Rig) -> None:
        assert [(c.feedback_late, c.feedback_lost) for c in late.cycles(20).counts] == [(0, 0)] * 3

    def test_late_positions_are_counted_as_late_and_lost_ones_as_lost(self, ready: Rig) -> None:
        ready.cycle()
        ready.bus.faults.add("B delay 0.0005 tpdo2 for 1 frame")
        ready.cycle()
        assert [(c.feedback_late, c.feedback_lost) for c in ready.cycle().counts] == [(0, 0), (1, 0), (0, 0)]
        ready.bus.faults.add("C drop tpdo2 for 2 frames")
        assert [(c.feedback_late, c.feedback_lost) for c in ready.cycles(9).counts] == [(0, 0), (1, 0), (0, 2)]

    def test_age_of_the_position_is_told(self, late: Rig) -> None:
        assert [late.cycle().age for _ in range(5)] == [(1, 1, 1)] * 5

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
        assert late.cycle().fault is None
        assert late.cycle().fault is None
        fault = late.cycle().fault
        assert fault is not None
        assert fault[:3] == ("C", "silent", 0)

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
        assert feedback.fault is None
        assert feedback.state == (P.SWITCH_ON_DISABLED,) * 3
        assert enabled.controlwords() == [[0x02], [0x02], [0x02, 0x80, 0x02]]
        assert enabled.cycles(50).state == (P.SWITCH_ON_DISABLED,) * 3
        assert enabled.enable().fault is None

    def test_while_the_cause_lasts_the_fault_comes_back(self, ready: Rig) -> None:
        ready.cycle()
        ready.devices[1].silent = True
        ready.found("silent", within=3)
        ready.drives.reset()
        assert ready.cycle().fault is not None
        ready.devices[1].silent = False
        ready.drives.reset()
        assert ready.cycles(5).fault is None

    def test_drive_that_does_not_leave_fault(self, enabled: Rig) -> None:
        enabled.devices[0].fail(0x2310)
        enabled.cycles(20)
        enabled.devices[0].objects.on_write(0x6040, lambda entry, old: None)
        enabled.drives.reset()
        assert enabled.cycle().fault is None
        feedback = enabled.found("fault", within=250)
        assert feedback.fault is not None
        assert feedback.fault[:3] == ("A", "fault", 0x2310)
        assert feedback.fault.message == (f"drive A: fault, error {words(0x2310, ', still 0.2 s after a fault reset')}")
        enabled.cycle()
        assert enabled.controlwords()[0] == [0x02, 0x80, 0x02]

    def test_nothing_is_enabled_while_a_fault_is_latched(self, enabled: Rig) -> None:
        enabled.devices[0].fail(0x2310)
        enabled.cycles(20)
        enabled.drives.enable()
        assert enabled.cycles(10).state[1] is P.SWITCH_ON_DISABLED

    def test_without_a_fault_changes_nothing(self, enabled: Rig) -> None:
        enabled.drives.reset()
        feedback = enabled.cycles(3)
        assert feedback.state == (P.OPERATION_ENABLED,) * 3
        assert enabled.controlwords() == [[], [], []]


class TestHeartbeat:
    def test_is_sent_from_the_cycle_at_its_period(self, ready: Rig) -> None:
        ready.cycles(1000)
        heartbeats = [data for can_id, data in ready.bus.sent if can_id == canopen_frames.HEARTBEAT + 126]
        assert heartbeats == [bytes([canopen_frames.OPERATIONAL])] * 10

    def test_without_it_the_drives_stop_by_themselves(self, enabled: Rig) -> None:
        enabled.clock.now += 10.0
        while enabled.bus.recv(0) is not None:
            pass
        enabled.clock.now += 1.0
        while enabled.bus.recv(0) is not None:
            pass
        assert P.OPERATION_ENABLED not in {device.state for device in enabled.devices}


class TestClose:
    def test_leaves_drives_without_power_and_pre_operational(self, enabled: Rig) -> None:
        enabled.drives.close()
        assert [device.state for device in enabled.devices] == [P.SWITCH_ON_DISABLED] * 3
        assert [device.nmt for device in enabled.devices] == [canopen_frames.PRE_OPERATIONAL] * 3
        assert enabled.controlwords() == [[0x02, 0x00]] * 3
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
        position = list(START)
        for _ in range(100):
            position = [p + 0.5 * PERIOD for p in position]
            enabled.cycle((position[0], position[1], position[2]), (0.5, 0.5, 0.5))
        before = enabled.clock.now
        enabled.drives.close()
        assert [device.state for device in enabled.devices] == [P.SWITCH_ON_DISABLED] * 3
        assert 0.5 / 10.0 <= enabled.clock.now - before < 0.5 / 10.0 + 0.02
        assert enabled.controlwords() == [[0x02, 0x00]] * 3

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
