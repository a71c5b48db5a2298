"""Three CiA 402 drives on CANopen in cyclic synchronous position mode, and homing: trirail_drivers.interface.Drives.

The identifiers give the priorities on the bus: SYNC, emergencies, statuswords, controlwords, positions,
setpoints, heartbeats. So the controlword of a quick stop goes before setpoints that still wait.
"""

from __future__ import annotations

import math
import struct
import time

import can

from trirail_drivers import config
from trirail_drivers.cia402 import frames, setup
from trirail_drivers.cia402.axis import Axis
from trirail_drivers.cia402.homing import Homing
from trirail_drivers.driver import Clock, Driver
from trirail_drivers.frames import Frame
from trirail_drivers.interface import Feedback, PowerState, Triple

REPEAT_AFTER = 3
"""A controlword that a drive does not follow is sent again after so many SYNCs: the frame may be lost."""


class Cia402(Driver[Axis]):
    """Three CiA 402 drives on one CAN bus."""

    def __init__(self, bus: can.BusABC, bitrate: int, drives: config.Drives, clock: Clock = time.monotonic) -> None:
        super().__init__(bus, bitrate, drives, clock, Axis)
        for axis in self._axes:
            self._wire.listen(frames.TPDO1 + axis.node, axis, axis.on_status)
            self._wire.listen(frames.TPDO2 + axis.node, axis, axis.on_position)
            self._wire.listen(frames.EMCY + axis.node, axis, axis.on_emergency)
            self._wire.listen(frames.HEARTBEAT + axis.node, axis, axis.on_heartbeat)
            self._wire.listen(frames.SDO_ANSWER + axis.node, axis, axis.on_sdo)
        self._homing = Homing(self._axes, drives, self._wire.send)
        self._sync = Frame(frames.SYNC)
        self._heartbeat = Frame(frames.HEARTBEAT + drives.master_node, frames.NMT_STATE.pack(frames.OPERATIONAL))
        self._setpoints = tuple(Frame(frames.RPDO2 + axis.node, bytes(frames.SETPOINT.size)) for axis in self._axes)
        self._heartbeat_due: float | None = None
        self._wanted: frames.Wanted = PowerState.SWITCH_ON_DISABLED
        self._stopped_in_this_cycle = False

    def configure(self, period: float) -> None:
        """Set the drives up for a cycle of `period` seconds, read every value back, start them without power.

        Raises DriveError: BusError if the cycle does not fit on the bus, DriveTimeout, ConfigurationRefused.
        A drive in fault is not an error here; feedback tells of it and `reset` clears it.
        """
        self._set_period(period, frames.TRAFFIC)
        scales = tuple(axis.scale for axis in self._axes)
        starts = setup.configure(self._wire.bus, self._drives, scales, period, self._clock)
        for axis, start in zip(self._axes, starts, strict=True):
            axis.take_position(start.counts)
            axis.error_code = start.error_code
            axis.take_status(start.statusword)

    def sync(self) -> None:
        """Send SYNC: the drives take up the setpoints written since the last one and sample positions.

        What has arrived is taken in before: positions among it answer the SYNC before.
        """
        self._stopped_in_this_cycle = False
        self._wire.begin()
        now = self._synced = self._clock()
        self._wire.receive(now)
        self._wire.send(self._sync)
        if self._heartbeat_due is None:
            # The drives' watchdogs and ours begin with the first cycle, however long ago the set-up was.
            self._heartbeat_due = now
            for axis in self._axes:
                axis.heard = axis.status_heard = now
        if now >= self._heartbeat_due:
            self._heartbeat_due = now + self._drives.heartbeat
            self._wire.send(self._heartbeat)
        for axis in self._axes:
            axis.answers.sync_sent()
            axis.command_age += 1

    def read(self) -> Feedback:
        """Take in every frame that has arrived."""
        now = self._clock()
        self._wire.receive(now)
        a, b, c = self._axes
        for axis in self._axes:
            axis.answers.read_over()
            if axis.mute:
                axis.mute = False
                self._wire.send(Frame(frames.SDO_REQUEST + axis.node, frames.STATUSWORD_UPLOAD))
            fault = axis.fault(now, self._wanted) if self._wire.fault is None else None
            if fault is not None:
                self._wire.fail(fault)
        self._watch_stopping(now)
        if self._wire.fault is None:
            fault = self._homing.step(now)
            if fault is not None:
                self._wire.fail(fault)
        return Feedback(
            (a.position, b.position, c.position),
            (a.state, b.state, c.state),
            self._wire.fault,
            (a.counts, b.counts, c.counts),
            self._wire.warnings(),
            (a.answers.age, b.answers.age, c.answers.age),
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
                if axis.held is None:
                    frame.fill(frames.SETPOINT, axis.scale.counts(metres), axis.scale.counts_per_second(rate))
                else:
                    frame.fill(frames.SETPOINT, axis.held, 0)
            except (ValueError, OverflowError, struct.error):
                self._refuse_setpoint(axis, metres, rate)
                return
        for axis, frame in zip(self._axes, self._setpoints, strict=True):
            if not self._wire.send(frame):
                axis.setpoints_lost += 1
            elif late:
                axis.setpoints_late += 1
        self._command()

    def enable(self) -> None:
        """Begin to power up; the following writes carry it out, the feedback's states tell when it is done.

        Does nothing while a fault is latched.
        """
        if self._wire.fault is not None or self._wanted is PowerState.OPERATION_ENABLED:
            return
        self._wanted = PowerState.OPERATION_ENABLED
        self._off_by = math.inf
        for axis in self._axes:
            axis.powered_up = False
        self._homing.restore()

    def home(self) -> None:
        """Begin to home the drives that have a homing method, one after the other: see homing402.

        Does nothing unless all drives have power and no fault is latched.
        """
        if self._wire.fault is None and all(axis.state is PowerState.OPERATION_ENABLED for axis in self._axes):
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
                self._wire.send(frames.nmt(frames.NMT_START, axis.node))
            axis.forgive(now)
        self._command()

    def _leave(self) -> None:
        off = frames.CONTROLWORD.pack(frames.DISABLE_VOLTAGE)
        for axis in self._axes:
            self._wire.send(Frame(frames.RPDO1 + axis.node, off))
            # PDOs are heard in NMT operational only, SDOs in pre-operational too: two bytes for object 6040h.
            self._wire.send(Frame(frames.SDO_REQUEST + axis.node, b"\x2b\x40\x60\x00" + off + b"\x00\x00"))
        for axis in self._axes:
            self._wire.send(frames.nmt(frames.NMT_PRE_OPERATIONAL, axis.node))

    def _command(self) -> None:
        """Send the controlwords that are due: one transition per drive at a time."""
        now = self._clock()
        for axis in self._axes:
            word = axis.word(now, self._next)
            repeat = axis.command_age >= REPEAT_AFTER and axis.is_not_followed(word, self._next)
            if (word != axis.controlword or repeat) and self._wire.send(
                Frame(frames.RPDO1 + axis.node, frames.CONTROLWORD.pack(word))
            ):
                axis.controlword = word
                axis.command_age = 0

    @property
    def _next(self) -> frames.Wanted:
        """What drives are asked for now: none gets power while one of them may not follow setpoints."""
        return PowerState.QUICK_STOP_ACTIVE if self._homing.restoring else self._wanted

    def _power_off(self, wanted: frames.Wanted, asked: str) -> None:
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
        return any(axis.state in setup.HAS_POWER for axis in self._axes)
