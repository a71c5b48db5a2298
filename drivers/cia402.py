"""Three CiA 402 drives on CANopen in cyclic synchronous position mode: drivers.interface.Drives.

The identifiers give the priorities on the bus: SYNC, emergencies, statuswords, controlwords, positions,
setpoints, heartbeats. So the controlword of a quick stop goes before setpoints that still wait.
"""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Callable

import can

from drivers import config, frames, setup402
from drivers.axis402 import Axis
from drivers.errors import BusError
from drivers.interface import NAMES, DriveFault, Feedback, PowerState, Triple
from drivers.scaling import scale_of
from drivers.wire import Wire

STOPPING_TIME = 1.0
"""How long `close` waits for powered drives to come down their quick-stop ramp [s]."""

Clock = Callable[[], float]


class Cia402:
    """Three drives on one CAN bus; see drivers.interface.Drives.

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
        self._sync = frames.message(frames.SYNC, b"")
        self._heartbeat = frames.message(
            frames.HEARTBEAT + drives.master_node, frames.NMT_STATE.pack(frames.OPERATIONAL)
        )
        self._heartbeat_due: float | None = None
        self._wanted: frames.Wanted = PowerState.SWITCH_ON_DISABLED
        self._stopped_in_this_cycle = False
        self._closed = False

    def configure(self, period: float) -> None:
        """Set the drives up for a cycle of `period` seconds, read every value back, start them without power.

        Raises DriveError: BusError if the cycle does not fit on the bus, DriveTimeout, ConfigurationRefused.
        A drive in fault is not an error here; feedback tells of it and `reset` clears it.
        """
        rate = 1.0 / period
        load = frames.bus_load(rate, self._bitrate, self._drives.heartbeat)
        if load > 1.0:
            fits = max(0.0, frames.highest_rate(self._bitrate, self._drives.heartbeat))
            raise BusError(
                f"{rate:g} Hz takes {load:.0%} of the bus at {self._bitrate} bit/s; "
                f"the highest rate that fits is {fits:.0f} Hz"
            )
        scales = tuple(axis.scale for axis in self._axes)
        starts = setup402.configure(self._wire.bus, self._drives, scales, period, self._clock)
        for axis, start in zip(self._axes, starts, strict=True):
            axis.position = axis.scale.metres(start.counts)
            axis.error_code = start.error_code
            axis.take_status(start.statusword)
        self.bus_load = load

    def sync(self) -> None:
        """Send SYNC: the drives take up the setpoints written since the last one and sample positions."""
        self._wire.send(self._sync)
        now = self._clock()
        if self._heartbeat_due is None:
            # The drives' watchdogs and ours begin with the first cycle, however long ago the set-up was.
            self._heartbeat_due = now
            for axis in self._axes:
                axis.heard = now
        if now >= self._heartbeat_due:
            self._heartbeat_due = now + self._drives.heartbeat
            self._wire.send(self._heartbeat)
        self._stopped_in_this_cycle = False
        for axis in self._axes:
            axis.unanswered += 1

    def read(self) -> Feedback:
        """Take in every frame that has arrived."""
        now = self._clock()
        self._wire.receive(now)
        a, b, c = self._axes
        if self._wire.fault is None:
            for axis in self._axes:
                fault = axis.fault(now, self._wanted)
                if fault is not None:
                    self._wire.fail(fault)
                    break
        return Feedback((a.position, b.position, c.position), (a.state, b.state, c.state), self._wire.fault)

    def write(self, position: Triple, velocity: Triple) -> None:
        """Send setpoints [m] and velocity feed-forward [m/s], to be taken up at the next SYNC.

        Setpoints that are not finite or beyond 32-bit counts are not sent but a fault, of cause "setpoint".
        Powering up goes on here, after the setpoints: no drive gets power without one.
        """
        if self._stopped_in_this_cycle:
            return
        messages = []
        for axis, metres, rate in zip(self._axes, position, velocity, strict=True):
            try:
                data = frames.SETPOINT.pack(axis.scale.counts(metres), axis.scale.counts_per_second(rate))
            except (ValueError, OverflowError, struct.error):
                text = f"drive {axis.name}: cannot take setpoint {metres:g} m, {rate:g} m/s"
                self._wire.fail(DriveFault(axis.name, "setpoint", 0, text))
                return
            messages.append(frames.message(frames.RPDO2 + axis.node, data))
        for message in messages:
            self._wire.send(message)
        self._command()

    def enable(self) -> None:
        """Begin to power up; the following writes carry it out, the feedback's states tell when it is done.

        Does nothing while a fault is latched.
        """
        if self._wire.fault is not None or self._wanted is PowerState.OPERATION_ENABLED:
            return
        self._wanted = PowerState.OPERATION_ENABLED
        for axis in self._axes:
            axis.powered_up = False

    def disable(self) -> None:
        """Take power off; meant for a robot at standstill."""
        self._wanted = PowerState.SWITCH_ON_DISABLED
        self._command()

    def quick_stop(self) -> None:
        """Make every drive stop by its own quick-stop ramp, in this cycle, and end without power."""
        self._wanted = PowerState.QUICK_STOP_ACTIVE
        self._stopped_in_this_cycle = True
        self._command()

    def reset(self) -> None:
        """Forget the fault and clear the drives' own; never powers them up. What persists is found again."""
        self._wire.fault = None
        now = self._clock()
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
            self._wire.send(frames.message(frames.RPDO1 + axis.node, off))
            # PDOs are heard in NMT operational only, SDOs in pre-operational too: two bytes for object 6040h.
            self._wire.send(frames.message(frames.SDO_REQUEST + axis.node, b"\x2b\x40\x60\x00" + off + b"\x00\x00"))
        for axis in self._axes:
            self._wire.send(frames.nmt(frames.NMT_PRE_OPERATIONAL, axis.node))
        with contextlib.suppress(can.CanError, OSError):
            self._wire.bus.shutdown()

    def _command(self) -> None:
        """Send the controlwords that differ from the last ones: one transition per drive at a time."""
        for axis in self._axes:
            if axis.state is PowerState.FAULT and self._clock() < axis.reset_until:
                # Bit 7 stays up until the drive is out of fault: some look at it once in a few cycles only.
                word = frames.FAULT_RESET
            else:
                word = frames.controlword(axis.state, self._wanted)
            if word != axis.controlword and self._wire.send(
                frames.message(frames.RPDO1 + axis.node, frames.CONTROLWORD.pack(word))
            ):
                axis.controlword = word

    def _stop(self) -> None:
        """Drives that have power, or are getting it, are stopped with the first fault."""
        if self._wanted is PowerState.OPERATION_ENABLED:
            self.quick_stop()

    def _wait_for_standstill(self) -> None:
        if not self._powered():
            return
        self.quick_stop()
        deadline = self._clock() + STOPPING_TIME
        while self._powered() and (left := deadline - self._clock()) > 0:
            message = self._wire.bus.recv(left)
            if message is None:
                return
            self._wire.take(message, self._clock())

    def _powered(self) -> bool:
        return any(axis.state in setup402.POWERED for axis in self._axes)
