"""Three CiA 402 drives on CANopen that follow positions, and homing: trirail_drivers.interface.DriveGroup.

The identifiers give the priorities on the bus: SYNC, emergencies, statuswords, controlwords, positions,
setpoints, heartbeats. So the controlword of a quick stop goes before setpoints that still wait.
"""

from __future__ import annotations

import math
import struct
import time

import can

from trirail_drivers import config
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.packed_frames import packed_frames
from trirail_drivers.cia402 import canopen_frames, process_data, setup
from trirail_drivers.cia402.axis import Cia402Axis
from trirail_drivers.cia402.homing import HomingSequence
from trirail_drivers.cia402.objects import means
from trirail_drivers.cia402.one_drive import HAS_POWER
from trirail_drivers.cia402.other_masters import OtherMasters
from trirail_drivers.driver.axis_row import NOWHERE
from trirail_drivers.driver.cyclic import Cyclic
from trirail_drivers.driver.driver import Driver
from trirail_drivers.interface import Clock, Feedback, PowerState, Triple

REPEAT_AFTER = 3
"""A controlword that a drive does not follow is sent again after so many SYNCs: the frame may be lost."""


class Cia402(Driver[Cia402Axis]):
    """Three CiA 402 drives on one CAN bus."""

    def __init__(self, bus: can.BusABC, bitrate: int, drives: config.Drives, clock: Clock = time.monotonic) -> None:
        super().__init__(bus, bitrate, drives, clock, Cia402Axis)
        self._other_masters = OtherMasters(self._wire, self._axes, drives.master_node)
        for axis in self._axes:
            self._listen(axis)
        self._homing = HomingSequence(self._axes, drives, self._wire.send)
        self._sync = Frame(canopen_frames.SYNC)
        self._beats = [
            Frame(
                canopen_frames.HEARTBEAT + drives.master_node, canopen_frames.NMT_STATE.pack(canopen_frames.OPERATIONAL)
            )
        ]
        self._setpoints = tuple(axis.way.setpoints.frame() for axis in self._axes)
        self._heartbeat_due: float | None = None
        self._wanted: canopen_frames.Wanted = PowerState.SWITCH_ON_DISABLED
        self._stopped_in_this_cycle = False
        self._lent_with: list[tuple[int, int]] = []
        """The controlwords and statuswords that the tables are made for."""

    def configure(self, period: float, fastest: float | None = None) -> None:
        """Set the drives up for a cycle of `period` seconds, read every value back, start them without power.

        Raises DriveError: BusError if the cycle does not fit on the bus, DriveTimeout, ConfigurationRefused; of a drive
        that takes velocities in a unit that cannot say the sliders' limit `fastest` [m/s], where that is given.
        A drive in fault is not an error here; feedback tells of it and `reset` clears it.
        """
        self._set_period(period, canopen_frames.TRAFFIC)
        scales = tuple(axis.scale for axis in self._axes)
        done = setup.configure(self._wire.bus, self._drives, scales, period, self._clock, fastest)
        self._set_period(period, process_data.traffic(made.way for made, _ in done))
        for axis, (made, start) in zip(self._axes, done, strict=True):
            axis.set_up(made.way, made.units)
            axis.mode.shown = made.way.mode_shown
            self._listen(axis)
            axis.take_position(start.counts)
            axis.error_code = start.error_code
            axis.take_status(start.statusword)
        self._setpoints = tuple(axis.way.setpoints.frame() for axis in self._axes)
        guarded = (axis.node for axis in self._axes if axis.way.guarded)
        self._beats += [Frame(canopen_frames.HEARTBEAT + node, b"\0", remote=True) for node in guarded]
        self._warn_of_setup([made for made, _ in done], means)

    def _listen(self, axis: Cia402Axis) -> None:
        listen, way = self._wire.listen, axis.way
        listen(way.feedback.identifier, axis, axis.on_position)
        if way.status is not None:
            listen(way.status, axis, axis.on_status)
        listen(way.emergency, axis, axis.on_emergency)
        listen(canopen_frames.HEARTBEAT + axis.node, axis, axis.on_heartbeat)
        listen(canopen_frames.SDO_ANSWER + axis.node, axis, axis.on_sdo)
        self._other_masters.listen_to(axis)

    def sync(self) -> None:
        """Send SYNC: the drives take up the setpoints written since the last one and sample positions.

        What has arrived is taken in before: positions among it answer the SYNC before.
        """
        self._stopped_in_this_cycle = False
        self._wire.begin()
        now = self._synced = self._clock()
        self._wire.receive(now)
        if self._heartbeat_due is None:
            # The drives' watchdogs and ours begin with the first cycle, however long ago the set-up was.
            self._heartbeat_due = now
            for axis in self._axes:
                axis.status_heard = now
                axis.heard = now if axis.way.heard else math.inf
        self._begin(now, self._heartbeat_due)

    def _begin(self, now: float, heartbeat_due: float, sent: int = 0) -> None:
        """Send SYNC and, where they are due, the signs of life; somebody else has sent so many of these frames."""
        frames_due = [self._sync]
        if now >= heartbeat_due:
            self._heartbeat_due = now + self._drives.heartbeat
            frames_due += self._beats
        for frame in frames_due[sent:]:
            self._wire.send(frame)
        for axis in self._axes:
            axis.sync_sent()
            axis.command_age += 1

    def read(self) -> Feedback:
        """Take in every frame that has arrived."""
        now = self._clock()
        self._wire.receive(now)
        for axis in self._axes:
            mistaken = axis.cycle_over()
            axis.read_over()
            if mistaken is not None and self._wire.fault is mistaken:
                self._wire.fault = axis.event
            fault = axis.fault(now, _asked_of(axis, self._wanted)) if self._wire.fault is None else None
            if fault is not None:
                self._wire.fail(fault)
        self._watch_stopping(now)
        if self._wire.fault is None:
            fault = self._homing.step(now)
            if fault is not None:
                self._wire.fail(fault)
        for axis in self._axes:
            self._poll_by_sdo(axis, now)
        return self._feedback()

    def _feedback(self) -> Feedback:
        a, b, c = self._axes
        return Feedback(
            (a.position, b.position, c.position),
            (a.shown_state, b.shown_state, c.shown_state),
            self._wire.fault,
            (a.counts, b.counts, c.counts),
            self._wire.warnings(),
            (a.age, b.age, c.age),
            self._homing.under_way,
            (a.follows, b.follows, c.follows),
            (a.homed, b.homed, c.homed),
        )

    def write(self, position: Triple, velocity: Triple) -> None:
        """Send setpoints [m] and velocity feed-forward [m/s], to be taken up at the next SYNC.

        Setpoints that are not finite or beyond 32-bit counts are not sent but a fault, of cause "setpoint".
        Powering up goes on here, after the setpoints: no drive gets power without one.
        """
        if self._stopped_in_this_cycle:
            return
        late = self._clock() - self._synced > self._period
        if self._wanted is not PowerState.OPERATION_ENABLED:
            self._command()  # where frames have to wait, those that stop go before setpoints
        for axis, frame, metres, rate in zip(self._axes, self._setpoints, position, velocity, strict=True):
            try:
                if axis.holds is not None:
                    setpoint = axis.holds, 0
                else:
                    offset = axis.units.velocity(rate) if axis.way.setpoints.has_velocity else 0
                    setpoint = axis.scale.counts(metres), offset
                axis.way.setpoints.fill(frame, *setpoint, axis.controlword)
            except (ValueError, OverflowError, struct.error):
                self._refuse_setpoint(axis, metres, rate)
                return
            axis.aim(*setpoint)
        for axis, frame in zip(self._axes, self._setpoints, strict=True):
            if not self._wire.send(frame):
                axis.setpoints_lost += 1
            elif late:
                axis.setpoints_late += 1
        self._command()

    def lend(self) -> Cyclic | None:
        """The tables of a cycle, where every drive rests in what it was asked for and nothing else is to be done."""
        due = self._heartbeat_due
        if due is None or not (self._wire.calm and self._homing.idle) or self._period == 0.0:
            return None
        if self._stopped_in_this_cycle or not all(axis.rests(_asked_of(axis, self._wanted)) for axis in self._axes):
            return None
        lent, beats = self._tables, len(self._beats)
        if not len(lent.end):
            lent.begin, lent.beats, lent.setpoints = map(packed_frames, ([self._sync], self._beats, self._setpoints))
            lent.end = lent.setpoints.headers
        lent.times[0] = self._off_by, due, self._drives.heartbeat, beats, 0, NOWHERE, lent.times[0]["traffic"]
        words = [(axis.controlword, axis.statusword) for axis in self._axes]
        if words != self._lent_with:
            self._lent_with = words
            for axis, frame in zip(self._axes, self._setpoints, strict=True):
                axis.way.setpoints.fill(frame, *axis.setpoint, axis.controlword)
            lent.setpoints.fill(self._setpoints)
            lent.expect([row for number, axis in enumerate(self._axes) for row in axis.expected(number)])
        return lent

    def take_back(self, arrived: int, *, synced: float | None = None, error: int = 0) -> Feedback:
        """Go on from what the tables hold: see trirail_drivers.driver.cyclic.Lender."""
        times = self._tables.times[0]
        self._heartbeat_due = float(times["beat_due"])
        self._wire.hand_in(self._tables.arrived, arrived, error)
        feedback = self._feedback()
        if synced is not None:
            self._synced = synced
            if times["begun"] != NOWHERE:
                self._begin(synced, self._heartbeat_due, int(times["begun"]))
        return feedback

    def send_on(self, first: int) -> None:
        """Send the setpoints in the tables that the bus has not taken, one at a time."""
        for axis, packed in zip(self._axes[first:], self._tables.setpoints.frames[first:], strict=True):
            axis.setpoints_lost += not self._wire.send(Frame.of(packed.tobytes()))

    def enable(self, alone: str | None = None) -> None:
        """Begin to power up, all drives or one `alone`; the following writes carry it out, the states tell when.

        Does nothing while a fault is latched, or while drives are to have power.
        """
        if self._wire.fault is not None or self._wanted is PowerState.OPERATION_ENABLED:
            return
        self._wanted = PowerState.OPERATION_ENABLED
        self._off_by = math.inf
        for axis in self._axes:
            axis.powered_up = axis.has_followed = False
            axis.mode.shown = axis.way.mode_shown
            axis.left_out = alone not in (None, axis.name)
        self._homing.restore()

    def home(self) -> None:
        """Begin to home the drives that have a homing method, one after the other: see homing402.

        Does nothing unless all drives that were enabled have power and no fault is latched.
        """
        ready = (axis.left_out or axis.state is PowerState.OPERATION_ENABLED for axis in self._axes)
        if self._wire.fault is None and self._wants_power() and all(ready):
            self._homing.start()

    def stop_homing(self) -> None:
        """Halt the drive that is being homed; in the end it follows setpoints again, where it stands."""
        self._homing.stop()

    def disable(self) -> None:
        """Take power off; meant for a robot at standstill. A drive that keeps it is a fault, of cause "timeout"."""
        self._power_off(PowerState.SWITCH_ON_DISABLED, "disable")
        self._command()

    def quick_stop(self) -> None:
        """Make every drive stop by its own quick-stop ramp, in this cycle, and end without power.

        A drive that has it after `stop_timeout` is told to lose it at once, and is a fault, of cause "timeout", that
        takes the place of the one that stopped it.
        """
        self._power_off(PowerState.QUICK_STOP_ACTIVE, "quick stop")
        self._stopped_in_this_cycle = True
        self._command()

    def reset(self) -> None:
        """Forget the fault and clear the drives' own; never powers them up. What persists is found again."""
        self._wire.reset()
        now = self._clock()
        if self._wanted is not PowerState.OPERATION_ENABLED:
            self._give_time_to_stop("reset")
        for axis in self._axes:
            if axis.left_operational:  # its set-up is still there: only a restarted drive needs a new one
                self._wire.send(canopen_frames.nmt(canopen_frames.NMT_START, axis.node))
            axis.forgive(now)
            if axis.register_wanted:
                axis.register_wanted = False
                self._wire.send(Frame(canopen_frames.SDO_REQUEST + axis.node, canopen_frames.ERROR_REGISTER_UPLOAD))
        self._command()

    def _leave(self) -> None:
        for axis in self._axes:
            self._send_word(axis, canopen_frames.DISABLE_VOLTAGE)
            self._send_word_by_sdo(axis, canopen_frames.DISABLE_VOLTAGE)
        for axis in self._axes:
            self._wire.send(canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, axis.node))

    def _poll_by_sdo(self, axis: Cia402Axis, now: float) -> None:
        """Ask for what no PDO tells, without waiting: one request at a time."""
        if axis.sdo_asked is not None:
            return
        if axis.mute or ((axis.way.polled or axis.awaits_mode) and now >= axis.poll_due):
            self._wire.send(Frame(canopen_frames.SDO_REQUEST + axis.node, axis.request()))
            axis.mute = False
            axis.poll_due = now + canopen_frames.POLL_PERIOD

    def _command(self) -> None:
        """Send the controlwords that are due: one transition per drive at a time."""
        now = self._clock()
        for axis in self._axes:
            wanted = _asked_of(axis, self._next)
            word = axis.word(now, wanted)
            deaf = axis.may_be_deaf and _asked_of(axis, self._wanted) is not PowerState.OPERATION_ENABLED
            repeat = axis.command_age >= REPEAT_AFTER and (deaf or axis.is_not_followed(word, wanted))
            if not (word != axis.controlword or repeat):
                continue
            if deaf:
                # PDOs are heard in NMT operational only (CiA 301): what stops it goes both process_data.
                self._send_word_by_sdo(axis, word)
            if self._send_word(axis, word):
                axis.controlword = word
                axis.command_age = 0

    def _send_word(self, axis: Cia402Axis, word: int) -> bool:
        """Send a controlword by PDO; where it goes with the setpoint, with the last one or with where the drive is."""
        if axis.way.controlword is not None:
            return self._wire.send(Frame(axis.way.controlword, canopen_frames.CONTROLWORD.pack(word)))
        frame = axis.way.setpoints.frame()
        axis.way.setpoints.fill(frame, *axis.setpoint, word)
        return self._wire.send(frame)

    def _send_word_by_sdo(self, axis: Cia402Axis, word: int) -> None:
        """Send a controlword by SDO, which is heard in pre-operational too; a stopped node is first brought there."""
        if axis.stopped:
            self._wire.send(canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, axis.node))
        data = canopen_frames.CONTROLWORD_DOWNLOAD + canopen_frames.CONTROLWORD.pack(word) + bytes(2)
        self._wire.send(Frame(canopen_frames.SDO_REQUEST + axis.node, data))

    @property
    def _next(self) -> canopen_frames.Wanted:
        """What drives are asked for now: none gets power while one of them may not follow setpoints."""
        return PowerState.QUICK_STOP_ACTIVE if self._homing.restoring else self._wanted

    def _power_off(self, wanted: canopen_frames.Wanted, asked: str) -> None:
        if self._wanted is not wanted:
            self._give_time_to_stop(asked)
        self._wanted = wanted
        self._homing.abandon()

    def _give_up_stopping(self) -> None:
        self._wanted = PowerState.SWITCH_ON_DISABLED

    def _wants_power(self) -> bool:
        return self._wanted is PowerState.OPERATION_ENABLED

    def _wait_for_standstill(self, deadline: float) -> None:
        while self._powered() and (left := deadline - self._clock()) > 0:
            self._wire.wait(left, self._clock)

    def _powered(self) -> bool:
        return any(axis.state in HAS_POWER for axis in self._axes)


def _asked_of(axis: Cia402Axis, wanted: canopen_frames.Wanted) -> canopen_frames.Wanted:
    """What a drive is asked for where the drives are `wanted` in a state: one that is left out gets no power."""
    left_off = axis.left_out and wanted is PowerState.OPERATION_ENABLED
    return PowerState.SWITCH_ON_DISABLED if left_off else wanted
