"""What the drivers of all protocols share: bus, axes, the load of the bus, the time that a stop may take, closing."""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import can

from trirail_drivers import config
from trirail_drivers.bus import load
from trirail_drivers.bus.wire import Wire
from trirail_drivers.driver.axis import Axis
from trirail_drivers.driver.cyclic import Cyclic
from trirail_drivers.driver.refusals import SetUpDrive, lines_by_drive
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.interface import NAMES, Clock, DriveFault, MissingProtection

AnyAxis = TypeVar("AnyAxis", bound=Axis)


class Driver(ABC, Generic[AnyAxis]):
    """Three drives on one CAN bus, whatever they speak; see trirail_drivers.interface.DriveGroup.

    A fault of one drive is a fault of the robot: what is latched takes all three down their quick-stop ramps
    beginning in the same cycle, and `enable` does nothing until `reset`.
    """

    def __init__(
        self,
        bus: can.BusABC,
        bitrate: int,
        drives: config.Drives,
        clock: Clock,
        axis: type[AnyAxis],
        history: int = 0,
    ) -> None:
        """`history`: so many setpoints are kept of those that were sent."""
        self.bus_load = 0.0
        self.missing_protections: tuple[MissingProtection, ...] = ()
        self._wire = Wire(bus, self._stop)
        self._bitrate = bitrate
        self._drives = drives
        self._clock = clock
        self._tables = Cyclic(self._wire.access, history)
        self._axes = tuple(
            axis.placed(self._tables.axes, number, name, drive.node, scale_of(name, drive), drives)
            for number, (name, drive) in enumerate(zip(NAMES, drives.each, strict=True))
        )
        self._period = 0.0
        self._synced = 0.0
        """When the cycle began [s]."""
        self._off_by = math.inf
        """When the drives must have lost their power [s]; inf where that was not asked for, or has been told of."""
        self._asked = ""
        """By what that was asked for."""
        self._closed = False

    def _warn_of_setup(self, made: Sequence[SetUpDrive], means: Callable[[str], str]) -> None:
        """Warn of what is done otherwise, and keep which protections drives do without; `means` words one."""
        for line in lines_by_drive((each.name, each.notes) for each in made):
            self._wire.warn(line)
        self.missing_protections = tuple(
            MissingProtection(each.name, name, means(name)) for each in made for name in each.lacking
        )

    @property
    def traffic(self) -> int:
        """Bits of all frames sent and heard since the start, each with worst-case stuffing."""
        return self._wire.traffic + int(self._tables.times[0]["traffic"])

    @property
    def reported_faults(self) -> tuple[DriveFault | None, ...]:
        """Of each drive the first fault that it has told of by itself since the last reset, whichever came first."""
        return tuple(axis.event for axis in self._axes)

    def close(self) -> None:
        """Leave the drives without power, and let go of the bus.

        Drives that still have power are first brought to a standstill by their ramps.
        """
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(can.CanError, OSError):
            if self._powered():
                self.quick_stop()
                self._wait_for_standstill(self._clock() + self._drives.stop_timeout)
        self._leave()
        with contextlib.suppress(can.CanError, OSError):
            self._wire.bus.shutdown()

    @abstractmethod
    def quick_stop(self) -> None:
        """Make every drive stop by its quick-stop ramp, beginning in this cycle."""

    @abstractmethod
    def _powered(self) -> bool:
        """Whether a drive has power, as far as it is known."""

    @abstractmethod
    def _wants_power(self) -> bool:
        """Whether the drives have been asked to have power."""

    @abstractmethod
    def _wait_for_standstill(self, deadline: float) -> None:
        """Stay with the drives, which are stopping, until they have lost their power, or until `deadline` [s]."""

    @abstractmethod
    def _leave(self) -> None:
        """Send what leaves the drives without power, whatever they do."""

    @abstractmethod
    def _give_up_stopping(self) -> None:
        """From now on ask drives that were to stop for nothing but to lose their power."""

    def _set_period(self, period: float, traffic: load.Traffic) -> None:
        """Note the cycle's period [s]; BusError if it does not fit on the bus, a warning if it does so hardly."""
        rate = 1.0 / period
        self.bus_load = traffic.checked(rate, self._bitrate, self._drives.heartbeat)
        self._period = period
        if warning := load.warning(rate, self.bus_load):
            self._wire.warn(warning)

    def _stop(self) -> None:
        """Drives that have power, or are getting it, are stopped with the first fault."""
        if self._wants_power():
            self.quick_stop()

    def _give_time_to_stop(self, asked: str) -> None:
        self._off_by, self._asked = self._clock() + self._drives.stop_timeout, asked

    def _watch_stopping(self, now: float) -> None:
        """Tell of a drive that has not lost its power in time, once; its brake is what remains."""
        if now < self._off_by:
            return
        self._off_by = math.inf
        self._give_up_stopping()
        for axis in self._axes:
            fault = axis.late_for(self._asked, self._drives.stop_timeout)
            if fault is not None:
                self._wire.fault = fault
                return

    def _refuse_setpoint(self, axis: Axis, position: float, velocity: float) -> None:
        """A setpoint [m], [m/s] that no frame can hold is a fault."""
        text = f"drive {axis.name}: cannot take setpoint {position * 1e3:g} mm, {velocity * 1e3:g} mm/s"
        self._wire.fail(DriveFault(axis.name, "setpoint", 0, text))
