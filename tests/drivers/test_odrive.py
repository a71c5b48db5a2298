"""The ODrive driver on a bus with simulated ODrives, by a clock that the tests turn."""

from __future__ import annotations

import errno
import math
import struct
from collections.abc import Callable, Iterator

import can
import msgspec
import numpy as np
import pytest
from control_rig import CONFIG as ROBOT
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rigs import ENABLED, OFF, START, STEP, Bus, Clock, Closing, DriverRig, frame, ideal_servo
from trirail.config import Config
from trirail_drivers.cia402 import other_masters
from trirail_drivers.config import Drive, Drives
from trirail_drivers.errors import BusError, DriveError, DriveTimeout
from trirail_drivers.interface import Feedback, PowerState, Triple
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.axis import ENABLE_ATTEMPTS
from trirail_drivers.odrive.cansimple import AxisState, Error, ProcedureResult
from trirail_drivers.odrive.codes import describe_errors
from trirail_drivers.odrive.drives import MODES_SENT, Odrive
from trirail_drivers.odrive.flat_endpoints import Version
from trirail_drivers.odrive.other_masters import check_exclusive
from trirail_drivers.odrive.protections import HEARTBEAT
from trirail_drivers.odrive.setpoints import SETTLE_TIME_S
from trirail_drivers.simulated import SimulatedOdrive
from trirail_drivers.simulated.faultlines import FaultSyntaxError
from trirail_drivers.timing import BusTiming

P = PowerState
PERIOD = STEP
ZERO = (0.0, 0.0, 0.0)
SPEED = (0.5, 0.4, -0.3)
CONFIG = Drives(
    protocol="odrive",
    A=Drive(node=0, counts_per_metre=25.0),
    B=Drive(node=7, counts_per_metre=50.0, direction=-1, offset=0.1),
    C=Drive(node=62, counts_per_metre=25.0),
    sdo_timeout=0.01,
)
COMMANDS = {cansimple.SET_AXIS_STATE, cansimple.SET_CONTROLLER_MODE, cansimple.CLEAR_ERRORS, cansimple.ESTOP}


class Rig(DriverRig[SimulatedOdrive, Odrive]):
    """ODrives, how they are moved, and what each was told."""

    enabled_within = 150
    off = cansimple.SET_AXIS_STATE, AxisState.IDLE
    positions = "get_encoder_estimates"
    first_asked = "Get_Version"
    keeps_power = "is in closed loop control 1 s after {}; expected idle"

    def __init__(self, config: Drives = CONFIG, watchdog: float = 0.02) -> None:
        self._watchdog = watchdog
        super().__init__(config, Odrive)

    def device(self, drive: Drive, counts: float) -> SimulatedOdrive:
        servo = ideal_servo(drive, counts)
        friction = 2.0 * drive.counts_per_metre
        return SimulatedOdrive(drive.node, servo, heartbeat=0.1, friction=friction, watchdog=self._watchdog)

    def move(self, cycles: int = 100, speed: Triple = SPEED) -> Feedback:
        return super().move(cycles, speed)

    def keep_power(self, index: int) -> None:
        self.devices[index]._handlers[cansimple.SET_AXIS_STATE] = lambda data: None

    def get_power(self, index: int) -> None:
        self.devices[index].axis_state = AxisState.CLOSED_LOOP_CONTROL

    def keep_fault(self, index: int) -> Callable[[], None]:
        handlers = self.devices[index]._handlers
        clear = handlers[cansimple.CLEAR_ERRORS]
        handlers[cansimple.CLEAR_ERRORS] = lambda data: None
        return lambda: handlers.update({cansimple.CLEAR_ERRORS: clear})

    def commands(self) -> list[list[tuple[int, int]]]:
        """What each drive was told: number and first byte of each command, without setpoints and requests."""
        sent = [(divmod(can_id, 32), data) for can_id, data in self.bus.sent]
        return [
            [(number, data[0] if data else 0) for (node, number), data in sent if node == d.node and number in COMMANDS]
            for d in self.devices
        ]

    def setpoints(self) -> NDArray[np.float64]:
        """Every setpoint sent, in metres and m/s: (3, messages, 2)."""
        rows = []
        for drive in self.config.each:
            scale = drive.direction * drive.counts_per_metre
            said = [
                struct.unpack("<fhh", data)
                for can_id, data in self.bus.sent
                if can_id == cansimple.identifier(drive.node, cansimple.SET_INPUT_POS)
            ]
            rows.append([(turns / scale + drive.offset, velocity * 0.001 / scale) for turns, velocity, _ in said])
        return np.array(rows)


@pytest.fixture
def new() -> Iterator[Rig]:
    """Drives that were just switched on."""
    rig = Rig()
    yield rig
    rig.drives.close()


COMMANDS_OF_MASTERS = [
    cansimple.RX_SDO,
    cansimple.SET_AXIS_STATE,
    cansimple.SET_CONTROLLER_MODE,
    cansimple.SET_INPUT_POS,
    cansimple.CLEAR_ERRORS,
    cansimple.ESTOP,
    *(0x0D, 0x0E, 0x0F, 0x11, 0x12, 0x13, 0x16, 0x19, 0x1A, 0x1B, 0x1F),
]


@pytest.mark.parametrize(
    ("command", "remote"),
    [(command, False) for command in COMMANDS_OF_MASTERS] + [(cansimple.GET_ENCODER_ESTIMATES, True)],
)
def test_another_master_is_noticed_before_drives_are_set_up(new: Rig, command: int, remote: bool) -> None:
    for data in (bytes(8), bytes(4)):  # these frames are from before the check
        new.bus.inject(cansimple.identifier(new.config.C.node, cansimple.SET_INPUT_POS), data)
    message = frame(cansimple.identifier(new.config.C.node, command), is_remote_frame=remote)
    receive = new.bus.recv
    new.bus.recv = lambda timeout=None: message if timeout else receive(timeout)  # type: ignore[method-assign]
    with pytest.raises(DriveError, match=rf"another master is on the bus.*\(identifier {message.arbitration_id:03X}\)"):
        check_exclusive(new.bus, new.config, new.clock)
    assert not new.bus.sent


def test_drives_without_another_master_pass_the_check(new: Rig) -> None:
    new.cycles(20)
    check_exclusive(new.bus, new.config, new.clock)


@pytest.mark.parametrize("check", [check_exclusive, other_masters.check_exclusive])
def test_a_lost_bus_ends_the_check_with_a_bus_error(new: Rig, check: Callable[..., None]) -> None:
    def fail(timeout: float | None = None) -> None:
        raise can.CanOperationError("Network is down")

    new.bus.recv = fail  # type: ignore[method-assign]
    with pytest.raises(BusError, match="Network is down; check that the interface is up"):
        check(new.bus, new.config, new.clock)


IDLE = Rig.off
MODE = (cansimple.SET_CONTROLLER_MODE, cansimple.POSITION_CONTROL)
CLOSED_LOOP = (cansimple.SET_AXIS_STATE, AxisState.CLOSED_LOOP_CONTROL)


class TestConfigure:
    def test_takes_power_off_that_was_left_on(self, new: Rig) -> None:
        new.devices[1].axis_state = AxisState.CLOSED_LOOP_CONTROL
        new.drives.configure(PERIOD)
        assert new.devices[1].axis_state is AxisState.IDLE

    def test_drive_that_keeps_its_power(self, new: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        new.devices[1].axis_state = AxisState.CLOSED_LOOP_CONTROL
        monkeypatch.setattr(new.devices[1], "fail", lambda errors: None)
        new.keep_power(1)
        with pytest.raises(DriveError, match=r"drive B: did not power off: .*closed loop control"):
            new.drives.configure(PERIOD)

    def test_drive_without_heartbeat(self, new: Rig) -> None:
        new.devices[0]._due["heartbeat"] = math.inf
        with pytest.raises(DriveTimeout, match=r"drive A: no heartbeat .*within 0\.3"):
            new.drives.configure(PERIOD)

    def test_firmware_of_another_layout(self, new: Rig) -> None:
        new.devices[0].version = Version((3, 6, 56), (0, 5, 6))
        with pytest.raises(DriveError, match=r"drive A: firmware 0\.5\.6 on .* is too old; update to 0\.6\.0"):
            new.drives.configure(PERIOD)

    @pytest.mark.parametrize("awaits", [False, True])
    def test_firmware_that_reports_no_version_is_too_old(self, new: Rig, awaits: bool) -> None:
        """Firmware 0.5 sends heartbeats and answers position requests, but knows neither Get_Version nor Get_Error."""
        device, known = new.devices[1], {cansimple.HEARTBEAT, cansimple.GET_ENCODER_ESTIMATES}
        answer = device._answer
        device._answer = lambda command: answer(command) if command in known else None  # type: ignore[method-assign]
        said = r"^drive B: has no Get_Version; its firmware is too old; update to 0\.6\.0 or newer$"
        with pytest.raises(DriveError, match=said):
            new.drives.configure(PERIOD, awaits=awaits)

    @pytest.mark.parametrize("after", [0.002, 0.004, 0.006, 0.008, 0.01, 0.02, 0.03])
    def test_a_drive_that_is_switched_on_meanwhile_is_not_too_old(self, new: Rig, after: float) -> None:
        device = new.devices[1]
        device.silent, end, poll = True, new.clock.now + after, device.poll

        def switch_on(now: float) -> None:
            device.silent = now < end
            poll(now)

        device.poll = switch_on  # type: ignore[method-assign]
        new.drives.configure(PERIOD, awaits=True)

    @pytest.mark.parametrize("rate_hz", [10, 20, 100])
    @pytest.mark.parametrize("phase", range(4))
    def test_a_reset_has_time_for_three_questions_at_every_rate(
        self, closing: Closing, rate_hz: int, phase: int
    ) -> None:
        rig = closing(Rig(msgspec.structs.replace(CONFIG, heartbeat=1.0), watchdog=0.5))
        for device in rig.devices:
            device.settings[HEARTBEAT] = 1000.0
        rig.period = 1.0 / rate_hz
        rig.drives.configure(rig.period)
        rig.cycles(rate_hz + phase)
        rig.devices[1].fail(Error.DC_BUS_UNDER_VOLTAGE)
        rig.found("fault", within=2 * rate_hz)
        rig.cycles(phase)
        rig.drives.reset()
        assert [rig.cycle().fault for _ in range(2 * rate_hz)] == [None] * 2 * rate_hz

    @pytest.mark.parametrize("boots", [False, True])
    def test_a_drive_that_is_heard_again_after_a_silence_is_led_down_no_ramp(
        self, closing: Closing, boots: bool
    ) -> None:
        """It may have restarted, and armed itself, and count from another place. A drive that is not heard is led."""
        slow = msgspec.structs.replace(CONFIG, quick_stop_deceleration=0.7, stop_timeout=1.0)
        rig = closing(Rig(slow, watchdog=0.3))
        rig.ready()
        rig.enable()
        rig.move(200, (0.5, 0.4, -0.3))
        device = rig.devices[0]
        device.silent = True
        rig.move(4, (0.5, 0.4, -0.3))
        rig.cycles(200)
        if boots:
            device.silent, device.axis_state, device._zero = False, AxisState.CLOSED_LOOP_CONTROL, device.servo.position
        rig.bus.sent.clear()
        rig.cycle()  # in which it is heard
        told = rig.commands()[0]
        rig.bus.sent.clear()
        rig.cycles(300)
        setpoints = [can_id for can_id, _ in rig.bus.sent if can_id == cansimple.identifier(0, cansimple.SET_INPUT_POS)]
        assert bool(setpoints) is not boots
        assert told == []
        assert ((cansimple.SET_AXIS_STATE, AxisState.IDLE) in rig.commands()[0]) is boots

    def test_a_drive_that_is_not_heard_any_more_is_not_said_to_have_power_now(self, ready: Rig) -> None:
        ready.enable()
        ready.devices[0].silent = True
        ready.found("silent", within=10)
        ready.cycles(1500)
        fault = ready.cycle().fault
        assert fault is not None
        assert (
            fault.message == "drive A: was in closed loop control when last heard; expected idle 1 s after quick stop"
        )

    def test_a_drive_that_was_disarmed_while_it_booted_is_not_booting(self, new: Rig) -> None:
        """Its disarm reason is an error like any other: reported, and cleared by a reset."""
        new.devices[1].disarm_reason = Error.INITIALIZING
        new.ready()
        assert new.found("fault", within=1).message.startswith("drive B: error 0x00000001 INITIALIZING (it is starting")
        new.drives.reset()
        feedback = new.cycles(300)
        assert (feedback.fault, feedback.state) == (None, OFF)
        assert new.devices[1].disarm_reason == Error(0)

    def test_a_drive_that_is_still_booting_is_awaited(self, new: Rig) -> None:
        new.devices[1].errors = Error.INITIALIZING
        new.devices[1]._booted = new.clock.now + 0.05
        new.ready()
        assert new.cycles(300).fault is None

    def test_a_drive_that_does_not_finish_booting_is_named(self, new: Rig) -> None:
        new.devices[1].errors = Error.INITIALIZING
        with pytest.raises(DriveError, match=r"^drive B: still reports INITIALIZING after 0\.3 s; restart the drive$"):
            new.ready()

    def test_drive_that_does_not_know_where_it_is(self, new: Rig) -> None:
        new.devices[2].servo.position = math.nan
        with pytest.raises(DriveError, match=r"drive C: position estimate is nan"):
            new.drives.configure(PERIOD)

    @pytest.mark.parametrize("node", [7, 63, 100])
    def test_node_ids_that_cannot_be(self, node: int) -> None:
        drives = msgspec.structs.replace(CONFIG, C=Drive(node=node, counts_per_metre=25.0))
        said = (
            "drives.B.node = 7, drives.C.node = 7"
            if node == 7
            else f"drives.C.node = {node}: the node id of an ODrive is 0 to 62"
        )
        with pytest.raises(DriveError, match=said):
            Odrive(Bus([], Clock(), {}), BusTiming(1_000_000), drives)


class TestPower:
    def test_mode_then_state_after_a_setpoint_and_once(self, ready: Rig) -> None:
        ready.drives.enable()
        assert ready.bus.sent == []
        ready.cycles(2)
        numbers = [can_id % 32 for can_id, _ in ready.bus.sent]
        assert max(i for i, n in enumerate(numbers[:9]) if n == cansimple.SET_INPUT_POS) < numbers.index(
            cansimple.SET_CONTROLLER_MODE
        )
        ready.cycles(300)
        assert ready.commands() == [[MODE] * MODES_SENT + [CLOSED_LOOP]] * 3
        assert [device.modes for device in ready.devices] == [(cansimple.POSITION_CONTROL, cansimple.PASSTHROUGH)] * 3

    def test_no_power_without_a_setpoint(self, ready: Rig) -> None:
        ready.drives.enable()
        ready.drives.sync()
        assert ready.commands() == [[], [], []]

    @pytest.mark.parametrize("before", [ProcedureResult.SUCCESS, ProcedureResult.NOT_CALIBRATED])
    def test_refusal_is_named(self, ready: Rig, before: ProcedureResult) -> None:
        ready.devices[2].calibrated, ready.devices[2].result = False, before
        ready.drives.enable()
        fault = ready.found("state", within=250 * ENABLE_ATTEMPTS)
        assert fault.message == "drive C: refuses closed loop control: not calibrated"
        ready.cycles(150)
        assert {device.axis_state for device in ready.devices} == {AxisState.IDLE}

    @settings(max_examples=20)
    @example(lost=1, index=1, result=ProcedureResult.DISARMED, known=False)
    @given(
        lost=st.integers(1, 3),
        index=st.integers(0, 2),
        result=st.sampled_from([*ProcedureResult]),
        known=st.booleans(),
    )
    def test_a_request_that_is_lost_is_sent_again(
        self, lost: int, index: int, result: ProcedureResult, known: bool
    ) -> None:
        """Whatever the result of the drive's procedure before is, except that it is still busy."""
        assume(result is not ProcedureResult.BUSY)
        assume(lost < ENABLE_ATTEMPTS or result is ProcedureResult.SUCCESS)
        rig = Rig()
        rig.ready()
        rig.devices[index].result = result
        if known:
            rig.cycles(150)  # heartbeats with this result
        rig.bus.faults.add(f"{'ABC'[index]} drop set_axis_state for {lost} frames")
        rig.drives.enable()
        feedback = rig.cycles(250 * (lost + 1))
        assert (feedback.state, feedback.fault) == (ENABLED, None)
        told = [command for command in rig.commands()[index] if command == CLOSED_LOOP]
        assert len(told) == lost + 1
        rig.drives.close()

    def test_heartbeat_from_before_the_request_is_no_refusal(self, ready: Rig) -> None:
        ready.cycle()
        ready.drives.enable()
        ready.cycle()
        on_its_way = cansimple.BEAT.pack(0, AxisState.IDLE, ProcedureResult.NOT_CALIBRATED, 0)
        ready.bus.inject(cansimple.identifier(62, cansimple.HEARTBEAT), on_its_way)
        feedback = ready.cycles(250)
        assert (feedback.state, feedback.fault) == (ENABLED, None)

    def test_drive_that_misses_the_word_is_told_again(self, enabled: Rig) -> None:
        enabled.devices[0].silent = True
        enabled.drives.disable()
        enabled.devices[0].silent = False
        assert enabled.cycle().state[0] is P.QUICK_STOP_ACTIVE
        enabled.cycles(250)
        assert enabled.devices[0].axis_state is AxisState.IDLE
        assert enabled.commands() == [[IDLE, IDLE], [IDLE], [IDLE]]


class TestSetpoints:
    def test_are_sent_at_the_next_cycle_and_reached_at_the_one_after(self, enabled: Rig) -> None:
        enabled.cycle()
        there = (START[0] + 1e-4, START[1] - 1e-4, START[2])
        enabled.bus.sent.clear()
        enabled.cycle(there)
        before, now = enabled.cycle(there).position, enabled.cycle(there).position
        assert before == pytest.approx(START, abs=1e-7)
        assert now == pytest.approx(there, abs=1e-7)
        assert enabled.setpoints()[:, 1, 0] == pytest.approx(there, abs=1e-7)

    def test_are_followed_in_motion(self, enabled: Rig) -> None:
        feedback = enabled.move(200)
        assert feedback.fault is None
        assert feedback.position == pytest.approx(
            [p - 2 * v * PERIOD for p, v in zip(enabled.target, SPEED, strict=True)]
        )
        assert enabled.setpoints()[:, -1, 1] == pytest.approx(SPEED, abs=1e-4)

    @pytest.mark.parametrize(
        ("position", "velocity"),
        [(math.nan, 0.0), (math.inf, 0.0), (1e300, 0.0), (0.0, math.nan), (0.0, math.inf), (0.0, 1.4)],
    )
    def test_that_no_message_holds_are_a_fault(self, enabled: Rig, position: float, velocity: float) -> None:
        enabled.cycle()
        enabled.bus.sent.clear()
        enabled.cycle((START[0], position, START[2]), (0.0, velocity, 0.0))
        assert enabled.found("setpoint", within=1).drive == "B"
        assert enabled.setpoints()[:, :, 0] == pytest.approx(np.array(START)[:, None] + np.zeros(3), abs=1e-7)

    def test_late_ones_leave_the_last_in_force(self, enabled: Rig) -> None:
        enabled.drives.sync()
        enabled.bus.sent.clear()
        enabled.drives.sync()
        assert enabled.setpoints()[:, 0, 0] == pytest.approx(START, abs=1e-7)


class TestStop:
    def test_one_drives_error_stops_all_in_the_cycle_it_is_known(self, enabled: Rig) -> None:
        enabled.move(100)
        enabled.devices[1].fail(Error.DRV_FAULT)
        enabled.bus.sent.clear()
        feedback = enabled.move(40)
        assert feedback.fault == ("B", "fault", 0x20, f"drive B: error {describe_errors(Error.DRV_FAULT)}")
        _, slower = np.abs(enabled.setpoints()[:, -2:, 1]).T
        assert slower == pytest.approx(np.abs(SPEED) - 10.0 * PERIOD, abs=1e-4)
        assert enabled.cycles(200).state == (P.SWITCH_ON_DISABLED, P.FAULT, P.SWITCH_ON_DISABLED)
        assert enabled.commands() == [[IDLE]] * 3

    def test_follows_the_ramp_without_a_step_and_ends_without_power(self, enabled: Rig) -> None:
        enabled.move(100)
        enabled.bus.sent.clear()
        enabled.drives.quick_stop()
        for _ in range(30):
            assert enabled.cycle().state == (P.QUICK_STOP_ACTIVE,) * 3
        enabled.cycles(200)
        position, velocity = np.moveaxis(enabled.setpoints(), 2, 0)
        deceleration = CONFIG.quick_stop_deceleration
        assert np.abs(np.diff(velocity)).max() <= deceleration * PERIOD + 1e-4
        assert np.abs(np.diff(position)).max() <= max(SPEED) * PERIOD + 1e-7
        stopping = position[:, -1] - np.array(enabled.target)
        # The last setpoint written was not sent yet, and the first frame of the stop lowers the velocity in place.
        slower = np.abs(SPEED) - deceleration * PERIOD
        ramp = np.sign(SPEED) * slower**2 / (2.0 * deceleration)
        assert stopping == pytest.approx(ramp - np.array(SPEED) * PERIOD, abs=1e-6)
        assert enabled.commands() == [[IDLE]] * 3
        assert {device.axis_state for device in enabled.devices} == {AxisState.IDLE}

    def test_holds_until_the_servos_have_settled(self, enabled: Rig) -> None:
        enabled.drives.quick_stop()
        enabled.cycles(round(SETTLE_TIME_S / PERIOD) - 1)
        assert enabled.commands() == [[], [], []]
        enabled.cycles(3)
        assert enabled.commands() == [[IDLE]] * 3

    def test_a_drive_that_misses_being_told_off_stays_where_the_ramp_has_ended(self, enabled: Rig) -> None:
        enabled.move(100)
        enabled.bus.faults.add("A drop set_axis_state")
        enabled.drives.quick_stop()
        enabled.cycles(200)
        end = enabled.setpoints()[0, -1, 0]
        enabled.cycles(100, (9.0, 9.0, 9.0))
        assert enabled.devices[0].axis_state is AxisState.CLOSED_LOOP_CONTROL
        assert enabled.devices[0].servo.position / 25.0 == pytest.approx(end, abs=1e-6)
        assert enabled.setpoints()[0, -1].tolist() == [end, 0.0]

    def test_between_enabling_and_the_first_setpoint_sends_none(self, ready: Rig) -> None:
        ready.enable()
        ready.drives.disable()
        ready.cycles(200)
        ready.bus.sent.clear()
        ready.drives.enable()
        ready.drives.quick_stop()
        assert ready.commands() == [[IDLE]] * 3
        assert ready.setpoints().size == 0

    def test_twice_is_once(self, enabled: Rig) -> None:
        enabled.move(100)
        enabled.drives.quick_stop()
        sent = len(enabled.bus.sent)
        enabled.drives.quick_stop()
        assert len(enabled.bus.sent) == sent


class TestFaults:
    def test_somebody_else_calibrates(self, ready: Rig) -> None:
        ready.bus.inject(
            cansimple.identifier(7, cansimple.HEARTBEAT), cansimple.BEAT.pack(0, 4, ProcedureResult.BUSY, 0)
        )
        assert "motor calibration" in ready.found("state", within=1).message
        assert ready.drives.read().state[1] is P.QUICK_STOP_ACTIVE

    @pytest.mark.parametrize("command", COMMANDS_OF_MASTERS)
    def test_somebody_else_commands_a_drive(self, enabled: Rig, command: int) -> None:
        enabled.move(20)
        enabled.bus.inject(cansimple.identifier(enabled.config.B.node, command), bytes(8))
        message = enabled.found("bus", within=1).message
        assert message.startswith("CAN bus: another master is on the bus and ")
        assert message.endswith(" (drive B); only one master is allowed")

    @pytest.mark.parametrize("index", range(3))
    def test_following_error(self, enabled: Rig, index: int) -> None:
        stuck = enabled.devices[index].servo
        stuck.chase = lambda *_: None  # type: ignore[method-assign]
        feedback = enabled.move(50)
        assert feedback.fault is not None
        assert feedback.fault[:2] == ("ABC"[index], "fault")
        off = enabled.target[index] - START[index]
        assert off * SPEED[index] > 0.0
        assert f"following error {'-' if off < 0.0 else ''}5" in feedback.fault.message
        assert abs(off) == pytest.approx(0.005, abs=3.0 * abs(SPEED[index]) * PERIOD)

    def test_restart_is_the_first_reason_whichever_message_tells_of_it(self, ready: Rig) -> None:
        ready.cycle()
        ready.devices[1].restart(ready.clock.now)
        ready.bus.faults.add("B drop heartbeat")
        assert "drive B: has restarted" in ready.found("state", within=40).message

    def test_bus_that_breaks_in_powering_up_arms_no_drive_after_it(
        self, ready: Rig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        ready.cycle()
        ready.drives.enable()
        send = ready.bus.send

        def fail_once(message: can.Message, timeout: float | None = None) -> None:
            if message.arbitration_id % 32 == cansimple.SET_AXIS_STATE:
                monkeypatch.undo()
                raise can.CanOperationError("network is down", errno.ENETDOWN)
            send(message, timeout)

        monkeypatch.setattr(ready.bus, "send", fail_once)
        ready.found("bus", within=MODES_SENT + 1)
        ready.cycles(100)
        assert CLOSED_LOOP not in [command for each in ready.commands() for command in each]

    def test_bus_that_breaks_at_a_setpoint_leads_all_down_the_ramp(
        self, enabled: Rig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        enabled.move(100)
        enabled.bus.sent.clear()

        def fail_once(message: can.Message, timeout: float | None = None) -> None:
            monkeypatch.undo()
            raise can.CanOperationError("network is down", errno.ENETDOWN)

        monkeypatch.setattr(enabled.bus, "send", fail_once)
        assert enabled.move(1).fault is not None
        slower = np.sign(SPEED) * (np.abs(SPEED) - 10.0 * PERIOD)
        for velocity in enabled.setpoints()[:, :, 1].T:
            assert velocity == pytest.approx(slower, abs=1e-4)

    @pytest.mark.parametrize("index", range(3))
    def test_a_slider_that_is_moved_by_hand_without_power_has_no_following_error(
        self, enabled: Rig, index: int
    ) -> None:
        enabled.drives.disable()
        assert enabled.cycles(300).state == OFF
        drive, device = CONFIG.each[index], enabled.devices[index]
        device.servo.push(4.0 * CONFIG.following_error * drive.counts_per_metre)
        feedback = enabled.cycles(20)
        assert feedback.fault is None
        assert abs(feedback.position[index] - START[index]) > 3.0 * CONFIG.following_error

    def test_a_quick_stop_before_the_first_setpoint_takes_the_power_back(self, ready: Rig) -> None:
        ready.drives.enable()
        ready.drives.quick_stop()
        feedback = ready.cycles(1500)
        assert (feedback.fault, feedback.state) == (None, OFF)


class TestLateAnswers:
    def test_following_error_is_that_of_the_cycle_the_position_is_from(self, closing: Closing) -> None:
        """At 0.5 m/s a cycle is 0.5 mm."""
        rig = closing(Rig(msgspec.structs.replace(CONFIG, following_error=3e-4)))
        rig.ready()
        rig.enable()
        rig.bus.faults.add("A delay 0.0005 get_encoder_estimates")
        assert rig.move().fault is None


class TestFaultsOnDemand:
    def test_an_emcy_is_refused(self, ready: Rig) -> None:
        with pytest.raises(FaultSyntaxError, match="drive A has no EMCY; as in: A fault 200"):
            ready.bus.faults.add("A emcy 4310")

    @pytest.mark.parametrize("name", ["set_input_pos", "set_axis_state", "set_controller_mode", "clear_errors"])
    def test_frames_of_wrong_length_do_nothing_to_a_drive(self, enabled: Rig, name: str) -> None:
        device = enabled.devices[0]
        device.disarm_reason = Error.SPINOUT_DETECTED
        before = device.axis_state, device.modes, device._input, device.disarm_reason
        enabled.bus.send(cansimple.command(0, getattr(cansimple, name.upper()), bytes(3)).message())
        assert (device.axis_state, device.modes, device._input, device.disarm_reason) == before

    def test_a_setpoint_that_is_no_number_disarms_a_drive(self, enabled: Rig) -> None:
        data = cansimple.INPUT_POS.pack(math.nan, 0, 0)
        enabled.bus.send(cansimple.command(0, cansimple.SET_INPUT_POS, data).message())
        assert enabled.devices[0].disarm_reason is Error.MISSING_INPUT

    def test_a_slider_that_runs_away_rolls_out_without_power(self, enabled: Rig) -> None:
        enabled.bus.faults.add("A runaway 2.5")
        enabled.cycles(10)
        assert enabled.devices[0].servo.velocity == 2.5
        enabled.drives.disable()
        enabled.cycles(60)
        assert enabled.devices[0].servo.velocity == 0.0


class TestReset:
    def test_clears_the_drives_errors_and_gives_no_power(self, enabled: Rig) -> None:
        enabled.devices[2].fail(Error.CURRENT_LIMIT_VIOLATION)
        enabled.found("fault", within=40)
        enabled.cycles(200)
        enabled.bus.sent.clear()
        enabled.drives.reset()
        feedback = enabled.cycles(300)
        assert (feedback.state, feedback.fault) == (OFF, None)
        cleared = (cansimple.CLEAR_ERRORS, 0)
        assert [set(commands) for commands in enabled.commands()] == [{cleared}] * 3
        enabled.enable()

    @pytest.mark.parametrize("index", [1, 2])
    def test_clears_errors_that_are_not_known_yet(self, enabled: Rig, index: int) -> None:
        """Drives that lose their supply together report it one after the other."""
        enabled.cycles(50)
        for device in (enabled.devices[0], enabled.devices[index]):
            device.disarm_reason = Error.DC_BUS_UNDER_VOLTAGE
            device.axis_state = AxisState.IDLE
        assert enabled.found("fault", within=40).drive in {"A", "ABC"[index]}
        enabled.drives.quick_stop()
        enabled.cycle()
        enabled.drives.reset()
        assert enabled.cycles(400).fault is None

    def test_while_the_cause_lasts_the_fault_comes_back(self, ready: Rig) -> None:
        ready.cycle()
        ready.devices[1]._handlers[cansimple.CLEAR_ERRORS] = lambda data: None
        ready.devices[1].fail(Error.MOTOR_OVER_TEMP)
        ready.found("fault", within=40)
        ready.drives.reset()
        assert ready.cycle().fault is None
        ready.found("fault", within=100)

    def test_what_a_drive_said_before_its_errors_were_cleared_is_no_new_fault(self, ready: Rig) -> None:
        ready.cycle()
        ready.devices[1].fail(Error.MOTOR_OVER_TEMP)
        ready.found("fault", within=40)
        ready.drives.reset()
        said = cansimple.BEAT.pack(Error.MOTOR_OVER_TEMP, AxisState.IDLE, ProcedureResult.SUCCESS, 0)
        ready.bus.inject(cansimple.identifier(CONFIG.B.node, cansimple.HEARTBEAT), said)
        assert ready.cycles(300).fault is None

    def test_an_error_after_they_were_cleared_is_a_fault_as_soon_as_it_is_told(self, ready: Rig) -> None:
        ready.cycle()
        ready.devices[1].fail(Error.MOTOR_OVER_TEMP)
        ready.found("fault", within=40)
        ready.drives.reset()
        assert ready.cycles(35).fault is None  # so long it takes to ask each drive once
        ready.devices[1].fail(Error.CURRENT_LIMIT_VIOLATION)
        ready.found("fault", within=35)


@pytest.mark.parametrize("errors", [0, int(Error.CURRENT_LIMIT_VIOLATION)])
def test_a_drive_whose_state_is_unknown_has_restarted_only_if_it_says_so(ready: Rig, errors: int) -> None:
    """A new set-up forgets the state. Answers to requests for errors may come before the next heartbeat."""
    axis = ready.drives._axes[0]
    axis.silent = True
    axis.forget_power_state()
    axis.on_errors(cansimple.ERRORS.pack(errors, 0), ready.clock.now)
    assert not axis.restarted
    assert axis.event is None
    axis.on_errors(cansimple.ERRORS.pack(errors, int(Error.INITIALIZING)), ready.clock.now)
    axis.on_heartbeat(cansimple.BEAT.pack(int(Error.INITIALIZING), AxisState.IDLE, 0, 0), ready.clock.now)
    assert not axis.restarted, "that is why it was disarmed"
    if errors:
        axis.on_errors(cansimple.ERRORS.pack(int(Error.INITIALIZING), 0), ready.clock.now)
    else:
        axis.on_heartbeat(cansimple.BEAT.pack(0, AxisState.UNDEFINED, 0, 0), ready.clock.now)
    assert axis.restarted
    assert axis.boots == 1


class TestClose:
    def test_while_moving_brakes_by_the_ramp_first(self, enabled: Rig) -> None:
        enabled.move(100)
        enabled.bus.sent.clear()
        before = enabled.clock.now
        enabled.drives.close()
        assert {device.axis_state for device in enabled.devices} == {AxisState.IDLE}
        assert {device.disarm_reason for device in enabled.devices} == {Error(0)}
        assert 0.5 / 10.0 + SETTLE_TIME_S <= enabled.clock.now - before < 0.5
        assert np.abs(np.diff(enabled.setpoints()[:, :, 1])).max() <= 10.0 * PERIOD + 1e-4
        assert enabled.bus.shutdowns == 1


def odrives(config: Config = ROBOT) -> Config:
    """The simulated robot with ODrives: nothing but the protocol, the node ids and the drives' unit differs."""
    each = {
        name: msgspec.structs.replace(getattr(config.drives, name), node=node, counts_per_metre=25.0)
        for node, name in enumerate("ABC")
    }
    drives = msgspec.structs.replace(config.drives, protocol="odrive", **each)
    return msgspec.structs.replace(config, drives=drives)
