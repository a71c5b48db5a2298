"""What is kept of any drive, whatever it speaks: its newest feedback and what is wrong with it."""

from __future__ import annotations

import math
from typing import Self

import numpy as np
from numpy.typing import NDArray

from trirail_drivers.config import Drives
from trirail_drivers.driver.answers import Answers
from trirail_drivers.driver.axis_row import AXIS
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import shortened
from trirail_drivers.interface import Counts, DriveFault

MISSED_HEARTBEATS = 3


class Axis(Answers):
    """One drive's name, node, numbers and first event since faults were last reset."""

    def __init__(self, name: str, node: int, scale: Scale, drives: Drives) -> None:
        super().__init__()
        self.name = name
        self.node = node
        self.scale = scale
        self.position = math.nan
        self.setpoints_late = self.setpoints_lost = 0
        """Setpoints written after the next cycle was due, and those that the bus did not take."""
        self.left_out = False
        """It stays without power where others are to have it."""
        self.powered_up = False
        """It has followed setpoints since that was asked for."""
        self.event: DriveFault | None = None
        """A fault that a frame told of, rather than a state that lasts."""
        self.heard = math.inf
        self.heard_within = MISSED_HEARTBEATS * drives.heartbeat
        self.status_within = self.follows_within = math.inf
        self.counts_per_metre, self.zero = scale.counts_per_metre, scale.offset
        self._missed_positions = drives.missed_positions

    @classmethod
    def placed(cls, rows: NDArray[np.void], number: int, name: str, node: int, scale: Scale, drives: Drives) -> Self:
        """Return the drive whose numbers are in a row of AXIS."""
        axis = cls.from_buffer(rows.data, number * AXIS.itemsize)
        axis.__init__(name, node, scale, drives)  # type: ignore[misc]
        return axis

    @property
    def counts(self) -> Counts:
        """What of its cyclic traffic went wrong."""
        return Counts(self.late, self.lost, self.setpoints_late, self.setpoints_lost)

    def note_fault(self, cause: str, code: int, text: str) -> None:
        """Keep the first event since faults were last reset."""
        if self.event is None:
            self.event = self.made(cause, code, text)

    def made(self, cause: str, code: int, text: str) -> DriveFault:
        """A fault of this drive."""
        return DriveFault(self.name, cause, code, shortened(f"drive {self.name}: {text}"))

    def late_for(self, wanted: str, seconds: float) -> DriveFault | None:
        """What is wrong where `seconds` [s] after it was `wanted` to lose its power the drive has not."""
        raise NotImplementedError

    def silence(self, now: float) -> DriveFault | None:
        """The fault that the drive is not heard any more, at time `now`."""
        if (missed := self.missed) >= self._missed_positions:
            return self.made("silent", 0, f"no position for {missed} cycles in a row")
        if now - self.heard > self.heard_within:
            return self.made("heartbeat", 0, f"no heartbeat for {now - self.heard:.3g} s")
        return None
