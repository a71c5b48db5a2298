"""State of one drive of any protocol: its feedback, its fault, and the SYNC that its newest position answers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from trirail_drivers.config import DigitalIo, Drives
from trirail_drivers.driver.axis_row import AXIS, NO_OFFSET, NOTHING_SENT, AxisRow
from trirail_drivers.driver.row_updates import accept_answer, answered_sync, unanswered
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import shortened
from trirail_drivers.interface import Counts, DriveFault


class Answers(AxisRow):
    """Assignment of the received positions to the SYNCs that they answer.

    A drive answers a SYNC within one cycle, so a position received before the next SYNC is sent answers the current
    SYNC. A position received just after a SYNC answers the current SYNC if the previous SYNC has been answered, or if
    the drive's last answer also arrived this early; otherwise it is a late answer to the previous SYNC.
    """

    @property
    def age(self) -> int:
        """Number of SYNCs sent since the SYNC at which the position was sampled."""
        return self.syncs - self.sampled

    @property
    def missed(self) -> int:
        """Number of unanswered SYNCs. The newest SYNC is not counted while its answer is not yet due."""
        return unanswered(self)

    def answer(self) -> None:
        """Assign a received position to the SYNC that it answers."""
        accept_answer(self, answered_sync(self))

    def clear_missed(self) -> None:
        """Forget the unanswered SYNCs."""
        self.sampled = self.syncs


MISSED_HEARTBEATS = 3
"""Number of missed heartbeats after which a drive counts as lost."""
SILENT_AFTER: Final = 0.15
"""Silence [s] after which a drive may have lost its supply, so that its set-up must be checked again."""


class Axis(Answers):
    """State of one drive, and its first event since the last reset."""

    def __init__(self, name: str, node: int, scale: Scale, drives: Drives) -> None:
        super().__init__()
        self.name = name
        self.node = node
        self.scale = scale
        self.position = math.nan
        self.setpoints_late = self.setpoints_lost = 0
        """Number of setpoints written after the next cycle was due, and number of setpoints that the bus refused."""
        self.left_out = False
        """Whether the drive stays without power while others are enabled."""
        self.powered_up = False
        """Whether the drive has followed setpoints since it was enabled."""
        self.event: DriveFault | None = None
        """First fault since the last reset that a single frame reported, unlike a fault state that persists."""
        self.restarted = self.silent = False
        """Whether the drive has restarted, or has been silent for long, since it was configured."""
        self.boots = 0
        """Number of observed restarts."""
        self.setup_listener: Callable[[int, bytes | bytearray], None] | None = None
        """Callback for the identifier and data of the drive's answers during a set-up in the background."""
        self.homed = True
        """Whether the drive's position is relative to a known place."""
        self.heard = math.inf
        self.heard_within = MISSED_HEARTBEATS * drives.heartbeat
        self.status_within = self.follows_within = self.far_apart = math.inf
        self.missed_limit = drives.missed_positions
        self.counts_per_metre, self.zero = scale.counts_per_metre, scale.offset
        self.controlword_at = NO_OFFSET
        self._missed_positions = drives.missed_positions
        self.io = DigitalIo()
        """Digital outputs and inputs that the robot uses."""

    def assign_io(self, io: DigitalIo) -> None:
        """Set the digital outputs and inputs that the robot uses; the outputs get their safe values."""
        self.io = io
        self.has_outputs, self.outputs, self.outputs_sent = bool(io.outputs), io.safe, NOTHING_SENT

    @classmethod
    def in_row(cls, rows: NDArray[np.void], number: int, name: str, node: int, scale: Scale, drives: Drives) -> Self:
        """Return a drive whose numbers are stored in row `number` of an array of AXIS."""
        # The array's memory becomes the memory of the object, so that Python and compiled code share one copy.
        axis = cls.from_buffer(rows.data, number * AXIS.itemsize)
        axis.__init__(name, node, scale, drives)  # type: ignore[misc]
        return axis

    @property
    def counts(self) -> Counts:
        """Numbers of late and lost positions and setpoints."""
        return Counts(self.late, self.lost, self.setpoints_late, self.setpoints_lost)

    @property
    def present(self) -> bool:
        """Whether the drive has neither restarted nor fallen silent since its set-up."""
        return not (self.restarted or self.silent)

    @property
    def configured(self) -> bool:
        """Whether the drive's set-up is still valid; setpoints are sent to it only then."""
        return self.present

    @property
    def last_heard(self) -> float:
        """Time of the last sign of life other than a position [s]."""
        return -math.inf if self.heard == math.inf else self.heard

    def watch_silence(self, now: float, period: float) -> None:
        """Mark the drive as silent after SILENT_AFTER. `period` is the cycle period [s]."""
        within = max(SILENT_AFTER, self._missed_positions * period)
        # Both must be old: a drive that is not operational sends heartbeats but no positions.
        if self.missed * period > within and now - self.last_heard > within:
            self.silent = True

    def forget_power_state(self) -> None:
        """Forget the power state reported last; the set-up requests it again."""
        raise NotImplementedError

    def note_fault(self, cause: str, code: int, text: str) -> None:
        """Latch a fault as the drive's event, unless one has been latched since the last reset."""
        if self.event is None:
            self.event = self.make_fault(cause, code, text)

    def make_fault(self, cause: str, code: int, text: str) -> DriveFault:
        """Return a fault of this drive."""
        return DriveFault(self.name, cause, code, shortened(f"drive {self.name}: {text}"))

    def stop_overdue_fault(self, wanted: str, seconds: float) -> DriveFault | None:
        """Return a fault if the drive still has power some time after a command such as "disable".

        `seconds` is the time since the command [s], and `wanted` is the name of the command.
        """
        raise NotImplementedError

    def describe_overdue_stop(self, state: str, expected: str, wanted: str, seconds: float) -> str:
        """Return the text of `stop_overdue_fault`, given the drive's last known and expected states in words."""
        if self.present:
            return f"is {state} {seconds:g} s after {wanted}; expected {expected}"
        return f"was {state} when last heard; expected {expected} {seconds:g} s after {wanted}"

    def silence_fault(self, now: float) -> DriveFault | None:
        """Return a fault if positions or heartbeats are overdue at time `now` [s]."""
        if (missed := self.missed) >= self._missed_positions:
            return self.make_fault("silent", 0, f"no position for {missed} cycles in a row")
        if now - self.heard > self.heard_within:
            return self.make_fault("heartbeat", 0, f"no heartbeat for {now - self.heard:.3g} s")
        return None
