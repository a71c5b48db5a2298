"""Driver of three ODrives on CANSimple in position control: interface.DriveGroup.

CANSimple has no SYNC. Instead, `sync` sends the setpoints of the previous cycle, one after the other, at the beginning
of the cycle, and then requests the positions. A setpoint thus takes effect at the same moment of the cycle as with CiA
402. However, drive B receives its setpoint one frame later than drive A, and drive C two frames later: 0.14 and 0.27 ms
at 1 Mbit/s, in every cycle. At 0.1 m/s, sliders that should move together are then up to 27 µm apart.

The driver requests the positions; the drives do not send them cyclically (`encoder_msg_rate_ms`). Otherwise each drive
would send positions at the rate of its own clock, some cycles would receive no position or two, and the age of the
positions would be unknown.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial

import can

from trirail_drivers import config
from trirail_drivers.bus.reopening import Reopening
from trirail_drivers.config import NO_IO, DigitalIo
from trirail_drivers.driver.driver import Driver
from trirail_drivers.driver.recovery import Recovery
from trirail_drivers.driver.row_updates import count_sync, due_setpoint, end_reading
from trirail_drivers.interface import Clock, DriveFault, Feedback, Travel, Triple
from trirail_drivers.odrive import cansimple, setup
from trirail_drivers.odrive.axis import RESET_REQUESTS, OdriveAxis
from trirail_drivers.odrive.cansimple import AxisState
from trirail_drivers.odrive.cycle_tables import CycleTableWriter
from trirail_drivers.odrive.other_masters import listen_for_masters
from trirail_drivers.odrive.protections import describe_protection
from trirail_drivers.odrive.returning import ReturningOdrive
from trirail_drivers.odrive.setpoints import SetpointSender
from trirail_drivers.odrive.setup import OdriveStart
from trirail_drivers.timing import BusTiming

MODES_SENT = 3
"""Number of cycles in which each power-up sends the controller mode. The drive may have restarted, does not report its
mode, and must not get power in another one if a message is lost.
"""


class Odrive(Driver[OdriveAxis]):
    """Three ODrives on one CAN bus.

    An ODrive has no quick stop: with both Estop and the idle state, the motor coasts. Velocity control with a ramp
    would require a change of mode under power, which ODrive advises against, and a ramp that CANSimple cannot set
    (`vel_ramp_rate`, 1 turn/s² by default). Therefore the driver generates the ramp: it slows the setpoints down with
    `quick_stop_deceleration`, waits until the servos have settled, and then removes power. If the host fails during
    the ramp, the watchdogs of the drives disarm the drives. An ODrive has no following error window either, so the
    driver monitors `following_error`.
    """

    def __init__(
        self,
        bus: can.BusABC,
        timing: BusTiming,
        drives: config.Drives,
        clock: Clock = time.monotonic,
        reopening: Reopening | None = None,
        io: Sequence[DigitalIo] = NO_IO,
    ) -> None:
        setup.check_nodes(drives)
        super().__init__(bus, timing, drives, clock, OdriveAxis, drives.missed_positions, reopening, io)
        for axis in self._axes:
            for number, handler in (
                (cansimple.GET_VERSION, axis.ignore_answer),
                (cansimple.ADDRESS, axis.ignore_answer),
                (cansimple.HEARTBEAT, axis.on_heartbeat),
                (cansimple.GET_ERROR, axis.on_errors),
                (cansimple.GET_ENCODER_ESTIMATES, axis.on_estimates),
                (cansimple.TX_SDO, axis.ignore_answer),
            ):
                self._wire.listen(
                    cansimple.identifier(axis.node, number), axis, axis.with_setup_listener(number, handler)
                )
        listen_for_masters(self._wire, self._axes)
        self._requests = tuple(cansimple.request(axis.node, cansimple.GET_ENCODER_ESTIMATES) for axis in self._axes)
        self._error_requests = tuple(cansimple.request(axis.node, cansimple.GET_ERROR) for axis in self._axes)
        self._times.beats, self._times.beat_period = 1, cansimple.ERROR_PERIOD
        self._enabled = False
        self._table_writer = CycleTableWriter(self.tables, self._axes, self._error_requests, self._requests)
        self._setpoints = SetpointSender(self._axes, self.tables.setpoints, self._wire, drives.quick_stop_deceleration)

    def configure(
        self,
        period: float,
        fastest: float | None = None,  # noqa: ARG002
        *,
        travel: Travel | None = None,  # noqa: ARG002
        awaits: bool = False,
    ) -> None:
        """Check the drives and prepare them, without power, for a cycle of `period` seconds. `fastest` and `travel`
        are not used.

        With `awaits`, a drive that does not answer causes a fault and is checked when it appears, and a missing bus
        causes a fault and is opened when it appears.

        Raises BusError if the cycle's frames do not fit on the bus, DriveTimeout if a drive is missing, and DriveError
        if a drive lacks a protection that `accept_without` does not list. A drive that reports errors causes no
        exception: the feedback reports the errors, and `reset` clears them.
        """
        self._set_period(period, cansimple.TRAFFIC)
        self._setpoints.period = period
        ones = setup.setup_tasks(self._wire.bus, self._drives, period, self._clock)
        configure = partial(setup.configure, self._wire.bus, ones, self._clock, awaits=awaits)
        done, lost = self._set_up(configure, awaits=awaits)
        each = [
            ReturningOdrive(axis, one, partial(self._rejoin_drive, axis))
            for axis, one in zip(self._axes, ones, strict=True)
        ]
        self._recovery = recovery = Recovery(self._wire, period * self._timing.bitrate, each)
        for axis, returning, result in zip(self._axes, each, done, strict=True):
            if result is None:
                axis.silent, axis.homed, axis.position = True, False, axis.scale.metres(0.0)
                continue
            made, start = result
            axis.set_up(*start)
            returning.record_setup(made, returning.one.client.answered)
        self._warn_of_setup(recovery.setups)
        self._report_absent(lost)

    def _rejoin_drive(self, axis: OdriveAxis, start: OdriveStart) -> None:
        """Let a drive take part in the cycle again after it has been checked in the background."""
        axis.rejoin(self._clock())
        axis.set_up(*start)

    def sync(self) -> None:
        """Send the setpoints written since the last cycle, which take effect on arrival, and request the positions.

        Frames that have already arrived are handled first, since positions among them answer the previous cycle's
        requests.
        """
        now = self._synced = self._clock()
        self._begin_cycle(now)
        if math.isnan(self._times.beat_due):
            # Time-outs count from the first cycle, however long ago the set-up was.
            self._times.beat_due = now
            for axis in self._axes:
                axis.heard = now
                axis.clear_missed()
        self._wire.receive(now)
        self._send_cycle_start(now)

    def _send_cycle_start(self, now: float, sent: int = 0) -> None:
        """Send the frames at the beginning of a cycle, except the first `sent` frames, which are already on the bus."""
        history = self.tables.history
        history[(self._axes[0].syncs + 1) % len(history)] = [axis.sent for axis in self._axes]
        sent -= self._setpoints.step(self._enabled, sent)
        self._request_states()
        for number, (axis, request) in enumerate(zip(self._axes, self._requests, strict=True)):
            if number >= sent:
                self._wire.send(request)
            count_sync(axis)
        times = self._times
        if now >= times.beat_due:
            times.beat_due = now + times.beat_period
            axis = self._axes[times.next_beat]
            if now < axis.reset_until:  # sent again, since a command may be lost
                self._clear_errors(axis)
            self._wire.send(self._error_requests[times.next_beat])
            times.next_beat = (times.next_beat + 1) % len(self._error_requests)

    def read(self) -> Feedback:
        """Handle every frame that has arrived, and return the feedback."""
        now = self._clock()
        self._wire.receive(now)
        for axis in self._axes:
            axis.end_cycle()
            end_reading(axis)
            if self._wire.fault is not None and axis.present:
                axis.watch_silence(now, self._period)
        if self._wire.fault is None:
            fault = self._find_fault(now)
            if fault is not None:
                self._wire.fail(fault)
        self._check_stopped(now)
        return self._feedback(self._wire.warnings())

    def observe(self) -> Feedback:
        """Handle every frame that has arrived, and return the feedback; see interface.DriveGroup."""
        self._wire.receive(self._clock())
        return self._feedback()

    def _feedback(self, warnings: tuple[str, ...] = ()) -> Feedback:
        a, b, c = self._axes
        on = self._enabled
        return Feedback(
            (a.position, b.position, c.position),
            (a.power(on and not a.left_out), b.power(on and not b.left_out), c.power(on and not c.left_out)),
            self._wire.fault,
            warnings,
            (a.age, b.age, c.age),
            homed=(a.homed, b.homed, c.homed),
            unready=self._unready,
        )

    def write(self, position: Triple, velocity: Triple) -> None:
        """Store setpoints [m] and velocity feed-forward [m/s], which the next `sync` sends to enabled drives.

        Setpoints that are not finite or do not fit into a message latch a fault with cause "setpoint" instead.
        Setpoints are ignored during a quick stop.
        """
        self._recover()  # the setpoints of this cycle are already on the bus
        if self._setpoints.stopping:
            return
        if (axis := self._setpoints.set_next(position, velocity)) is not None:
            number = self._axes.index(axis)
            self._refuse_setpoint(axis, position[number], velocity[number])
            return
        if self._clock() - self._synced > self._period:
            for axis in self._axes:
                axis.setpoints_late += 1

    def prepare_tables(self) -> bool:
        """Return True if all drives are in their target states and nothing is pending; see driver.cyclic."""
        sender = self._setpoints
        if math.isnan(self._times.beat_due) or not self._wire.is_healthy or sender.stopping:
            return False
        if self._enabled and not (sender.sent and sender.written):
            return False
        if not all(axis.is_steady(self._target_state(axis)) for axis in self._axes):
            return False
        self._table_writer.fill(follow=self._enabled, within=self._drives.following_error)
        return True

    def enable(self, alone: str | None = None) -> None:
        """Begin to power up all drives, or only the drive `alone`, after the next `sync` has sent setpoints.

        This does nothing while a fault is latched. The states in the feedback are those of the drives' heartbeats.
        """
        if self._wire.fault is not None or self._enabled:
            return
        self._enabled = True
        self._setpoints.forget()
        for axis in self._axes:
            axis.powered_up = False
            axis.left_out = alone not in (None, axis.name)
            axis.requested, axis.modes_sent, axis.attempts = None, 0, 0

    def home(self) -> None:
        """Do nothing, since the configuration refuses homing for ODrives."""

    def stop_homing(self) -> None:
        """Do nothing, since ODrives are not homed."""

    def disable(self) -> None:
        """Remove power from the drives, which must be at standstill.

        A drive that still has power after `stop_timeout` latches a fault with cause "timeout".
        """
        self._start_stop_timer("disable")
        self._enabled = False
        self._setpoints.forget()
        self._request_states()

    def quick_stop(self) -> None:
        """Begin the quick-stop ramp of every drive in this cycle. Power is removed when the ramp ends.

        A drive that still has power after `stop_timeout` is disarmed immediately, and a fault with cause "timeout"
        replaces the fault that caused the stop.
        """
        if self._setpoints.stopping:
            return
        self._start_stop_timer("quick stop")
        self._enabled = False
        if self._setpoints.sent:
            self._setpoints.stop()
        self._request_states()

    def reset(self) -> None:
        """Clear the latched fault and the errors of the drives, without powering up.

        A condition that persists latches a fault again.
        """
        self._wire.reset()
        now = self._clock()
        if not self._enabled and self._times.off_deadline == math.inf:
            self._start_stop_timer("reset")
        for axis in self._axes:
            if not axis.configured:
                continue
            axis.event = None
            if axis.errors or not self._enabled:  # errors of a drive that has lost power may not be known yet
                if now >= axis.reset_until:  # a reset under way gets no more time, so that its failure becomes known
                    axis.reset_until = now + RESET_REQUESTS * max(cansimple.ERROR_PERIOD, self._period)
                self._clear_errors(axis)

    def _clear_errors(self, axis: OdriveAxis) -> None:
        self._wire.send(cansimple.command(axis.node, cansimple.CLEAR_ERRORS, cansimple.CLEAR.pack(0)))

    def _cut_power(self) -> None:
        idle = cansimple.AXIS_STATE.pack(AxisState.IDLE)
        for axis in self._axes:
            self._wire.send(cansimple.command(axis.node, cansimple.SET_AXIS_STATE, idle))

    def _wants_power(self) -> bool:
        return self._enabled

    @staticmethod
    def _describe_protection(protection: str) -> str:
        return describe_protection(protection)

    @staticmethod
    def _has_power(axis: OdriveAxis) -> bool:
        return axis.powered

    def _abandon_stop(self) -> None:
        self._setpoints.forget()

    def _find_fault(self, now: float) -> DriveFault | None:
        """Return the first fault of a drive, or None. A following error outside its window is also a fault."""
        for number, axis in enumerate(self._axes):
            fault = axis.find_fault(now, self._enabled and not axis.left_out)
            if fault is not None:
                return fault
            due = due_setpoint(axis, self.tables.history[:, number])
            if math.isnan(due) or not (self._enabled and axis.powered_up):
                continue
            error = due - axis.position
            if not abs(error) <= self._drives.following_error:
                return axis.make_fault(
                    "fault",
                    0,
                    f"following error {error * 1e3:.9g} mm exceeds its window of "
                    f"{self._drives.following_error * 1e3:g} mm",
                )
        return None

    def _request_states(self) -> None:
        """Request each drive's target state once, and again whenever a heartbeat shows a different state."""
        for axis in self._axes:
            wanted = self._target_state(axis)  # evaluated for each drive, since a failed send begins a quick stop
            if wanted is None or axis.requested is wanted:
                continue
            if wanted is AxisState.CLOSED_LOOP_CONTROL and axis.modes_sent < MODES_SENT:
                mode = cansimple.CONTROLLER_MODE.pack(cansimple.POSITION_CONTROL, cansimple.PASSTHROUGH)
                if not self._wire.send(cansimple.command(axis.node, cansimple.SET_CONTROLLER_MODE, mode)):
                    return
                axis.modes_sent += 1
            elif self._wire.send(
                cansimple.command(axis.node, cansimple.SET_AXIS_STATE, cansimple.AXIS_STATE.pack(wanted))
            ):
                axis.note_request(wanted)

    def _target_state(self, axis: OdriveAxis) -> AxisState | None:
        """Return the state in which a drive should be now, or None if its present state should not change."""
        if axis.has_returned or (self._enabled and axis.left_out):
            return AxisState.IDLE
        if not self._enabled:
            return None if self._setpoints.stopping else AxisState.IDLE
        return AxisState.CLOSED_LOOP_CONTROL if self._setpoints.sent else None

    def _continue_stop(self) -> None:
        """Do nothing, since `sync` generates the ramp."""
