"""The fault matrix for ODrives: what stops the robot, down the ramp that the service leads, and what does not."""

from __future__ import annotations

import errno
import itertools
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import can
import numpy as np
import pytest
from drivers.test_faults import (
    IN_MOTION,
    NOT_HOMING,
    REAL,
    Case,
    FaultRig,
    assert_goes_on,
    assert_stops_until_reset,
    begin,
    tried,
)
from drivers.test_odrive import odrives
from rigs import frame
from trirail.config import Config
from trirail.wire.packets import CommandDone, Refused, Request
from trirail.wire.vocabulary import Mode
from trirail_drivers.bus.wire import UNSENT_CYCLES
from trirail_drivers.driver.ramp import brake
from trirail_drivers.interface import PowerState
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.cansimple import AxisState
from trirail_drivers.odrive.setpoints import SETTLE_TIME_S
from trirail_drivers.simulated import SimulatedOdrive

pytestmark = pytest.mark.usefixtures("absolute_odrives")

ODRIVES = odrives(REAL)
PERIOD = ODRIVES.period
TURNS = ODRIVES.drives.A.counts_per_metre
DECELERATION = ODRIVES.drives.quick_stop_deceleration
ROUNDING = cansimple.VELOCITY_STEP / TURNS
"""The velocity feed-forward comes in steps of this [m/s]."""
ROLLING = 400
"""Cycles in which a slider stands that its drive has let go of: 0.4 m/s at 2 m/s² take 200, and a heartbeat or so."""
DEAF = 750
"""Cycles in which a drive stands that hears nothing: its watchdog disarms it after 0.3 s."""
BEAT = round(ODRIVES.drives.heartbeat / PERIOD) + 2
ASKED = round(3 * cansimple.ERROR_PERIOD / PERIOD) + 2
"""Cycles in which a drive is asked for its errors once."""


class Setpoint(NamedTuple):
    """A Set_Input_Pos on the bus."""

    cycle: int
    position: float
    velocity: float
    armed: bool
    taken: bool = True
    """By the bus."""


class OdriveRig(FaultRig):
    """Keeps what each drive was told: setpoints [m], [m/s] and axis states, each with its cycle."""

    def __init__(self, config: Config = ODRIVES) -> None:
        self.setpoints_of: dict[int, list[Setpoint]] = {drive.node: [] for drive in config.drives.each}
        self.states_of: dict[int, list[tuple[int, int]]] = {drive.node: [] for drive in config.drives.each}
        self.rows = []  # cycles are counted by them, and the set-up sends frames before the first
        self.refuse: Callable[[], can.CanError | None] = lambda: None
        """Why the bus takes no frame."""
        self.spoilt: dict[int, Callable[[bytes], bytes]] = {}
        """What becomes of the data of an identifier on its way from a drive."""
        self.undo: list[Callable[[], None]] = []
        self.trips: list[int] = []
        """Cycles in which the mode became fault."""
        self.resets: list[int] = []
        """Cycles in which it ceased to be."""
        super().__init__(config)
        receive = self.bus.recv

        def recv(timeout: float | None = None) -> can.Message | None:
            message = receive(timeout)
            if message is not None and message.arbitration_id in self.spoilt:
                message.data = bytearray(self.spoilt[message.arbitration_id](bytes(message.data)))
            return message

        self.bus.recv = recv  # type: ignore[method-assign]

    @property
    def odrives(self) -> list[SimulatedOdrive]:
        return [drive for drive in self.bus.drives if isinstance(drive, SimulatedOdrive)]

    def _note(self, message: can.Message, timeout: float | None = None) -> None:
        node, number = divmod(message.arbitration_id, 1 << 5)
        if number == cansimple.SET_INPUT_POS:
            turns, velocity, _ = cansimple.INPUT_POS.unpack(message.data)
            metres = turns / TURNS, velocity * cansimple.VELOCITY_STEP / TURNS
            armed = self.bus.drives[node].power is PowerState.OPERATION_ENABLED
            self.setpoints_of[node].append(Setpoint(len(self.rows), *metres, armed, taken=False))
        elif number == cansimple.SET_AXIS_STATE:
            self.states_of[node].append((len(self.rows), cansimple.AXIS_STATE.unpack(message.data)[0]))
        error = self.refuse()
        if error is not None:
            raise error
        super()._note(message, timeout)
        if number == cansimple.SET_INPUT_POS:
            self.setpoints_of[node][-1] = self.setpoints_of[node][-1]._replace(taken=True)

    def cycle(self, request: Request | None = None) -> None:
        before = self.mode
        super().cycle(request)
        if self.mode is Mode.FAULT and before is not Mode.FAULT:
            self.trips.append(len(self.rows) - 1)
        if self.mode is not Mode.FAULT and before is Mode.FAULT:
            self.resets.append(len(self.rows) - 1)

    def told_to_stop(self) -> set[int]:
        """By less velocity, from the one of this cycle or, where the fault was found first, of the one before.

        The place is the one of that cycle, or where the bus took no setpoint lately, that of the last one it took.
        """
        told = set()
        for index, setpoints in enumerate(self.setpoints_of.values()):
            of_cycle = [setpoint for setpoint in setpoints if setpoint.cycle == len(self.rows) - 1]
            places = [rows[0][index] for rows in self.rows[-5:-1]]
            fast = [Setpoint(0, rows[0][index], rows[1][index], armed=True) for rows in self.rows[-3:-1]]
            for slow in of_cycle:
                there = any(abs(slow.position - place) < 1e-7 for place in places)
                if there and any(is_slower(each, slow) for each in fast):
                    told.add(self.config.drives.each[index].node)
        return told

    def stands(self) -> bool:
        return super().stands() and all(drive.axis_state is not AxisState.UNDEFINED for drive in self.odrives)

    def mend(self) -> None:
        super().mend()
        self.refuse = lambda: None
        self.spoilt.clear()
        for undo in self.undo:
            undo()

    def inject(self, line: str) -> None:
        """Fault lines, with ; between them, or one of BY_HAND."""
        if line in BY_HAND:
            BY_HAND[line](self)
        else:
            for each in line.split("; "):
                super().inject(each)

    def assert_no_jump(self) -> None:
        """No step is above the velocity limit, and an armed drive is to go as far as it is told to run."""
        limits = self.config.limits.slider
        for setpoints in self.setpoints_of.values():
            assert setpoints
            taken = {setpoint.cycle: setpoint for setpoint in setpoints if setpoint.taken}
            for before, after in itertools.pairwise(taken.values()):
                cycles = after.cycle - before.cycle
                if cycles > 1:  # there was to be no power in between, or the queue was full
                    most = min(cycles, UNSENT_CYCLES) * limits.velocities[0] * PERIOD
                    assert not after.armed or abs(after.position - before.position) <= most
                    continue
                step = (after.position - before.position) / PERIOD
                assert abs(step) <= limits.velocities[0] * 1.001 + ROUNDING
                if before.armed and after.armed:
                    change, mean = after.velocity - before.velocity, 0.5 * (after.velocity + before.velocity)
                    assert abs(change) <= 2.0 * DECELERATION * PERIOD + ROUNDING
                    assert abs(step - mean) <= DECELERATION * PERIOD + ROUNDING

    def assert_ramps(self) -> None:
        """Drives that had power are led down the ramp, held, told to be idle, and told nothing else until reset."""
        held = round(SETTLE_TIME_S / PERIOD)
        assert self.trips
        for trip, reset in itertools.zip_longest(self.trips, self.resets, fillvalue=len(self.rows)):
            idle, still = set(), trip
            for node, setpoints in self.setpoints_of.items():
                before = [state for at, state in self.states_of[node] if at < trip]
                told = [(at, state) for at, state in self.states_of[node] if trip <= at < reset]
                assert {state for _, state in told} <= {AxisState.IDLE}
                ramp = [setpoint for setpoint in setpoints if trip <= setpoint.cycle < reset]
                if before[-1] == AxisState.IDLE:
                    assert not ramp
                    continue
                idle.add(told[0][0])
                assert ramp[-1].cycle <= told[0][0]
                assert all(is_slower(fast, slow) for fast, slow in itertools.pairwise(ramp[1:]))
                stands = next(setpoint for setpoint in ramp if setpoint.velocity == 0.0)
                assert stands.cycle - trip <= math.ceil(abs(ramp[0].velocity) / DECELERATION / PERIOD) + 1
                assert {setpoint.position for setpoint in ramp if setpoint.cycle > stands.cycle} == {ramp[-1].position}
                still = max(still, stands.cycle)
            # One cycle sooner where the fault is found before that cycle's setpoints are sent.
            assert all(held - 1 <= at - still <= held + 1 for at in idle)


def is_slower(before: Setpoint, after: Setpoint) -> bool:
    """Whether one setpoint follows the other down the ramp."""
    _, slower = brake(0.0, before.velocity, DECELERATION, PERIOD)
    return abs(after.velocity - slower) <= 1.01 * ROUNDING


def let_go(rig: OdriveRig) -> None:
    """Drive B disarms, and does not say why."""
    rig.odrives[1].fail(0)


def push(rig: OdriveRig) -> None:
    """Slider A is pushed by 8 mm."""
    rig.odrives[0].servo.position += 0.008 * TURNS


def no_acknowledgement(rig: OdriveRig) -> None:
    """The transmit queue is full, and stays so."""
    rig.refuse = lambda: can.CanOperationError("No buffer space available", errno.ENOBUFS)


def full_queue(rig: OdriveRig, cycles: int = 2) -> None:
    """The transmit queue is full for some cycles."""
    no_acknowledgement(rig)
    end, refuse = len(rig.rows) + cycles, rig.refuse
    rig.refuse = lambda: refuse() if len(rig.rows) < end else None


def no_number(rig: OdriveRig) -> None:
    """Drive C does not know its position any more."""
    rig.spoilt[cansimple.identifier(2, cansimple.GET_ENCODER_ESTIMATES)] = lambda _data: cansimple.ESTIMATES.pack(
        math.nan, 0.0
    )


def elsewhere(rig: OdriveRig) -> None:
    """Drive C says that it is 50 mm farther than it is."""

    def farther(data: bytes) -> bytes:
        turns, velocity = cansimple.ESTIMATES.unpack(data)
        return cansimple.ESTIMATES.pack(turns + 0.05 * TURNS, velocity)

    rig.spoilt[cansimple.identifier(2, cansimple.GET_ENCODER_ESTIMATES)] = farther


def second_node(rig: OdriveRig, apart: float) -> None:
    """Another drive has the node id of drive A, and a slider that is `apart` metres beside A's."""
    identifier = cansimple.identifier(0, cansimple.GET_ENCODER_ESTIMATES)
    receive = rig.bus.recv
    waiting: list[can.Message] = []

    def recv(timeout: float | None = None) -> can.Message | None:
        if waiting:
            return waiting.pop()
        message = receive(timeout)
        if message is not None and message.arbitration_id == identifier:
            turns, velocity = cansimple.ESTIMATES.unpack(message.data)
            waiting.append(frame(identifier, cansimple.ESTIMATES.pack(turns + apart * TURNS, velocity)))
        return message

    rig.bus.recv = recv  # type: ignore[method-assign]
    rig.undo.append(lambda: setattr(rig.bus, "recv", receive))


def short_watchdog(rig: OdriveRig) -> None:
    """The watchdog of drive B is shorter than a cycle."""
    drive = rig.odrives[1]
    timeout = "axis0.config.watchdog_timeout"
    before, drive.settings[timeout] = drive.settings[timeout], 0.5 * PERIOD
    rig.undo.append(lambda: drive.settings.update({timeout: before}))


BY_HAND: dict[str, Callable[[OdriveRig], None]] = {
    "B lets go": let_go,
    "A pushed": push,
    "nobody acknowledges": no_acknowledgement,
    "full queue": full_queue,
    "queue full for 0.02": partial(full_queue, cycles=20),
    "C no number": no_number,
    "C elsewhere": elsewhere,
    "B short watchdog": short_watchdog,
    "second A 50 mm beside": partial(second_node, apart=0.05),
}
"""What fault lines have no words for."""

SILENT = r"drive {}: no position for 3 cycles in a row"
FOLLOWING = r"(slider|drive) {}: following error"
SECOND = r"drive A: a second node with id 0 on the bus: each request has two positions"
STOP = [
    # frames that do not come, come late or come wrong
    Case("A drop get_encoder_estimates", 3, SILENT.format("A")),
    Case("B drop position-request", 3, SILENT.format("B")),
    Case("C drop heartbeat", 3 * BEAT + 100, r"drive C: no heartbeat for 0\.3\d* s"),
    Case("A drop to", 3, SILENT.format("A"), stands=DEAF),
    Case("B drop set_input_pos", 150, FOLLOWING.format("B"), IN_MOTION, lasts=False),
    Case("A delay 0.01 get_encoder_estimates", 3, SILENT.format("A"), lasts=False),
    Case("A delay 0.05 set_input_pos", 60, FOLLOWING.format("A"), IN_MOTION, lasts=False),
    Case("C corrupt get_encoder_estimates", 400, rf"{FOLLOWING.format('C')}|drive C: position estimate", lasts=False),
    Case("C no number", 1, r"drive C: position estimate is nan"),
    Case("C elsewhere", 1, FOLLOWING.format("C"), lasts=False),
    Case("A dlc 3 get_encoder_estimates", 1, r"drive A: frame 009 has wrong length 3"),
    Case("B dlc 7 heartbeat", BEAT, r"drive B: frame 021 has wrong length 7"),
    Case("C dlc 0 get_error", ASKED, r"drive C: frame 043 has wrong length 0"),
    Case("B dlc 7 set_input_pos", 150, FOLLOWING.format("B"), IN_MOTION, lasts=False),
    # drives
    Case("C silent", 3, SILENT.format("C"), stands=DEAF),
    Case("all silent", 3, SILENT.format("A"), stands=DEAF),
    Case("B fault 200 for 5", ASKED, r"drive B: error 0x00000200 DC_BUS_UNDER_VOLTAGE", stands=ROLLING),
    Case("B drop get_error; B fault 200 for 5", BEAT, r"drive B: error 0x00000200 DC_BUS_UNDER", stands=ROLLING),
    Case(
        "B lets go",
        BEAT,
        r"drive B: has left closed loop control by itself and is in idle",
        stands=ROLLING,
        lasts=False,
    ),
    Case("B short watchdog", ASKED, r"drive B: error 0x01000000 WATCHDOG_TIMER", stands=ROLLING, lasts=False),
    Case("A stuck", 60, FOLLOWING.format("A"), IN_MOTION, lasts=False),
    Case("A lag 0.1", 100, FOLLOWING.format("A"), IN_MOTION, stands=ROLLING, lasts=False),
    Case("A pushed", 1, FOLLOWING.format("A"), stands=ROLLING, lasts=False),
    Case("C runaway 0.1", 100, FOLLOWING.format("C"), stands=ROLLING, lasts=False),
    Case("C runaway -0.1", 100, FOLLOWING.format("C"), stands=ROLLING, lasts=False),
    Case(
        "B reboot",
        ASKED,
        r"drive B: has restarted: wait until its settings have been checked",
        stands=ROLLING,
        lasts=False,
    ),
    Case("B reboot for 0.1", 3, SILENT.format("B"), stands=ROLLING, lasts=False),
    Case("second A 50 mm beside", 3, rf"{SECOND}|{FOLLOWING.format('A')}"),
    # the bus
    Case("bus-off", 1, r"CAN bus .* is down: bus-off", stands=DEAF),
    Case("nobody acknowledges", 3, r"CAN bus: cannot send: .*the transmit queue is full", stands=DEAF),
    Case("babble 000", 3, SILENT.format("A"), stands=DEAF),
    Case("babble 009", 3, rf"{SILENT.format('B')}|{FOLLOWING.format('A')}", stands=DEAF),
    Case("babble 029", 3, rf"{SILENT.format('C')}|{FOLLOWING.format('B')}", stands=DEAF),
    Case("babble 001", 2, r"drive A: has restarted", stands=DEAF),
]


@pytest.fixture
def rig() -> Iterator[OdriveRig]:
    made = OdriveRig()
    yield made
    made.bus.shutdown()


@pytest.mark.parametrize(
    ("mode", "case"),
    [tried(mode, case) for case in STOP for mode in case.modes if mode in NOT_HOMING],
    ids=lambda value: value.line if isinstance(value, Case) else value,
)
def test_a_fault_stops_all_three_drives(rig: OdriveRig, case: Case, mode: str) -> None:
    begun = begin(rig, mode, case.line)
    assert_stops_until_reset(rig, case, begun)
    rig.assert_ramps()


GO_ON = [
    *(
        f"{fault} {kind} for 1 frames"
        for fault in ("A duplicate", "B drop")
        for kind in ("set_input_pos", "position-request", "get_encoder_estimates", "get_error", "heartbeat")
    ),
    "B drop get_encoder_estimates for 2 frames",
    "B drop position-request for 2 frames",
    "all drop get_encoder_estimates for 3 frames",
    "C drop heartbeat for 2 frames",
    "A duplicate",
    "A delay 0.0005 get_encoder_estimates",
    "A delay 0.0015 get_encoder_estimates",
    "all delay 0.0005 position-request",
    "B delay 0.0005 set_input_pos",
    "A delay 0.05 heartbeat",
    "with 0.1 all delay 0.0005 get_encoder_estimates",
    "with 0.02 all drop set_input_pos",
    "full queue",
    "error-passive",
    "babble 7FF",
]


@pytest.mark.parametrize("mode", [*map(tried, NOT_HOMING)])
@pytest.mark.parametrize("line", GO_ON)
def test_what_does_not_stop_the_robot(rig: OdriveRig, line: str, mode: str) -> None:
    begun = begin(rig, mode, line)
    assert_goes_on(rig, begun, 4 * BEAT)
    assert {drive.axis_state for drive in rig.odrives} == {AxisState.CLOSED_LOOP_CONTROL}
    assert {state for states in rig.states_of.values() for _, state in states[1:]} == {AxisState.CLOSED_LOOP_CONTROL}


@pytest.mark.parametrize("mode", [*map(tried, NOT_HOMING)])
@pytest.mark.parametrize("line", ["A drop set_axis_state", "all drop set_axis_state"])
def test_a_drive_that_keeps_its_power_stays_at_the_end_of_the_ramp_and_is_named(
    rig: OdriveRig, line: str, mode: str
) -> None:
    begin(rig, mode, line)
    rig.order("quick_stop")
    rig.cycles(200)
    ends = [setpoints[-1] for setpoints in rig.setpoints_of.values()]
    for drive in rig.odrives:
        drive.servo.position += 0.01 * TURNS  # pushed: where they are told to be must not follow
    rig.cycles(1000)
    assert [setpoints[-1] for setpoints in rig.setpoints_of.values()] == ends
    assert rig.odrives[0].servo.position / TURNS == pytest.approx(ends[0].position, abs=1e-6)
    assert rig.control.fault == "quick_stop by ann"
    assert "drive A: is in closed loop control 1 s after quick stop; expected idle" in [
        said.message for said in rig.notices if said.kind == "fault"
    ]
    assert isinstance(rig.command("reset"), Refused)
    rig.mend()
    rig.until(rig.stands, 2 * BEAT)
    rig.cycles(BEAT)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.enable()
    rig.assert_no_jump()


@pytest.mark.parametrize("mode", ["holding"])
@pytest.mark.parametrize(("state", "lost"), [*((state, 0) for state in (*cansimple.PROCEDURES, 5)), (9, 1), (11, 3)])
def test_a_procedure_that_a_drive_begins_by_itself_stops_the_robot_and_is_ended(
    rig: OdriveRig, state: int, lost: int, mode: str
) -> None:
    """Without power before, the idle state that is wanted has been requested long ago."""
    rig.cycles(50)
    rig.inject(f"B drop set_axis_state for {lost} frames" if lost else "error-passive")
    rig.odrives[1].axis_state = state  # type: ignore[assignment]
    rig.until(rig.faulty, BEAT)
    assert rig.control.fault == f"drive B: runs {cansimple.state_name(state)}, which the service did not request"
    assert rig.control.measured.powered
    rig.until(lambda: rig.odrives[1].axis_state == AxisState.IDLE, (2 + 2 * lost) * BEAT)
    rig.cycles(2 * BEAT)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.enable()


@pytest.mark.parametrize("mode", ["holding"])
def test_a_drive_that_has_restarted_finishes_its_start_before_it_is_configured(rig: OdriveRig, mode: str) -> None:
    rig.enable()
    rig.inject("B reboot")
    rig.until(rig.faulty, ASKED)
    rig.until(lambda: rig.odrives[1].axis_state == AxisState.IDLE, 5000)
    begun = len(rig.rows)
    rig.odrives[1].axis_state = 6  # type: ignore[assignment]
    rig.cycles(500)
    assert [state for at, state in rig.states_of[1] if at > begun + BEAT] == []
    assert rig.odrives[1].axis_state == 6
    rig.odrives[1].axis_state = AxisState.IDLE
    rig.until(lambda: not rig.control.measured.unready, 5000)
    assert isinstance(rig.command("reset"), CommandDone)
    rig.enable()


@pytest.mark.parametrize("stop", ["disable", "quick_stop"])
def test_a_drive_that_gets_power_by_itself_is_not_sent_to_where_it_was_told_to_be_before(
    rig: OdriveRig, stop: str
) -> None:
    rig.enable()
    rig.order(stop)
    rig.cycles(500)
    drive, told = rig.odrives[1], [len(setpoints) for setpoints in rig.setpoints_of.values()]
    drive.servo.position += 0.05 * TURNS  # pushed by hand
    rig.cycles(100)
    rig.inject("B drop set_axis_state")
    drive.axis_state, drive._input = AxisState.CLOSED_LOOP_CONTROL, (drive.servo.position, 0.0)
    place = drive.servo.position
    rig.cycles(2500)
    assert any("drive B: is in closed loop control" in notice.message for notice in rig.notices)
    assert [len(setpoints) for setpoints in rig.setpoints_of.values()] == told
    assert drive.servo.position == pytest.approx(place)


def test_a_drive_that_restarts_in_motion_is_led_down_no_ramp(rig: OdriveRig) -> None:
    begin(rig, "moving", "B reboot")
    rig.until(rig.faulty, ASKED)
    restarted = len(rig.rows)
    rig.odrives[1].axis_state, rig.odrives[1]._booted = AxisState.CLOSED_LOOP_CONTROL, rig.now
    rig.cycles(2 * BEAT)
    assert [setpoint.cycle for setpoint in rig.setpoints_of[1] if setpoint.cycle >= restarted] == []
    assert {state for at, state in rig.states_of[1] if at >= restarted - 1} == {AxisState.IDLE}
    assert rig.setpoints_of[0][-1].cycle > restarted


@pytest.mark.parametrize("mode", ["holding"])
@pytest.mark.parametrize("command", ["disable", "quick_stop", "reset"])
@pytest.mark.long
def test_a_drive_that_does_not_end_its_procedure_is_named_and_commands_are_answered(
    rig: OdriveRig, command: str, mode: str
) -> None:
    rig.cycles(50)
    rig.odrives[1]._handlers[cansimple.SET_AXIS_STATE] = lambda data: None
    rig.odrives[1].axis_state = 9  # type: ignore[assignment]
    rig.cycles(1500)
    answer = rig.command(command)
    assert isinstance(answer, Refused)
    assert "drive B" in answer.message


@pytest.mark.parametrize("mode", ["holding"])
@pytest.mark.parametrize("lost", [1, 2])
def test_lost_controller_modes_do_not_enable_a_drive_in_another_mode(rig: OdriveRig, lost: int, mode: str) -> None:
    rig.inject(f"B drop set_controller_mode for {lost} frames")
    rig.enable()
    assert {drive.modes for drive in rig.odrives} == {(cansimple.POSITION_CONTROL, cansimple.PASSTHROUGH)}


@pytest.mark.parametrize("mode", ["holding"])
@pytest.mark.parametrize("lost", [1, 2])
def test_a_reset_succeeds_although_commands_are_lost(rig: OdriveRig, lost: int, mode: str) -> None:
    begin(rig, mode, "B fault 200 for 0.1")
    rig.until(rig.stands, 2 * ROLLING)
    rig.cycles(ROLLING)
    rig.inject(f"B drop clear_errors for {lost} frames")
    assert isinstance(rig.command("reset"), CommandDone)
    rig.cycles(ROLLING)
    rig.enable()


@pytest.mark.parametrize("mode", [*map(tried, NOT_HOMING)])
def test_drives_whose_service_is_gone_are_disarmed_by_their_watchdogs(rig: OdriveRig, mode: str) -> None:
    begin(rig, mode, "error-passive")
    for _ in range(DEAF):
        rig.now += PERIOD
        for drive in rig.odrives:
            drive.poll(rig.now)
    assert rig.stands()
    assert {drive.disarm_reason for drive in rig.odrives} == {cansimple.Error.WATCHDOG_TIMER_EXPIRED}


@pytest.mark.parametrize("mode", [*map(tried, IN_MOTION)])
@pytest.mark.parametrize("line", ["bus-off for 0.005", "bus-off for 0.02", "bus-off for 0.06", "queue full for 0.02"])
def test_a_bus_that_comes_back_within_the_ramp_makes_no_drive_jump(rig: OdriveRig, line: str, mode: str) -> None:
    """By what the drives have heard, rather than by what was sent."""
    begin(rig, mode, line)
    speed = max(abs(drive.servo.velocity) for drive in rig.odrives)
    heard = [[drive.servo.setpoint for drive in rig.odrives]]
    for _ in range(200):
        rig.cycle()
        heard.append([drive.servo.setpoint for drive in rig.odrives])
        assert max(abs(drive.servo.velocity) for drive in rig.odrives) <= 1.05 * speed
    assert rig.faulty()
    armed = np.array(heard)[: rig.states_of[0][-1][0] - rig.trips[0]]
    assert np.abs(np.diff(armed, axis=0)).max() <= 1.01 * speed * PERIOD
