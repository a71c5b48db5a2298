"""Driver of three CiA 402 drives on CANopen, which follow positions and can be homed: interface.DriveGroup.

The identifiers determine the priorities on the bus, highest first: SYNC, emergencies, statuswords, controlwords,
positions, setpoints, heartbeats. Thus the controlword of a quick stop overtakes setpoints that are still waiting.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial

import can

from trirail_drivers import config
from trirail_drivers.bus import load
from trirail_drivers.bus.can_frame import DATA_AT
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.packed_frames import packed_frames
from trirail_drivers.bus.reopening import Reopening
from trirail_drivers.cia402 import canopen_frames, process_data, setup
from trirail_drivers.cia402.axis import STATUS_WITHIN, Cia402Axis
from trirail_drivers.cia402.homing import HomingSequence
from trirail_drivers.cia402.objects import describe_protection
from trirail_drivers.cia402.one_drive import HAS_POWER, SetUp, Start
from trirail_drivers.cia402.other_masters import OtherMasters
from trirail_drivers.cia402.returning import ReturningCia402
from trirail_drivers.config import NO_IO, DigitalIo
from trirail_drivers.driver.axis_row import NOTHING_SENT
from trirail_drivers.driver.driver import Driver
from trirail_drivers.driver.recovery import Recovery
from trirail_drivers.driver.row_updates import (
    count_sync,
    end_reading,
    note_outputs,
    outputs_pending,
    put_outputs,
    put_setpoint,
    scale_setpoint,
)
from trirail_drivers.errors import BusError
from trirail_drivers.interface import Clock, Feedback, PowerState, Travel, Triple
from trirail_drivers.timing import BusTiming

REPEAT_AFTER = 3
"""Number of SYNCs after which a controlword that had no effect is sent again, since its frame may have been lost."""


class Cia402(Driver[Cia402Axis]):
    """Three CiA 402 drives on one CAN bus."""

    def __init__(
        self,
        bus: can.BusABC,
        timing: BusTiming,
        drives: config.Drives,
        clock: Clock = time.monotonic,
        reopening: Reopening | None = None,
        io: Sequence[DigitalIo] = NO_IO,
    ) -> None:
        """`reopening` reopens a lost bus; `io` contains the digital outputs and inputs of each drive."""
        super().__init__(bus, timing, drives, clock, Cia402Axis, reopening=reopening, io=io)
        self._other_masters = OtherMasters(self._wire, self._axes, drives.master_node)
        for axis, drive in zip(self._axes, drives.each, strict=True):
            axis.homes = drive.homing is not None
            self._listen(axis)
        self._homing = HomingSequence(self._axes, drives, self._wire.send)
        self._sync = Frame(canopen_frames.SYNC)
        self._beats = [
            Frame(
                canopen_frames.HEARTBEAT + drives.master_node, canopen_frames.NMT_STATE.pack(canopen_frames.OPERATIONAL)
            )
        ]
        self._pack_frames()
        self._times.beat_period = drives.heartbeat
        self._wanted: canopen_frames.TargetState = PowerState.SWITCH_ON_DISABLED
        self._stopped_in_this_cycle = False
        self._requested_after = 0
        """Number of SYNCs sent before the last `write`."""
        self._expected_state: list[tuple[int, int]] = []
        """Statusword and inputs of each drive for which the expected frames were last written."""

    def configure(
        self, period: float, fastest: float | None = None, *, travel: Travel | None = None, awaits: bool = False
    ) -> None:
        """Set up the drives for a cycle of `period` seconds, read every value back, and start the drives without power.

        With `awaits`, a drive that does not answer causes a fault and is configured when it appears, and a missing bus
        causes a fault and is opened when it appears.

        Raises BusError if the cycle's frames do not fit on the bus, DriveTimeout or ConfigurationRefused if a drive
        does not answer or does not accept a value, and DriveError if a drive's unit of velocity does not fit `fastest`,
        the velocity limit of the sliders [m/s], or if its position limits exclude part of their `travel` [m]. A drive
        in fault causes no error: the feedback reports the fault, and `reset` clears it.
        """
        io = [axis.io for axis in self._axes]
        plan = process_data.plan_traffic(self._drives, io, 1.0 / period, self._timing)
        self._check_plan(period, plan)
        for axis in self._axes:
            exchange = process_data.default_exchange(axis.node, axis.io, velocity_offset=plan.velocity_offset)
            axis.set_up(exchange, axis.units)
            axis.status_within = max(STATUS_WITHIN, self._drives.missed_positions * period)
        scales = tuple(axis.scale for axis in self._axes)
        ones = setup.setup_tasks(
            self._wire.bus,
            self._drives,
            scales,
            period,
            self._clock,
            io,
            velocity_offset=plan.velocity_offset,
            travel=travel,
        )
        configure = partial(setup.configure, self._wire.bus, self._drives, ones, fastest, awaits=awaits)
        done, lost = self._set_up(configure, awaits=awaits)
        each = [
            ReturningCia402(axis, one, fastest, partial(self._rejoin_drive, number), lambda: recovery.setups)
            for number, (axis, one) in enumerate(zip(self._axes, ones, strict=True))
        ]
        self._recovery = recovery = Recovery(self._wire, period * self._timing.bitrate, each)
        for axis, returning, result in zip(self._axes, each, done, strict=True):
            if result is None:
                axis.silent, axis.homed = True, False
                axis.update_position(0)
                continue
            made, start = result
            axis.set_up(made.exchange, made.units)
            axis.mode.shown = made.exchange.mode_shown
            returning.record_setup(made, returning.one.remote.client.answered)
            self._apply_start(axis, start)
        self._prepare_frames()
        self._warn_of_setup(recovery.setups)
        self._report_absent(lost)

    def _check_plan(self, period: float, plan: load.TrafficPlan) -> None:
        """Set the cycle period [s], and emit a warning if the velocity offset is left out.

        Raises BusError if the planned frames do not fit on the bus.
        """
        try:
            self._set_period(period, plan.traffic)
        except BusError as error:
            raise BusError("; ".join(filter(None, (str(error), plan.remedy)))) from error
        if plan.omission:
            used = load.usage(1.0 / period, self.bus_load, "the bus")
            self._wire.warn(f"CAN bus: {used}: {plan.omission}; the drives follow with more lag")

    def _apply_start(self, axis: Cia402Axis, start: Start) -> None:
        """Store the state that a drive had at the end of its set-up, and handle its frames from now on."""
        self._listen(axis)
        axis.update_position(start.counts)
        axis.start_inputs(start.inputs)
        axis.update_status(start.statusword, axis.status_heard)
        axis.start_error(start.error_code, in_error=start.in_error)
        if start.in_error and not axis.error_code:
            self._wire.warn(f"drive {axis.name}: its error register 1001h shows an error, without an error code")

    def _prepare_frames(self) -> None:
        """Create the frames that each cycle sends."""
        self._set_period(self._period, process_data.traffic(axis.exchange for axis in self._axes))
        guarded = (axis.node for axis in self._axes if axis.exchange.guarded)
        self._beats[1:] = [Frame(canopen_frames.HEARTBEAT + node, b"\0", remote=True) for node in guarded]
        self._pack_frames()
        self._expected_state = []

    def _pack_frames(self) -> None:
        """Create the tables of the frames to send; digital outputs have frames if a drive has its outputs in a PDO."""
        tables, packed = self.tables, partial(packed_frames, fd=self._timing.fd)
        tables.begin, tables.beats, self._times.beats = packed([self._sync]), packed(self._beats), len(self._beats)
        tables.setpoints = packed([axis.exchange.setpoints.frame() for axis in self._axes])
        tables.end = tables.setpoints.headers
        outputs = [Frame(axis.exchange.outputs or 0, bytes(canopen_frames.OUTPUTS.size)) for axis in self._axes]
        tables.outputs = packed(outputs if any(axis.maps_outputs for axis in self._axes) else [])

    def _rejoin_drive(self, number: int, made: SetUp, start: Start) -> None:
        """Let a drive take part in the cycle again after its set-up in the background."""
        axis, drive = self._axes[number], self._drives.each[number]
        reported = axis.error_code if axis.left_operational else 0
        axis.rejoin(made.exchange, made.units, self._clock(), homed=drive.homing is None)
        self._apply_start(axis, start)
        # The reason why it left may persist, such as a missing heartbeat; a reset reads the error register.
        axis.error_code = axis.error_code or reported
        self._prepare_frames()

    def _listen(self, axis: Cia402Axis) -> None:
        """Set the handlers for the frames of a drive."""
        self._wire.forget(axis)
        listen, exchange = self._wire.listen, axis.exchange
        listen(exchange.feedback.identifier, axis, axis.on_position)
        if exchange.status is not None:
            listen(exchange.status, axis, axis.on_status)
        if exchange.inputs not in (None, exchange.status):
            listen(exchange.inputs or 0, axis, axis.on_inputs)
        listen(exchange.emergency, axis, axis.on_emergency)
        listen(canopen_frames.HEARTBEAT + axis.node, axis, axis.on_heartbeat)
        listen(canopen_frames.SDO_ANSWER + axis.node, axis, axis.on_sdo)
        self._other_masters.listen_to(axis)

    def sync(self) -> None:
        """Send SYNC: the drives apply the setpoints written since the last SYNC, and sample their positions.

        Frames that have already arrived are handled first, since positions among them answer the previous SYNC.
        """
        self._stopped_in_this_cycle = False
        now = self._synced = self._clock()
        self._begin_cycle(now)
        self._wire.receive(now)
        if math.isnan(self._times.beat_due):
            # Watchdog times count from the first cycle, however long ago the set-up was.
            self._times.beat_due = now
            for axis in self._axes:
                axis.status_heard = now
                axis.heard = now if axis.exchange.heard else math.inf
        self._send_cycle_start(now)

    def _send_cycle_start(self, now: float, sent: int = 0) -> None:
        """Send SYNC and due heartbeats, except the first `sent` of these frames, which are already on the bus."""
        frames_due = [self._sync]
        if now >= self._times.beat_due:
            self._times.beat_due = now + self._times.beat_period
            frames_due += self._beats
        for frame in frames_due[sent:]:
            self._wire.send(frame)
        for axis in self._axes:
            count_sync(axis)

    def read(self) -> Feedback:
        """Handle every frame that has arrived, and return the feedback."""
        now = self._clock()
        self._wire.receive(now)
        for axis in self._axes:
            if self._wire.down:
                axis.lose(stopping=self._times.off_deadline != math.inf)
            mistaken = axis.end_cycle()
            end_reading(axis)
            if self._wire.fault is not None and axis.present:
                axis.watch_silence(now, self._period)
            if mistaken is not None and self._wire.fault is mistaken:
                self._wire.fault = axis.event
            fault = axis.find_fault(now, _target_of(axis, self._wanted)) if self._wire.fault is None else None
            if fault is not None:
                self._wire.fail(fault)
        self._check_stopped(now)
        if self._wire.fault is None:
            fault = self._homing.step(now)
            if fault is not None:
                self._wire.fail(fault)
        if self._axes[0].syncs == self._requested_after:  # no SYNC since the last `write`, so no setpoints will follow
            self._poll(now)
        return self._feedback(self._wire.warnings())

    def observe(self) -> Feedback:
        """Handle every frame that has arrived, request the statuswords, and return the feedback; see
        interface.DriveGroup.
        """
        now = self._clock()
        self._wire.receive(now)
        for axis in self._axes:
            axis.update_inputs()
        now = self._clock()
        for axis in self._axes:  # neither an EMCY nor an NMT state shows whether a drive has power
            if not axis.accepts_request(now):
                continue
            if now >= axis.poll_due:
                self._ask(axis, canopen_frames.STATUSWORD_UPLOAD)
            elif axis.exchange.inputs_polled and now >= axis.inputs_due:
                self._ask(axis, canopen_frames.INPUTS_UPLOAD)
        return self._feedback()

    def _feedback(self, warnings: tuple[str, ...] = ()) -> Feedback:
        a, b, c = self._axes
        for axis in self._axes:
            axis.note_feedback()
        return Feedback(
            (a.position, b.position, c.position),
            (a.shown_state, b.shown_state, c.shown_state),
            self._wire.fault,
            warnings,
            (a.age, b.age, c.age),
            self._homing.under_way,
            (a.follows, b.follows, c.follows),
            (a.homed, b.homed, c.homed),
            self._unready,
            (a.inputs, b.inputs, c.inputs),
        )

    def write(self, position: Triple, velocity: Triple) -> None:
        """Send setpoints [m] and velocity feed-forward [m/s], which the drives apply at the next SYNC.

        Setpoints that are not finite or exceed 32-bit counts latch a fault with cause "setpoint" instead. During
        power-up, the next controlwords are sent after the setpoints, so that no drive gets power without a setpoint.
        Requests for values are sent after them, because they would delay the setpoints on the bus. Outputs are sent
        last. Requests and outputs are also sent if there are no setpoints.
        """
        if not self._stopped_in_this_cycle:
            self._write_setpoints(position, velocity)
        self._poll(self._clock())
        self._requested_after = self._axes[0].syncs
        self._send_outputs()

    def _write_setpoints(self, position: Triple, velocity: Triple) -> None:
        late = self._clock() - self._synced > self._period
        if self._wanted is not PowerState.OPERATION_ENABLED:
            self._command()  # if frames have to wait, stop commands are sent first
        frames = self.tables.setpoints
        for axis, frame, metres, rate in zip(self._axes, frames.frames, position, velocity, strict=True):
            if not axis.configured:
                continue
            if axis.holds is not None:
                axis.target, axis.offset = axis.holds, 0
            elif not scale_setpoint(axis, metres, rate):
                self._refuse_setpoint(axis, metres, rate)
                return
            axis.has_setpoint = True
            put_setpoint(axis, frame[DATA_AT:])
        for number, axis in enumerate(self._axes):
            if not axis.configured:
                continue
            if not self._wire.send(frames.frame(number)):
                axis.setpoints_lost += 1
            elif late:
                axis.setpoints_late += 1
        self._ask_for_registers()
        self._command()
        self._recover()

    def _send_outputs(self) -> None:
        """Send the digital outputs that have changed, or that a drive may have missed.

        Drives apply outputs from a PDO at the next SYNC, and outputs from an SDO when they receive it. A drive that has
        left NMT operational receives only the SDO.
        """
        now = self._clock()
        for number, axis in enumerate(self._axes):
            by_pdo = axis.maps_outputs and not axis.left_operational
            silent = axis.missed >= self._drives.missed_positions
            if by_pdo and silent:
                axis.outputs_sent = NOTHING_SENT
            if not (outputs_pending(axis) and axis.present):
                continue
            if by_pdo:
                put_outputs(axis, self.tables.outputs.frames[number, DATA_AT:])
                if self._wire.send(self.tables.outputs.frame(number)) and not silent:
                    note_outputs(axis)
            elif axis.accepts_request(now) and not self._is_being_configured(axis):
                word = canopen_frames.OUTPUTS.pack(axis.outputs | axis.outputs_kept)
                if self._ask(axis, canopen_frames.OUTPUTS_DOWNLOAD + word):
                    axis.outputs_sent, axis.outputs_repeats = axis.outputs, 0

    def _make_outputs_safe(self) -> None:
        """Write the safe values of the outputs and wait for the answers.

        The drives are in NMT pre-operational, in which they receive SDOs; in NMT stopped, they would not.
        """
        self.set_outputs([axis.io.safe for axis in self._axes])
        asked = [axis for axis in self._axes if axis.has_outputs and axis.present]
        self._await_answers(asked)  # a server handles one request at a time (CiA 301)
        for axis in asked:
            word = canopen_frames.OUTPUTS.pack(axis.outputs | axis.outputs_kept)
            axis.forget_requests()
            self._ask(axis, canopen_frames.OUTPUTS_DOWNLOAD + word)
        self._await_answers(asked)

    def _await_answers(self, asked: Sequence[Cia402Axis]) -> None:
        """Wait until the drives have answered all SDO requests, at most for `sdo_timeout`."""
        deadline = self._clock() + self._drives.sdo_timeout
        while any(axis.unanswered for axis in asked) and (left := deadline - self._clock()) > 0:
            self._wire.wait(left, self._clock)

    def prepare_tables(self) -> bool:
        """Return True if all drives are in their target states and nothing is pending; see driver.cyclic."""
        if math.isnan(self._times.beat_due) or not (self._wire.is_healthy and self._homing.idle):
            return False
        if self._period == 0.0 or self._stopped_in_this_cycle:
            return False
        for axis in self._axes:
            wanted = _target_of(axis, self._wanted)
            # A drive without power that misses PDOs is sent commands again, also by SDO.
            axis.missed_limit = self._drives.missed_positions if wanted is PowerState.OPERATION_ENABLED else 1
            if not axis.is_steady(wanted):
                return False
        by_sdo = [axis for axis in self._axes if axis.has_outputs and not axis.maps_outputs]
        if any(outputs_pending(axis) or axis.unanswered for axis in by_sdo):  # a lost request is sent again
            return False
        states = [(axis.statusword, axis.inputs) for axis in self._axes]
        if states != self._expected_state:
            self._expected_state = states
            self.tables.expect([row for number, axis in enumerate(self._axes) for row in axis.expected_rows(number)])
        return True

    def send_on(self, first: int) -> None:
        """Send the setpoints in the tables one at a time, from drive `first` on, and then the changed outputs."""
        for number, axis in enumerate(self._axes[first:], first):
            axis.setpoints_lost += not self._wire.send(self.tables.setpoints.frame(number))
        self._send_outputs()

    def enable(self, alone: str | None = None) -> None:
        """Begin to power up all drives, or only the drive `alone`.

        The following calls of `write` complete the power-up, and the states in the feedback show its progress. This
        does nothing while a fault is latched or the drives are already enabled.
        """
        if self._wire.fault is not None or self._wanted is PowerState.OPERATION_ENABLED:
            return
        self._wanted = PowerState.OPERATION_ENABLED
        for axis in self._axes:
            axis.powered_up = axis.has_followed = False
            axis.mode.shown = axis.exchange.mode_shown
            axis.left_out = alone not in (None, axis.name)
        self._homing.restore()

    def home(self) -> None:
        """Begin to home the drives that have a homing method, one after the other; see cia402.homing.

        This does nothing unless all enabled drives have power and no fault is latched.
        """
        ready = (axis.left_out or axis.state is PowerState.OPERATION_ENABLED for axis in self._axes)
        if self._wire.fault is None and self._wants_power() and all(ready):
            self._homing.start()

    def stop_homing(self) -> None:
        """Halt the drive that is being homed; it then follows setpoints again, starting at its present position."""
        self._homing.stop()

    def disable(self) -> None:
        """Remove power from the drives, which must be at standstill.

        A drive that still has power after `stop_timeout` latches a fault with cause "timeout".
        """
        self._power_off(PowerState.SWITCH_ON_DISABLED, "disable")
        if self._leaves_room(len(self._axes)):
            self._command()

    def quick_stop(self) -> None:
        """Begin the quick-stop ramp of every drive in this cycle. Each drive removes its power when its ramp ends.

        A drive that still has power after `stop_timeout` is sent "disable voltage", and a fault with cause "timeout"
        replaces the fault that caused the stop.
        """
        self._power_off(PowerState.QUICK_STOP_ACTIVE, "quick stop")
        self._stopped_in_this_cycle = True
        self._command()

    def reset(self) -> None:
        """Clear the latched fault and the faults of the drives, without powering up.

        A condition that persists latches a fault again.
        """
        self._wire.reset()
        now = self._clock()
        if self._wanted is not PowerState.OPERATION_ENABLED and self._times.off_deadline == math.inf:
            self._start_stop_timer("reset")
        for axis in self._axes:
            if axis.configured and axis.has_missed_start(self._period):
                axis.leave_operational()
            if axis.configured:
                axis.clear_faults(now)
        if self._leaves_room(len(self._axes) + sum(axis.register_wanted for axis in self._axes)):
            self._ask_for_registers()
            self._command()

    def _ask_for_registers(self) -> None:
        now = self._clock()
        for axis in self._axes:
            if axis.register_wanted and axis.accepts_request(now) and not self._is_being_configured(axis):
                axis.register_wanted = False
                self._ask(axis, canopen_frames.ERROR_REGISTER_UPLOAD)

    def _cut_power(self) -> None:
        # By PDO and by SDO: an operational node receives both, a pre-operational node only the SDO (CiA 301).
        for axis in self._axes:
            self._send_word(axis, canopen_frames.DISABLE_VOLTAGE)
            self._send_word_by_sdo(axis, canopen_frames.DISABLE_VOLTAGE)
        for axis in self._axes:
            self._wire.send(canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, axis.node))

    def _poll(self, now: float) -> None:
        """Request the values that no PDO contains by SDO, one request at a time for each drive, without waiting."""
        for axis in self._axes:
            if axis.sdo_asked is not None or self._is_being_configured(axis) or not axis.accepts_request(now):
                continue
            if axis.status_wanted or ((axis.exchange.polled or axis.awaits_mode) and now >= axis.poll_due):
                self._ask(axis, axis.request())
                axis.status_wanted = False
            elif axis.exchange.inputs_polled and now >= axis.inputs_due and axis.configured:
                self._ask(axis, canopen_frames.INPUTS_UPLOAD)

    def _command(self) -> None:
        """Send the controlwords that are due, one transition per drive at a time."""
        now = self._clock()
        for axis in self._axes:
            if self._is_being_configured(axis):
                continue
            wanted = _target_of(axis, self._next)
            word = axis.word(now, wanted)
            deaf = axis.may_miss_pdos and _target_of(axis, self._wanted) is not PowerState.OPERATION_ENABLED
            repeat = axis.command_age >= REPEAT_AFTER and (deaf or axis.is_not_followed(word, wanted))
            # PDOs are received only in NMT operational (CiA 301), so stop commands are sent by PDO and SDO. A new one
            # is sent by SDO immediately, also before an answer. Later, it takes turns with requests for the statusword.
            free = axis.accepts_request(now)
            urgent = deaf and word not in (axis.word_by_sdo, canopen_frames.FAULT_RESET)
            if not (word != axis.controlword or repeat or urgent):
                continue
            if urgent or (deaf and free and not axis.status_wanted and now >= axis.poll_due):
                self._send_word_by_sdo(axis, word)
            if self._send_word(axis, word):
                if word != axis.controlword and not deaf:
                    axis.word_by_sdo = None
                axis.word_repeats = axis.word_repeats + 1 if word == axis.controlword else 0
                axis.controlword = word
                axis.command_age = 0

    def _is_being_configured(self, axis: Cia402Axis) -> bool:
        return self._recovery is not None and self._recovery.is_configuring(axis)

    def _send_word(self, axis: Cia402Axis, word: int) -> bool:
        """Send a controlword by PDO. If the setpoint's PDO contains the controlword, send it with the last setpoint."""
        if axis.exchange.controlword is not None:
            return self._wire.send(Frame(axis.exchange.controlword, canopen_frames.CONTROLWORD.pack(word)))
        frame = axis.exchange.setpoints.frame()
        axis.exchange.setpoints.fill(frame, *axis.setpoint, word)
        return self._wire.send(frame)

    def _send_word_by_sdo(self, axis: Cia402Axis, word: int) -> None:
        """Send a controlword by SDO, which also works in NMT pre-operational."""
        data = canopen_frames.CONTROLWORD_DOWNLOAD + canopen_frames.CONTROLWORD.pack(word) + bytes(2)
        if self._ask(axis, data):
            axis.word_by_sdo, axis.poll_due = word, self._clock() + canopen_frames.POLL_PERIOD
            # The statusword of other drives comes by PDO.
            axis.status_wanted = axis.status_wanted or axis.left_operational or axis.exchange.polled

    def _ask(self, axis: Cia402Axis, request: bytes) -> bool:
        """Send an SDO request; return whether the bus accepted it.

        A node in NMT stopped, in which it receives no SDO, is first switched to pre-operational.
        """
        if axis.stopped:
            self._wire.send(canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, axis.node))
        sent = self._wire.send(Frame(canopen_frames.SDO_REQUEST + axis.node, request))
        if sent:
            axis.note_request(self._clock(), request)
        return sent

    @property
    def _next(self) -> canopen_frames.TargetState:
        """State to command now. No drive gets power while one of the drives might not follow setpoints."""
        return PowerState.QUICK_STOP_ACTIVE if self._homing.restoring else self._wanted

    def _power_off(self, wanted: canopen_frames.TargetState, reason: str) -> None:
        if self._wanted is not wanted:
            self._start_stop_timer(reason)
        self._wanted = wanted
        self._homing.abandon()

    def _abandon_stop(self) -> None:
        self._wanted = PowerState.SWITCH_ON_DISABLED

    def _wants_power(self) -> bool:
        return self._wanted is PowerState.OPERATION_ENABLED

    def _continue_stop(self) -> None:
        self._command()
        self._poll(self._clock())

    @staticmethod
    def _describe_protection(protection: str) -> str:
        return describe_protection(protection)

    @staticmethod
    def _has_power(axis: Cia402Axis) -> bool:
        return axis.state in HAS_POWER


def _target_of(axis: Cia402Axis, wanted: canopen_frames.TargetState) -> canopen_frames.TargetState:
    """Return the target state of one drive, given the target state `wanted` of all drives.

    A drive that is left out gets no power.
    """
    left_off = axis.left_out and wanted is PowerState.OPERATION_ENABLED
    return PowerState.SWITCH_ON_DISABLED if left_off else wanted
