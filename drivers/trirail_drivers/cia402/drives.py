"""Three CiA 402 drives on CANopen in cyclic synchronous position mode, and homing: trirail_drivers.interface.Drives.

The identifiers give the priorities on the bus: SYNC, emergencies, statuswords, controlwords, positions,
setpoints, heartbeats. So the controlword of a quick stop goes before setpoints that still wait.
"""

from __future__ import annotations

import contextlib
import math
import struct
import time
from collections.abc import Callable

import can

from trirail_drivers import config, load
from trirail_drivers.cia402 import frames, setup
from trirail_drivers.cia402.axis import Axis
from trirail_drivers.cia402.homing import Homing
from trirail_drivers.frames import data_frame
from trirail_drivers.interface import NAMES, DriveFault, Feedback, PowerState, Triple
from trirail_drivers.scaling import scale_of
from trirail_drivers.wire import Wire

REPEAT_AFTER = 3
"""A controlword that a drive does not follow is sent again after so many SYNCs: the frame may be lost."""

_ON_THE_WAY = (PowerState.SWITCH_ON_DISABLED, PowerState.READY_TO_SWITCH_ON, PowerState.SWITCHED_ON)
"""States from which a drive that is to be enabled goes on by controlwords."""
_CAN_MOVE_OR_SOON = (PowerState.READY_TO_SWITCH_ON, PowerState.SWITCHED_ON, PowerState.OPERATION_ENABLED)
"""States in which no drive stays that has been told to stop or to lose power."""

Clock = Callable[[], float]


class Cia402:
    """Three drives on one CAN bus; see trirail_drivers.interface.Drives.

    A fault of one drive is a fault of the robot: what is latched takes all three down their quick-stop ramps
    in the same cycle, and `enable` does nothing until `reset`.
    """

    def __init__(
        self,
        bus: can.BusABC,
        bitrate: int,
        drives: config.Drives,
        clock: Clock = time.monotonic,
    ) -> None:
        self.bus_load = 0.0
        self._wire = Wire(bus, self._stop)
        self._bitrate = bitrate
        self._drives = drives
        self._clock = clock
        self._axes = tuple(
            Axis(name, drive.node, scale_of(name, drive), drives.heartbeat)
            for name, drive in zip(NAMES, drives.each, strict=True)
        )
        for axis in self._axes:
            self._wire.listen(frames.TPDO1 + axis.node, axis, axis.on_status)
            self._wire.listen(frames.TPDO2 + axis.node, axis, axis.on_position)
            self._wire.listen(frames.EMCY + axis.node, axis, axis.on_emergency)
            self._wire.listen(frames.HEARTBEAT + axis.node, axis, axis.on_heartbeat)
            self._wire.listen(frames.SDO_ANSWER + axis.node, axis, axis.on_sdo)
        self._homing = Homing(self._axes, drives, self._wire.send)
        self._sync = data_frame(frames.SYNC, b"")
        self._heartbeat = data_frame(frames.HEARTBEAT + drives.master_node, frames.NMT_STATE.pack(frames.OPERATIONAL))
        self._heartbeat_due: float | None = None
        self._wanted: frames.Wanted = PowerState.SWITCH_ON_DISABLED
        self._off_by = math.inf
        """When the drives must have lost their power [s]; inf where that was not asked for, or has been told of."""
        self._asked = ""
        """By what that was asked for."""
        self._stopped_in_this_cycle = False
        self._period = 0.0
        self._synced = 0.0
        self._closed = False

    @property
    def traffic(self) -> int:
        """Bits of all frames on the bus since the start, each with worst-case stuffing."""
        return self._wire.traffic

    def configure(self, period: float) -> None:
        """Set the drives up for a cycle of `period` seconds, read every value back, start them without power.

        Raises DriveError: BusError if the cycle does not fit on the bus, DriveTimeout, ConfigurationRefused.
        A drive in fault is not an error here; feedback tells of it and `reset` clears it.
        """
        rate = 1.0 / period
        self.bus_load = frames.TRAFFIC.checked(rate, self._bitrate, self._drives.heartbeat)
        scales = tuple(axis.scale for axis in self._axes)
        starts = setup.configure(self._wire.bus, self._drives, scales, period, self._clock)
        for axis, start in zip(self._axes, starts, strict=True):
            axis.take_position(start.counts)
            axis.error_code = start.error_code
            axis.take_status(start.statusword)
        if warning := load.warning(rate, self.bus_load):
            self._wire.warn(warning)
        self._period = period

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
                self._wire.send(data_frame(frames.SDO_REQUEST + axis.node, frames.STATUSWORD_UPLOAD))
            fault = axis.fault(now, self._wanted) if self._wire.fault is None else None
            if fault is not None:
                self._wire.fail(fault)
        if now >= self._off_by:
            self._take_power_off()
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
        messages = []
        for axis, metres, rate in zip(self._axes, position, velocity, strict=True):
            try:
                if axis.held is None:
                    data = frames.SETPOINT.pack(axis.scale.counts(metres), axis.scale.counts_per_second(rate))
                else:
                    data = frames.SETPOINT.pack(axis.held, 0)
            except (ValueError, OverflowError, struct.error):
                text = f"drive {axis.name}: cannot take setpoint {metres:g} m, {rate:g} m/s"
                self._wire.fail(DriveFault(axis.name, "setpoint", 0, text))
                return
            messages.append(data_frame(frames.RPDO2 + axis.node, data))
        for axis, message in zip(self._axes, messages, strict=True):
            if not self._wire.send(message):
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

    def close(self) -> None:
        """Leave the drives without power and not operational, and let go of the bus.

        Drives that still have power are first given time to stop by their ramps.
        """
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(can.CanError, OSError):
            self._wait_for_standstill()
        off = frames.CONTROLWORD.pack(frames.DISABLE_VOLTAGE)
        for axis in self._axes:
            self._wire.send(data_frame(frames.RPDO1 + axis.node, off))
            # PDOs are heard in NMT operational only, SDOs in pre-operational too: two bytes for object 6040h.
            self._wire.send(data_frame(frames.SDO_REQUEST + axis.node, b"\x2b\x40\x60\x00" + off + b"\x00\x00"))
        for axis in self._axes:
            self._wire.send(frames.nmt(frames.NMT_PRE_OPERATIONAL, axis.node))
        with contextlib.suppress(can.CanError, OSError):
            self._wire.bus.shutdown()

    def _command(self) -> None:
        """Send the controlwords that are due: one transition per drive at a time."""
        now = self._clock()
        for axis in self._axes:
            word = self._word(axis, now)
            repeat = axis.command_age >= REPEAT_AFTER and self._is_not_followed(axis, word)
            if (word != axis.controlword or repeat) and self._wire.send(
                data_frame(frames.RPDO1 + axis.node, frames.CONTROLWORD.pack(word))
            ):
                axis.controlword = word
                axis.command_age = 0

    def _word(self, axis: Axis, now: float) -> int:
        """The controlword that a drive is to have now."""
        if axis.state is PowerState.FAULT and now < axis.reset_until:
            # Bit 7 stays up until the drive is out of fault: some look at it once in a few cycles only.
            return frames.FAULT_RESET
        word = frames.controlword(axis.state, self._next)
        return word | axis.mode_bits if word == frames.ENABLE_OPERATION else word

    def _is_not_followed(self, axis: Axis, word: int) -> bool:
        """Whether a controlword, by what the drive says, has not taken it where it is to go."""
        if self._next is PowerState.OPERATION_ENABLED:
            return axis.state in _ON_THE_WAY or not axis.cyclic  # of its mode's bits the state does not tell
        if axis.state is PowerState.QUICK_STOP_ACTIVE:
            return word == frames.DISABLE_VOLTAGE
        return axis.state in _CAN_MOVE_OR_SOON

    @property
    def _next(self) -> frames.Wanted:
        """What drives are asked for now: none gets power while one of them may not follow setpoints."""
        return PowerState.QUICK_STOP_ACTIVE if self._homing.restoring else self._wanted

    def _power_off(self, wanted: frames.Wanted, asked: str) -> None:
        if self._wanted is not wanted:
            self._give_time_to_stop(asked)
        self._wanted = wanted
        self._homing.abandon()

    def _give_time_to_stop(self, asked: str) -> None:
        self._off_by, self._asked = self._clock() + self._drives.stop_timeout, asked

    def _take_power_off(self) -> None:
        """Tell of a drive that has not stopped in time, once; its brake is what remains."""
        self._off_by = math.inf
        self._wanted = PowerState.SWITCH_ON_DISABLED
        for axis in self._axes:
            fault = axis.late_for(self._asked, self._drives.stop_timeout)
            if fault is not None:
                self._wire.fault = fault
                return

    def _stop(self) -> None:
        """Drives that have power, or are getting it, are stopped with the first fault."""
        if self._wanted is PowerState.OPERATION_ENABLED:
            self.quick_stop()

    def _wait_for_standstill(self) -> None:
        if not self._powered():
            return
        self.quick_stop()
        deadline = self._clock() + self._drives.stop_timeout
        while self._powered() and (left := deadline - self._clock()) > 0:
            message = self._wire.bus.recv(left)
            if message is None:
                return
            self._wire.take(message, self._clock())

    def _powered(self) -> bool:
        return any(axis.state in setup.HAS_POWER for axis in self._axes)
