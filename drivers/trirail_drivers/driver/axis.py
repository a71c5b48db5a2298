"""What is kept of any drive, whatever it speaks: its newest feedback and what is wrong with it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

from trirail_drivers.config import Drives
from trirail_drivers.driver.answers import Answers
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import shortened
from trirail_drivers.interface import Counts, DriveFault

MISSED_HEARTBEATS = 3


class Axis(ABC):
    """One drive's name, node, position and first event since faults were last reset."""

    __slots__ = (
        "_heartbeat_timeout",
        "_missed_positions",
        "answers",
        "event",
        "heard",
        "left_out",
        "name",
        "node",
        "position",
        "powered_up",
        "scale",
        "setpoints_late",
        "setpoints_lost",
    )

    def __init__(self, name: str, node: int, scale: Scale, drives: Drives) -> None:
        self.name = name
        self.node = node
        self.scale = scale
        self.position = math.nan
        """Actual position [m]."""
        self.answers = Answers()
        """The positions that have come, each in answer to the beginning of a cycle."""
        self.setpoints_late = self.setpoints_lost = 0
        """Setpoints written after the next cycle was due, and those that the bus did not take."""
        self.left_out = False
        """It stays without power where others are to have it."""
        self.powered_up = False
        """It has followed setpoints since that was asked for."""
        self.event: DriveFault | None = None
        """A fault that a frame told of, rather than a state that lasts."""
        self.heard = math.inf
        """Time of the last heartbeat [s]."""
        self._heartbeat_timeout = MISSED_HEARTBEATS * drives.heartbeat
        self._missed_positions = drives.missed_positions

    @property
    def counts(self) -> Counts:
        """What of its cyclic traffic went wrong."""
        return Counts(self.answers.late, self.answers.lost, self.setpoints_late, self.setpoints_lost)

    def tell(self, cause: str, code: int, text: str) -> None:
        """Keep the first event since faults were last reset."""
        if self.event is None:
            self.event = self.made(cause, code, text)

    def made(self, cause: str, code: int, text: str) -> DriveFault:
        """A fault of this drive."""
        return DriveFault(self.name, cause, code, shortened(f"drive {self.name}: {text}"))

    @abstractmethod
    def late_for(self, wanted: str, seconds: float) -> DriveFault | None:
        """What is wrong where `seconds` [s] after it was `wanted` to lose its power the drive has not."""

    def silence(self, now: float) -> DriveFault | None:
        """The fault that the drive is not heard any more, at time `now`."""
        if self.answers.missed >= self._missed_positions:
            return self.made("silent", 0, f"no position for {self.answers.missed} cycles in a row")
        if now - self.heard > self._heartbeat_timeout:
            return self.made("heartbeat", 0, f"no heartbeat for {now - self.heard:.3g} s")
        return None
