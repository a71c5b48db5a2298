"""Tables of the frames that one cycle exchanges with three drives. The compiled cycle knows only these tables.

The tables always contain the state of each drive. A driver lends them to the compiled cycle while cycles only have to
handle expected frames and send setpoints. `Lender.reclaim` returns the frames that the compiled cycle has not handled
to the driver.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames
from trirail_drivers.driver.axis_row import AXIS, NO_OFFSET
from trirail_drivers.interface import Feedback
from trirail_drivers.timing import BusTiming

MOST_FRAMES: Final = 32
"""Maximum number of frames received in one call; a quiet cycle has fewer."""

MOST_LENGTH: Final = 8
"""Maximum data length of a frame in a quiet cycle [bytes]."""

EXPECTED = np.dtype(
    [
        ("identifier", "<u4"),
        ("length", "u1"),
        ("axis", "u1"),
        ("mask", "u1", 8),  # bits of the data that are compared
        ("data", "u1", 8),  # required values of those bits
        ("position_at", "i1"),  # offset of a 32-bit position in the data [bytes], NO_OFFSET for none
        ("status_at", "i1"),  # offset of a statusword in the data [bytes], NO_OFFSET for none
        ("lives", "u1"),  # whether the frame is a sign of life
    ],
    align=True,
)
"""Frame that may arrive in any quiet cycle. It has no effect except to update the values that are read from it."""

TIMES = np.dtype(
    [
        ("due", "<f8"),  # time at which the driver itself has to do something else [s]
        ("beat_due", "<f8"),  # time at which the service's next periodic frames (heartbeats, requests) are due [s]
        ("beat_period", "<f8"),  # period of these frames [s]
        ("beats", "<i8"),  # number of these frames sent together
        ("next_beat", "<i8"),  # index of the next of these frames
        ("begun", "<i8"),  # frames sent at the start of the newest cycle before one was refused; NO_OFFSET if none
        ("traffic", "<i8"),  # duration of the frames of quiet cycles since the start [ns]
        ("frame_ns", "<i8", MOST_LENGTH + 1),  # duration of a frame of each data length [ns]
    ],
    align=True,
)
"""Deadlines and progress of quiet cycles."""


def expected_row(
    identifier: int,
    axis: int,
    data: bytes,
    mask: bytes,
    *,
    position_at: int = NO_OFFSET,
    status_at: int = NO_OFFSET,
    lives: bool = False,
) -> tuple[Any, ...]:
    """Return a row of EXPECTED made from the data received last."""
    wanted = bytes(byte & bits for byte, bits in zip(data, mask, strict=True))
    padded = [tuple(part.ljust(8, b"\0")) for part in (mask, wanted)]
    return identifier, len(data), axis, *padded, position_at, status_at, lives


class Cyclic:
    """Tables of three drives: always the state of the drives; a driver completes the rest before it lends them."""

    def __init__(self, bus: BusAccess, history: int, timing: BusTiming) -> None:
        """`history`: number of sent setpoints to keep."""
        self.bus = np.array(bus, np.int64)
        """A BusAccess, (3,)."""
        self.axes: NDArray[np.void] = np.zeros(3, AXIS)
        self.times: NDArray[np.void] = np.zeros(1, TIMES)
        self.times["frame_ns"] = timing.frames_ns[: MOST_LENGTH + 1]
        self.expected: NDArray[np.void] = np.zeros(0, EXPECTED)
        self.begin = self.beats = self.setpoints = self.outputs = PackedFrames(0)
        """Tables of frames to send: `begin` at the start of a cycle, then the periodic frames `beats` that are due,
        `setpoints` with one frame for each drive, and `outputs` with at most one frame for each drive, sent after the
        setpoints if the digital outputs have changed.
        """
        self.end = self.setpoints.headers
        """Frames at the end of a cycle: the setpoints, or none if the setpoints are sent at the start of the next
        cycle.
        """
        self.history = np.full((history, 3), np.nan)
        """Positions commanded at each SYNC [m], (history, 3); SYNC n is in row n % history. NaN if none was commanded.
        """
        self.arrived = PackedFrames(MOST_FRAMES)

    @property
    def counts(self) -> tuple[Any, ...]:
        """Last two fields of `times`, which a driver does not change."""
        return self.times[0]["traffic"], self.times[0]["frame_ns"]

    def expect(self, rows: Sequence[tuple[Any, ...]]) -> None:
        """Replace the expected frames with the given rows of EXPECTED."""
        self.expected = np.array(rows, EXPECTED)


@runtime_checkable
class Lender(Protocol):
    """DriveGroup that lends its tables to compiled code, which then runs the cycles."""

    next_sync: float
    """See DriveGroup."""

    def lend(self) -> Cyclic | None:
        """Return the tables between two cycles, or None if the tables do not suffice for the next cycle.

        While the tables are lent, the caller may only call commands such as `disable` or `quick_stop`. After such a
        command, the caller must call `reclaim` before the next cycle.
        """

    def reclaim(self, handled: int, arrived: int, *, synced: float | None = None, error: int = 0) -> Feedback:
        """Continue from the tables, and return the feedback, without new warnings, which `read` returns.

        Parameters
        ----------
        handled
            Number of handled frames among the `arrived` frames in the tables.
        arrived
            Number of received frames in the tables.
        synced
            Time at which the SYNC of an unfinished cycle was sent [s]; None if every cycle is finished.
        error
            Error number (errno.h) with which receiving failed, or 0.
        """

    def send_on(self, first: int) -> None:
        """Send the setpoints in the tables again from drive `first` on, whose setpoint the bus refused, and then the
        changed outputs.
        """
