"""The CiA 402 driver on a bus with simulated drives, by a clock that the tests turn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import can
import pytest

from drivers import frames
from drivers.cia402 import Cia402
from drivers.config import Drive, Drives
from drivers.errors import BusError, ConfigurationRefused, DriveError, DriveTimeout
from drivers.interface import Feedback, PowerState, Triple
from drivers.setup402 import interpolation_period
from drivers.simulated import Servo, SimulatedBus, SimulatedDevice, SimulatedDrive

P = PowerState
PERIOD = 0.001
START = (0.01, -0.02, 0.03)
ZERO = (0.0, 0.0, 0.0)
CONFIG = Drives(
    protocol="cia402",
    A=Drive(node=1, counts_per_metre=1e6),
    B=Drive(node=5, counts_per_metre=2e6, direction=-1, offset=0.1),
    C=Drive(node=9, counts_per_metre=1e6),
    sdo_timeout=0.01,
)


class Clock:
    """Time that passes when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Bus(SimulatedBus):
    """The simulated bus, with a record of what the master sends, ways to break it, and waits in no time."""

    def __init__(self, drives: Sequence[SimulatedDevice], clock: Clock) -> None:
        self.time = clock
        self.sent: list[tuple[int, bytes]] = []
        self.broken = False
        self.shutdowns = 0
        self.late: int | None = None
        """On a real bus, a cycle reads the answers to the SYNC before its own: how many of these are left."""
        super().__init__(drives, clock)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.broken:
            raise can.CanOperationError("Transmit buffer full")
        self.sent.append((msg.arbitration_id, bytes(msg.data)))
        if msg.arbitration_id == frames.SYNC and self.late is not None:
            self.late = len(self._arrived)
        super().send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.late is not None:
            if not self.late:
                return None
            self.late -= 1
        end = self.time.now + (timeout or 0.0)
        while (message := super().recv(0)) is None and self.time.now < end:
            self.time.now += PERIOD
        return message

    def inject(self, can_id: int, data: bytes, **flags: bool) -> None:
        message = can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **flags})
        self._arrived.append(message)

    def shutdown(self) -> None:
        self.shutdowns += 1
        super().shutdown()


class Rig:
    """Three simulated drives, the driver, and a loop that holds position."""

    def __init__(self, config: Drives = CONFIG) -> None:
        self.clock = Clock()
        self.devices = [
            SimulatedDrive(
                drive.node,
                Servo(
                    round(drive.direction * (start - drive.offset) * drive.counts_per_metre),
                    time_constant=0.0,
                    max_velocity=2.0 * drive.counts_per_metre,
                    max_acceleration=1000.0 * drive.counts_per_metre,
                ),
            )
            for drive, start in zip(config.each, START, strict=True)
        ]
        self.bus = Bus(self.devices, self.clock)
        self.config = config
        self.drives = Cia402(self.bus, 1_000_000, config, self.clock)

    def cycle(self, position: Triple | None = None, velocity: Triple = ZERO) -> Feedback:
        self.clock.now += PERIOD
        self.drives.sync()
        feedback = self.drives.read()
        self.drives.write(feedback.position if position is None else position, velocity)
        return feedback

    def cycles(self, n: int) -> Feedback:
        for _ in range(n - 1):
            self.cycle()
        return self.cycle()

    def enable(self) -> Feedback:
        self.drives.enable()
        for _ in range(10):
            feedback = self.cycle()
            if feedback.state == (P.OPERATION_ENABLED,) * 3:
                return feedback
        raise AssertionError(f"not enabled: {feedback}")

    def sent_to(self, base: int) -> list[list[bytes]]:
        """What each drive was sent on the identifiers of one service."""
        return [[data for can_id, data in self.bus.sent if can_id == base + d.node] for d in self.devices]

    def controlwords(self) -> list[list[int]]:
        return [[frames.CONTROLWORD.unpack(data)[0] for data in each] for each in self.sent_to(frames.RPDO1)]

    def found(self, cause: str, within: int) -> Feedback:
        """Cycle until there is a fault, and see that it has this cause."""
        for _ in range(within):
            feedback = self.cycle()
            if feedback.fault is not None:
                assert feedback.fault.cause == cause
                return feedback
        raise AssertionError(f"no fault: {feedback}")


@pytest.fixture
def new() -> Iterator[Rig]:
    """Drives that were just switched on."""
    rig = Rig()
    yield rig
    rig.drives.close()


@pytest.fixture
def ready(new: Rig) -> Rig:
    """Drives that are set up, without power."""
    new.drives.configure(PERIOD)
    new.bus.sent.clear()
    return new


@pytest.fixture
def enabled(ready: Rig) -> Rig:
    """Drives with power, holding their position."""
    ready.enable()
    ready.bus.sent.clear()
    return ready


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
        assert [device.nmt for device in ready.devices] == [frames.OPERATIONAL] * 3
        assert [device.state for device in ready.devices] == [P.SWITCH_ON_DISABLED] * 3
        assert ready.drives.bus_load == pytest.approx(0.75, abs=0.001)

    def test_first_feedback_is_true_before_any_sync(self, ready: Rig) -> None:
        feedback = ready.drives.read()
        assert feedback.position == pytest.approx(START, abs=1e-6)
        assert feedback.state == (P.SWITCH_ON_DISABLED,) * 3
        assert feedback.fault is None

    def test_takes_power_off_that_was_left_on(self, new: Rig) -> None:
        device = new.devices[1]
        for word in (frames.SHUTDOWN, frames.SWITCH_ON, frames.ENABLE_OPERATION):
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
        with pytest.raises(ConfigurationRefused, match=r"6061:00 .*wanted 8, found 0"):
            new.drives.configure(PERIOD)

    def test_refused_write_tells_the_drives_reason(self, new: Rig) -> None:
        new.devices[2].objects[0x6085, 0]._limits = None
        with pytest.raises(
            DriveError, match=r"drive C: cannot write 10000000 to object 6085:00 .*read only .*06010002"
        ):
            new.drives.configure(PERIOD)

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
        bus = Bus([], Clock())
        with pytest.raises(DriveError, match="must differ, but are 1, 1, 9, 126"):
            Cia402(bus, 1_000_000, config).configure(PERIOD)

    def test_node_0_is_no_drives(self) -> None:
        config = Drives(protocol="cia402", A=Drive(node=0, counts_per_metre=1e6), B=CONFIG.B, C=CONFIG.C)
        with pytest.raises(DriveError, match="node id 0 is all nodes' on CANopen"):
            Cia402(Bus([], Clock()), 1_000_000, config).configure(PERIOD)

    @pytest.mark.parametrize("heartbeat", [0.0001, 30.0])
    def test_heartbeat_beyond_a_drives_range_is_refused(self, heartbeat: float) -> None:
        config = Drives(protocol="cia402", A=CONFIG.A, B=CONFIG.B, C=CONFIG.C, heartbeat=heartbeat)
        with pytest.raises(DriveError, match=r"heartbeat .*0\.001 to 21\.845|highest rate that fits"):
            Cia402(Bus([], Clock()), 1_000_000, config).configure(PERIOD)

    def test_dead_bus(self, new: Rig) -> None:
        new.bus.broken = True
        with pytest.raises(BusError, match="cannot send"):
            new.drives.configure(PERIOD)

    @pytest.mark.parametrize(
        ("rate", "said"),
        [(1000, (1, -3)), (400, (25, -4)), (800, (125, -5)), (100, (1, -2)), (4000, (25, -5))],
    )
    def test_period_as_value_and_power_of_ten(self, rate: float, said: tuple[int, int]) -> None:
        assert interpolation_period(1 / rate) == said

    @pytest.mark.parametrize("rate", [300, 3000, 700])
    def test_period_that_no_drive_can_be_told(self, rate: float) -> None:
        with pytest.raises(DriveError, match=r"60C2h .*the nearest is .* Hz\)"):
            interpolation_period(1 / rate)


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
        last_setpoint = max(i for i, can_id in enumerate(ids) if can_id & 0x780 == frames.RPDO2)
        first_controlword = min(i for i, can_id in enumerate(ids) if can_id & 0x780 == frames.RPDO1)
        assert last_setpoint < first_controlword

    def test_nothing_moves_on_enabling(self, ready: Rig) -> None:
        ready.enable()
        feedback = ready.cycles(50)
        assert feedback.position == pytest.approx(START, abs=1e-6)
        assert feedback.fault is None

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
        assert enabled.bus.sent == [(frames.RPDO1 + d.node, b"\x02\x00") for d in enabled.devices]

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

    def test_drive_that_drops_out_unasked(self, enabled: Rig) -> None:
        enabled.devices[1].objects[0x6040, 0].write(frames.DISABLE_VOLTAGE)
        feedback = enabled.found("state", within=1)
        assert feedback.fault is not None
        assert feedback.fault.drive == "B"
        assert "switch on disabled" in feedback.fault.message
        assert enabled.controlwords() == [[0x02]] * 3

    def test_impossible_statusword(self, enabled: Rig) -> None:
        enabled.bus.inject(frames.TPDO1 + 1, b"\x01\x00")
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
        velocities = [frames.SETPOINT.unpack(each[-1])[1] for each in enabled.sent_to(frames.RPDO2)]
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
        assert enabled.bus.sent == [(frames.RPDO1 + d.node, b"\x02\x00") for d in enabled.devices]
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
        enabled.bus.inject(frames.EMCY + 1, bytes(8))
        assert enabled.cycle().fault is None

    def test_fault_without_emergency(self, enabled: Rig) -> None:
        enabled.bus.inject(frames.TPDO1 + 5, b"\x18\x02")
        fault = enabled.drives.read().fault
        assert fault == ("B", "fault", 0, "drive B: fault")

    def test_the_first_fault_stays(self, enabled: Rig) -> None:
        enabled.devices[0].fail(0x2310)
        enabled.cycle()
        enabled.devices[1].fail(0x3210)
        fault = enabled.cycles(5).fault
        assert fault is not None
        assert fault[:3] == ("A", "emcy", 0x2310)

    def test_silence_is_a_fault_at_the_third_sync(self, ready: Rig) -> None:
        ready.cycle()
        ready.devices[1].silent = True
        assert ready.cycle().fault is None
        assert ready.cycle().fault is None
        fault = ready.cycle().fault
        assert fault is not None
        assert fault[:3] == ("B", "silent", 0)

    def test_one_lost_position_is_not(self, ready: Rig) -> None:
        for _ in range(5):
            ready.devices[1].silent = True
            ready.cycles(2)
            ready.devices[1].silent = False
            assert ready.cycle().fault is None

    def test_lost_heartbeat(self, ready: Rig) -> None:
        ready.cycle()
        ready.devices[0].objects[0x1017, 0].write(0)
        start = ready.clock.now
        feedback = ready.found("heartbeat", within=500)
        assert feedback.fault is not None
        assert feedback.fault.drive == "A"
        assert 0.2 <= ready.clock.now - start <= 0.3 + 2 * PERIOD

    def test_time_between_set_up_and_first_cycle_is_no_loss(self, ready: Rig) -> None:
        ready.clock.now += 30.0
        assert ready.cycles(3).fault is None

    @pytest.mark.parametrize(
        ("base", "data"),
        [
            (frames.TPDO2, b"\0\0\0"),
            (frames.TPDO1, b"\0\0\0"),
            (frames.EMCY, b"\0"),
            (frames.HEARTBEAT, b""),
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
        feedback = enabled.found("bus", within=1)
        assert feedback.fault is not None
        assert feedback.fault.drive == ""
        assert "Transmit buffer full" in feedback.fault.message
        enabled.bus.broken = False
        enabled.cycle()
        assert enabled.controlwords() == [[0x02]] * 3

    def test_bus_that_gives_no_frame(self, enabled: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(timeout: float | None = None) -> can.Message | None:
            raise can.CanOperationError("Network is down")

        monkeypatch.setattr(enabled.bus, "recv", fail)
        fault = enabled.found("bus", within=1).fault
        assert fault is not None
        assert "Network is down" in fault.message
        monkeypatch.undo()

    def test_bus_off(self, enabled: Rig) -> None:
        enabled.bus.inject(0x040, bytes(8), is_error_frame=True)
        fault = enabled.found("bus", within=1).fault
        assert fault is not None
        assert "bus-off" in fault.message

    def test_frames_of_others_are_no_concern(self, enabled: Rig) -> None:
        enabled.bus.inject(frames.TPDO2 + 20, b"\xff")
        enabled.bus.inject(frames.TPDO2 + 1, b"\xff" * 4, is_extended_id=True)
        enabled.bus.inject(frames.TPDO2 + 1, b"", is_remote_frame=True)
        enabled.bus.inject(frames.TPDO1 + 1, bytes(8), is_error_frame=True)
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
        heartbeats = [data for can_id, data in ready.bus.sent if can_id == frames.HEARTBEAT + 126]
        assert heartbeats == [bytes([frames.OPERATIONAL])] * 10

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
        assert [device.nmt for device in enabled.devices] == [frames.PRE_OPERATIONAL] * 3
        assert enabled.controlwords() == [[0x02, 0x00]] * 3
        assert enabled.bus.shutdowns == 1

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

    def test_twice_is_once(self, enabled: Rig) -> None:
        enabled.drives.close()
        enabled.bus.sent.clear()
        enabled.drives.close()
        assert enabled.bus.sent == []
        assert enabled.bus.shutdowns == 1

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

    def test_on_a_dead_bus(self, enabled: Rig) -> None:
        enabled.bus.broken = True
        enabled.drives.close()
        assert enabled.bus.shutdowns == 1
