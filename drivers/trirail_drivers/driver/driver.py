"""Base class of the drivers for all protocols: bus, axes, bus load, time limit of a stop, closing."""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import can

from trirail_drivers import config
from trirail_drivers.bus import load
from trirail_drivers.bus.reopening import AbsentBus, Reopening
from trirail_drivers.bus.wire import Wire
from trirail_drivers.config import NO_IO, DigitalIo
from trirail_drivers.driver.axis import Axis
from trirail_drivers.driver.axis_row import NO_OFFSET
from trirail_drivers.driver.cyclic import FINISHED, Cyclic, UnfinishedCycle
from trirail_drivers.driver.recovery import AnyAxis, Recovery
from trirail_drivers.driver.refusals import SetUpDrive, merge_notes
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import BusError
from trirail_drivers.interface import (
    NAMES,
    Clock,
    Counts,
    DriveFault,
    Feedback,
    MissingProtection,
    Unready,
    UnreadyDrives,
)
from trirail_drivers.timing import BusTiming

Result = TypeVar("Result")
MAX_STEPS_LEFT_OUT = 10
"""Maximum number of consecutive late cycles in which a recovery waits, so that drives also return to a slow machine."""


class Driver(ABC, Generic[AnyAxis]):
    """Three drives of one protocol on one CAN bus; see trirail_drivers.interface.DriveGroup.

    A fault of one drive is a fault of the robot: all three begin their quick-stop ramps in the cycle that latches it,
    and `enable` does nothing until `reset`.
    """

    def __init__(
        self,
        bus: can.BusABC,
        timing: BusTiming,
        drives: config.Drives,
        clock: Clock,
        axis: type[AnyAxis],
        history: int = 0,
        reopening: Reopening | None = None,
        io: Sequence[DigitalIo] = NO_IO,
    ) -> None:
        """`history` is the number of sent setpoints to keep, `reopening` reopens a lost bus, and `io` contains the
        digital outputs and inputs of each drive.
        """
        self.bus_load = 0.0
        self._wire = Wire(bus, timing, self._stop, reopening)
        self._timing = timing
        self._drives = drives
        self._clock = clock
        self.tables = Cyclic(self._wire.access, history, timing)
        self._times = self.tables.timing
        self._axes = tuple(
            axis.in_row(self.tables.axes, number, name, drive.node, scale_of(name, drive), drives)
            for number, (name, drive) in enumerate(zip(NAMES, drives.each, strict=True))
        )
        for each, digital in zip(self._axes, io, strict=True):
            each.assign_io(digital)
        self._recovery: Recovery[AnyAxis, Any, Any] | None = None
        self._steps_left_out = 0
        """Number of consecutive late cycles in which the recovery has not continued."""
        self._period = 0.0
        self.next_sync = math.inf
        self._synced = 0.0
        """Start of the cycle [s]."""
        self._stop_reason = ""
        """Command that set the deadline by which the drives must be without power."""
        self._closed = False

    def _warn_of_setup(self, made: Sequence[SetUpDrive]) -> None:
        """Emit a warning for every deviation that the set-ups report."""
        for line in merge_notes((each.name, each.notes) for each in made):
            self._wire.warn(line)

    @property
    def missing_protections(self) -> tuple[MissingProtection, ...]:
        """Protections that the configured drives lack."""
        made = self._recovery.setups if self._recovery is not None else ()
        return tuple(
            MissingProtection(each.name, name, self._describe_protection(name))
            for each in made
            for name in each.missing_protections
        )

    def _set_up(
        self, configure: Callable[[], Sequence[Result | None]], *, awaits: bool
    ) -> tuple[Sequence[Result | None], str]:
        """Configure the drives at the start.

        Return the set-up of each drive, or None for an absent drive, and the reason why the bus is lost, or "".
        """
        if isinstance(self._wire.bus, AbsentBus):
            return (None, None, None), self._wire.bus.reason
        try:
            return configure(), ""
        except BusError as error:
            if not (awaits and self._wire.reopens):
                raise
            return (None, None, None), str(error)

    def _report_absent(self, lost: str) -> None:
        """Latch a fault that states why the bus is lost or, if `lost` is empty, which drives did not answer at the
        start.
        """
        if lost:
            self._wire.lose(lost)
        elif away := [axis.name for axis in self._axes if axis.silent]:
            one, *more = away
            text = f"drives {', '.join(away)} do not answer" if more else f"drive {one} does not answer"
            self._wire.fail(DriveFault("" if more else one, "silent", 0, f"{text}; switch on the supply"))

    def _recover(self) -> None:
        """Continue the recovery of drives.

        It also continues while a reopened bus is on trial, since some drives send frames only in answer to requests.
        """
        if self._recovery is None:
            return
        # In a late cycle, a request would delay the next SYNC. The setpoints before it may still be in the queue.
        late = self._clock() + self._duration(len(self._axes) + 1) > self._synced + self._period
        if late and self._steps_left_out < MAX_STEPS_LEFT_OUT:
            self._steps_left_out += 1
            return
        self._steps_left_out = 0
        if self._wire.carries:
            self._recovery.step(self._synced, stopping=self._times.off_deadline != math.inf)
        else:
            self._recovery.abandon()

    @property
    def path_outputs(self) -> tuple[bool, bool, bool]:
        """Whether each drive applies its digital outputs together with a setpoint; only such outputs can be switched on
        a path.
        """
        a, b, c = self._axes
        return bool(a.maps_outputs), bool(b.maps_outputs), bool(c.maps_outputs)

    def set_outputs(self, words: Sequence[int]) -> None:
        """Set the wanted outputs as bits of 60FEh; the next `write` sends those that changed."""
        for axis, word in zip(self._axes, words, strict=True):
            axis.outputs = word & axis.io.outputs

    @property
    def traffic(self) -> int:
        """Duration of all frames sent and received since the start, with worst-case bit stuffing [ns]."""
        return self._wire.traffic + self._times.traffic

    @property
    def counts(self) -> tuple[Counts, Counts, Counts]:
        """Numbers of late and lost positions and setpoints of each drive."""
        a, b, c = self._axes
        return a.counts, b.counts, c.counts

    @property
    def reported_faults(self) -> tuple[DriveFault | None, ...]:
        """For each drive, the first fault that it has reported itself since the last reset, or None."""
        return tuple(axis.event for axis in self._axes)

    def continue_in_python(self, newest: UnfinishedCycle = FINISHED) -> Feedback:
        """Continue after compiled cycles; see trirail_drivers.driver.cyclic.CompiledDrives."""
        self._wire.put_back(self.tables.arrived, newest.handled, newest.arrived, newest.error)
        feedback, begun = self._feedback(), self._times.begun
        if newest.synced is not None:
            self._synced = newest.synced
        if begun != NO_OFFSET:
            self._times.begun = NO_OFFSET
            self._send_cycle_start(self._synced, begun)
        return feedback

    def send_on(self, first: int) -> None:
        """Send the setpoints in the tables again; by default do nothing, if the next `sync` sends the setpoints."""

    def close(self) -> None:
        """Remove power from the drives, and close the bus.

        Drives that have power first stop with their quick-stop ramps. An exception such as KeyboardInterrupt ends the
        ramps, but not the removal of the power.
        """
        if self._closed:
            return
        self._closed = True
        try:
            with contextlib.suppress(can.CanError, OSError):
                if self._powered():
                    self.quick_stop()
                    self._wait_for_standstill(self._clock() + self._drives.stop_timeout)
        finally:
            try:
                self._cut_power()
                with contextlib.suppress(can.CanError, OSError):
                    self._make_outputs_safe()
            finally:
                self._wire.close()

    @abstractmethod
    def sync(self) -> None:
        """Begin a cycle; see trirail_drivers.interface.DriveGroup."""

    @abstractmethod
    def _send_cycle_start(self, now: float, sent: int = 0) -> None:
        """Send the frames at the start of a cycle, except the first `sent` frames, which are already on the bus."""

    @abstractmethod
    def _feedback(self, warnings: tuple[str, ...] = ()) -> Feedback:
        """Return the present feedback."""

    @abstractmethod
    def quick_stop(self) -> None:
        """Begin the quick-stop ramp of every drive in this cycle."""

    @staticmethod
    @abstractmethod
    def _describe_protection(protection: str) -> str:
        """Return the purpose of a protection in words."""

    def _powered(self) -> bool:
        """Whether any drive has power, as far as is known."""
        return any(self._has_power(axis) for axis in self._axes)

    @staticmethod
    @abstractmethod
    def _has_power(axis: AnyAxis) -> bool:
        """Whether a drive has power, as far as is known."""

    @abstractmethod
    def _wants_power(self) -> bool:
        """Whether the drives are commanded to have power."""

    @abstractmethod
    def _continue_stop(self) -> None:
        """Send the commands that the stopping drives need at the end of a cycle."""

    def _wait_for_standstill(self, deadline: float) -> None:
        """Run cycles until the stopping drives have lost power, or until `deadline` [s].

        Drives may need the cycles for their ramps, and the heartbeats so that they do not report a lost service.
        """
        while self._powered() and (now := self._clock()) < deadline:
            self.sync()
            while (left := now + self._period - self._clock()) > 0.0:
                self._wire.wait(left, self._clock)
            self._continue_stop()

    def _make_outputs_safe(self) -> None:
        """Set the outputs to their safe values and wait for the answers, if the protocol has outputs."""

    @abstractmethod
    def _cut_power(self) -> None:
        """Send the frames that remove power from the drives in any state."""

    @abstractmethod
    def _abandon_stop(self) -> None:
        """Abandon the ramps of stopping drives; from now on, only remove their power."""

    def _set_period(self, period: float, traffic: load.Traffic) -> None:
        """Set the cycle period [s].

        Raises BusError if the cycle's frames do not fit on the bus; emits a warning if they leave little room.
        """
        rate = 1.0 / period
        self.bus_load = traffic.check_bus_load(rate, self._timing, self._drives.heartbeat)
        self._period = period
        if warning := load.warning(rate, self.bus_load):
            self._wire.warn(warning)

    def _duration(self, frames: int) -> float:
        """Return the longest time for which this number of frames is on the bus [s]."""
        return frames * self._timing.frame_ns(8) * 1e-9

    def _leaves_room(self, frames: int) -> bool:
        """Return True if this number of frames will not delay the next SYNC, as far as its time is known."""
        return self._clock() + self._duration(frames) <= self.next_sync

    def _begin_cycle(self, now: float) -> None:
        """Begin a cycle on the bus, and store the access to the bus in the tables, since the bus may be a new one."""
        self._wire.begin(now, stopping=self._times.off_deadline != math.inf)
        self.tables.bus[:] = self._wire.access
        self.next_sync = math.inf

    @property
    def _unready(self) -> UnreadyDrives:
        """For each drive, the reason why it cannot be reset yet; while the bus is lost, all drives have this reason."""
        if self._wire.down:
            lost = Unready(self._wire.down)
            return lost, lost, lost
        return self._recovery.unready if self._recovery is not None else (None, None, None)

    def _stop(self) -> None:
        """Stop the drives because of a fault, if they have power or are being powered up."""
        if self._wants_power():
            self.quick_stop()

    def _start_stop_timer(self, reason: str) -> None:
        self._times.off_deadline, self._stop_reason = self._clock() + self._drives.stop_timeout, reason

    def _check_stopped(self, now: float) -> None:
        """Latch a fault for the first drive that has power `stop_timeout` after it should have none. Only its brake can
        stop it. The time also runs for a drive that has got power without a command, and for one that is left out.
        """
        times, enabled = self._times, self._wants_power()
        off = [axis for axis in self._axes if axis.left_out or not enabled]
        unwanted = any(self._has_power(axis) for axis in off)
        if enabled and not unwanted:
            times.off_deadline = math.inf
        elif times.off_deadline == math.inf and unwanted and not self._power_reported:
            self._start_stop_timer("it got power by itself")
        if now < times.off_deadline:
            return
        times.off_deadline = math.inf
        if not enabled:
            self._abandon_stop()
        for axis in off:
            fault = axis.stop_overdue_fault(self._stop_reason, self._drives.stop_timeout)
            if fault is not None:
                self._wire.fault = fault
                self._stop()
                return

    @property
    def _power_reported(self) -> bool:
        """Whether the latched fault is that of a drive that has power although it should have none."""
        return self._wire.fault is not None and self._wire.fault.cause == "timeout"

    def _refuse_setpoint(self, axis: Axis, position: float, velocity: float) -> None:
        """Latch a fault for a setpoint [m], [m/s] that does not fit into a frame."""
        text = f"drive {axis.name}: cannot take setpoint {position * 1e3:g} mm, {velocity * 1e3:g} mm/s"
        self._wire.fail(DriveFault(axis.name, "setpoint", 0, text))
