"""Three ODrives on CANSimple in position control: trirail_drivers.interface.DriveGroup.

CANSimple has no SYNC. What stands for it is the beginning of the cycle, `sync`: there the setpoints of the cycle
before are sent, one after the other, and then the positions are asked for. So a setpoint is in force from the same
moment of the cycle on as with CiA 402, but drive B takes it up one frame and drive C two frames after drive A: at
1 Mbit/s 0.14 and 0.27 ms, in every cycle alike. At 0.1 m/s this puts the sliders 27 µm apart that were to move as one.

Positions are asked for rather than pushed by the drives (`encoder_msg_rate_ms`): pushed ones come by the drives' own
clocks, none or two of them in a cycle now and then, and nobody could tell their age.
"""

from __future__ import annotations

import math
import time

import can

from trirail_drivers import config
from trirail_drivers.driver.axis_row import NOWHERE
from trirail_drivers.driver.cyclic import Cyclic
from trirail_drivers.driver.driver import Driver
from trirail_drivers.interface import Clock, DriveFault, Feedback, Triple
from trirail_drivers.odrive import cansimple, setup
from trirail_drivers.odrive.axis import OdriveAxis
from trirail_drivers.odrive.cansimple import AxisState
from trirail_drivers.odrive.lending import Lending
from trirail_drivers.odrive.protections import means
from trirail_drivers.odrive.setpoints import SetpointSender


class Odrive(Driver[OdriveAxis]):
    """Three ODrives on one CAN bus.

    An ODrive has no quick stop of its own. Its Estop and its idle state let the motor coast, and to put it into
    velocity control with a ramp is to change modes under power, which ODrive advises against, to a ramp that CANSimple
    cannot set (`vel_ramp_rate`, by default 1 turn/s²). So the driver itself leads the setpoints down the ramp
    `quick_stop_deceleration`, holds until the servos have settled, and then takes the power off. Where the host dies
    in the middle of it, the drives' watchdogs disarm them. Nor has an ODrive a following error window: the driver
    watches `following_error` as well.
    """

    def __init__(self, bus: can.BusABC, bitrate: int, drives: config.Drives, clock: Clock = time.monotonic) -> None:
        setup.check_nodes(drives)
        super().__init__(bus, bitrate, drives, clock, OdriveAxis, history=drives.missed_positions)
        for axis in self._axes:
            for number, handler in (
                (cansimple.GET_VERSION, axis.on_version),
                (cansimple.HEARTBEAT, axis.on_heartbeat),
                (cansimple.GET_ERROR, axis.on_errors),
                (cansimple.GET_ENCODER_ESTIMATES, axis.on_estimates),
                (cansimple.TX_SDO, axis.on_sdo),
            ):
                self._wire.listen(cansimple.identifier(axis.node, number), axis, handler)
        self._requests = tuple(cansimple.request(axis.node, cansimple.GET_ENCODER_ESTIMATES) for axis in self._axes)
        self._error_requests = tuple(cansimple.request(axis.node, cansimple.GET_ERROR) for axis in self._axes)
        self._next_request = 0
        self._errors_due: float | None = None
        self._enabled = False
        self._setpoints = SetpointSender(self._axes, self._wire, drives.quick_stop_deceleration)
        self._lending = Lending(self._tables, self._axes, self._error_requests, self._requests)

    def configure(self, period: float, fastest: float | None = None) -> None:  # noqa: ARG002  their unit says any
        """Find the drives and leave them without power, for a cycle of `period` seconds.

        Raises DriveError: BusError if the cycle does not fit on the bus, DriveTimeout for one that is not there, and
        for one that is not set as it must be, where its configuration does not accept that. One with errors is none;
        feedback tells of it and `reset` clears it.
        """
        self._set_period(period, cansimple.TRAFFIC)
        self._setpoints.period = period
        self._warn_of_setup(setup.configure(self._wire, self._axes, self._drives, period, self._clock), means)

    def sync(self) -> None:
        """Send the setpoints written since the last cycle, which are in force on arrival; ask for the positions.

        What has arrived is taken in before: positions among it answer what was asked in the cycle before.
        """
        now = self._synced = self._clock()
        self._wire.begin()
        if self._errors_due is None:
            # The watching begins with the first cycle, however long ago the set-up was.
            self._errors_due = now
            for axis in self._axes:
                axis.heard = now
                axis.forgive_unanswered()
        self._wire.receive(now)
        self._begin(now, self._errors_due)

    def _begin(self, now: float, errors_due: float, sent: int = 0) -> None:
        """Send what begins a cycle; somebody else has sent so many frames of it."""
        history = self._tables.history
        history[(self._axes[0].syncs + 1) % len(history)] = [axis.sent for axis in self._axes]
        sent -= self._setpoints.step(self._enabled, sent)
        self._command()
        for number, (axis, request) in enumerate(zip(self._axes, self._requests, strict=True)):
            if number >= sent:
                self._wire.send(request)
            axis.sync_sent()
        if now >= errors_due:
            self._errors_due = now + cansimple.ERROR_PERIOD
            self._wire.send(self._error_requests[self._next_request])
            self._next_request = (self._next_request + 1) % len(self._error_requests)

    def read(self) -> Feedback:
        """Take in every frame that has arrived."""
        now = self._clock()
        self._wire.receive(now)
        for axis in self._axes:
            axis.read_over()
        if self._wire.fault is None:
            fault = self._found(now)
            if fault is not None:
                self._wire.fail(fault)
        self._watch_stopping(now)
        return self._feedback()

    def _feedback(self) -> Feedback:
        a, b, c = self._axes
        on = self._enabled
        return Feedback(
            (a.position, b.position, c.position),
            (a.power(on and not a.left_out), b.power(on and not b.left_out), c.power(on and not c.left_out)),
            self._wire.fault,
            (a.counts, b.counts, c.counts),
            self._wire.warnings(),
            (a.age, b.age, c.age),
        )

    def write(self, position: Triple, velocity: Triple) -> None:
        """Take setpoints [m] and velocity feed-forward [m/s], to be sent at the next SYNC once enabled.

        Setpoints that are not finite, or beyond what a message holds, are not sent but a fault of cause "setpoint".
        During a quick stop they are left aside.
        """
        if self._setpoints.stopping:
            return
        if (axis := self._setpoints.set_next(position, velocity)) is not None:
            number = self._axes.index(axis)
            self._refuse_setpoint(axis, position[number], velocity[number])
            return
        if self._clock() - self._synced > self._period:
            for axis in self._axes:
                axis.setpoints_late += 1

    def lend(self) -> Cyclic | None:
        """The tables of a cycle, where every drive rests in what it was asked for and nothing else is to be done."""
        due, sender = self._errors_due, self._setpoints
        if due is None or not self._wire.calm or sender.stopping:
            return None
        if self._enabled and not (sender.sent and sender.written):
            return None
        if not all(axis.rests(self._wanted(axis)) for axis in self._axes):
            return None
        times, asks = self._tables.times, (1, self._next_request)
        times[0] = self._off_by, due, cansimple.ERROR_PERIOD, *asks, NOWHERE, times[0]["traffic"]
        self._lending.fill(follow=self._enabled, within=self._drives.following_error)
        return self._tables

    def take_back(self, arrived: int, *, synced: float | None = None, error: int = 0) -> Feedback:
        """Go on from what the tables hold: see trirail_drivers.driver.cyclic.Lender."""
        times = self._tables.times[0]
        self._errors_due, self._next_request = float(times["beat_due"]), int(times["next_beat"])
        self._wire.hand_in(self._tables.arrived, arrived, error)
        feedback = self._feedback()
        if synced is not None:
            self._synced = synced
            if times["begun"] != NOWHERE:
                self._begin(synced, self._errors_due, int(times["begun"]))
        return feedback

    def send_on(self, first: int) -> None:
        """Do nothing: setpoints go with the next SYNC."""

    def enable(self, alone: str | None = None) -> None:
        """Begin to power up, all drives or one `alone`, after the setpoints of the next SYNC; the states tell when.

        Does nothing while a fault is latched. A drive tells its state with its heartbeat: that long it takes.
        """
        if self._wire.fault is not None or self._enabled:
            return
        self._enabled = True
        self._setpoints.begin()
        self._off_by = math.inf
        for axis in self._axes:
            axis.powered_up = False
            axis.left_out = alone not in (None, axis.name)
            axis.requested = None

    def home(self) -> None:
        """Do nothing: the configuration takes no homing for ODrives, so none has to be homed."""

    def stop_homing(self) -> None:
        """Do nothing: there is no homing."""

    def disable(self) -> None:
        """Take power off; meant for a robot at standstill. A drive that keeps it is a fault, of cause "timeout"."""
        self._give_time_to_stop("disable")
        self._enabled = False
        self._setpoints.abandon()
        self._command()

    def quick_stop(self) -> None:
        """Begin to stop every drive by the quick-stop ramp, in this cycle; it ends without power.

        A drive that has it after `stop_timeout` is told to lose it at once, and is a fault, of cause "timeout", that
        takes the place of the one that stopped it.
        """
        if self._setpoints.stopping:
            return
        self._give_time_to_stop("quick stop")
        powering = self._enabled or self._powered()
        self._enabled = False
        if not self._setpoints.sent or not powering:
            self._command()
        else:
            self._setpoints.stop()

    def reset(self) -> None:
        """Forget the fault and clear the drives' own; never powers them up. What persists is found again."""
        self._wire.reset()
        now = self._clock()
        if not self._enabled:
            self._give_time_to_stop("reset")
        for axis in self._axes:
            axis.forgive(now)
            if axis.errors:
                self._wire.send(cansimple.command(axis.node, cansimple.CLEAR_ERRORS, cansimple.CLEAR.pack(0)))

    def _leave(self) -> None:
        idle = cansimple.AXIS_STATE.pack(AxisState.IDLE)
        for axis in self._axes:
            self._wire.send(cansimple.command(axis.node, cansimple.SET_AXIS_STATE, idle))

    def _wants_power(self) -> bool:
        return self._enabled

    def _powered(self) -> bool:
        return any(axis.powered for axis in self._axes)

    def _give_up_stopping(self) -> None:
        self._setpoints.abandon()

    def _found(self, now: float) -> DriveFault | None:
        """The first thing that is wrong."""
        for number, axis in enumerate(self._axes):
            fault = axis.fault(now, self._enabled and not axis.left_out)
            if fault is not None:
                return fault
            history = self._tables.history
            due = float(history[(axis.syncs - min(axis.age, len(history) - 1)) % len(history), number])
            if math.isnan(due) or not (self._enabled and axis.powered_up):
                continue
            error = due - axis.position
            if not abs(error) <= self._drives.following_error:
                return axis.made(
                    "fault",
                    0,
                    f"following error {error * 1e3:.3f} mm is beyond its window "
                    f"{self._drives.following_error * 1e3:g} mm",
                )
        return None

    def _command(self) -> None:
        """Ask drives for the state they should be in, once, and again where a heartbeat shows another."""
        for axis in self._axes:
            wanted = self._wanted(axis)  # anew for each: a frame that cannot be sent begins a quick stop
            if wanted is None or axis.requested is wanted:
                continue
            if wanted is AxisState.CLOSED_LOOP_CONTROL:  # with every power-up, for a drive may have restarted
                mode = cansimple.CONTROLLER_MODE.pack(cansimple.POSITION_CONTROL, cansimple.PASSTHROUGH)
                if not self._wire.send(cansimple.command(axis.node, cansimple.SET_CONTROLLER_MODE, mode)):
                    return
            if self._wire.send(
                cansimple.command(axis.node, cansimple.SET_AXIS_STATE, cansimple.AXIS_STATE.pack(wanted))
            ):
                axis.note_request(wanted)

    def _wanted(self, axis: OdriveAxis) -> AxisState | None:
        """The state that a drive should be in now; None leaves it as it is."""
        if self._enabled and axis.left_out:
            return AxisState.IDLE
        if not self._enabled:
            return None if self._setpoints.stopping else AxisState.IDLE
        return AxisState.CLOSED_LOOP_CONTROL if self._setpoints.sent else None

    def _wait_for_standstill(self, deadline: float) -> None:
        while self._powered() and (now := self._clock()) < deadline:  # the cycle goes on, for it leads the ramp
            self.sync()
            while (left := now + self._period - self._clock()) > 0.0:
                self._wire.wait(left, self._clock)
