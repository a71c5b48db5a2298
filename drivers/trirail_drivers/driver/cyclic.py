"""Frames of one cycle with three drives as tables: the compiled cycle knows these tables, and no protocol.

A driver lends them while a cycle only handles expected frames and sends setpoints. The state of each drive is always in
them; `Lender.take_back` returns the frames that the compiled cycle has not handled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames
from trirail_drivers.driver.axis_row import AXIS, NO_OFFSET
from trirail_drivers.interface import Feedback

MOST_FRAMES: Final = 32
"""Frames received in one call; a quiet cycle has fewer."""

EXPECTED = np.dtype(
    [
        ("identifier", "<u4"),
        ("length", "u1"),
        ("axis", "u1"),
        ("mask", "u1", 8),  # bits of its data that decide something
        ("data", "u1", 8),  # required values of those bits
        ("position_at", "i1"),  # offset of a 32-bit position in it [bytes], NO_OFFSET for none
        ("status_at", "i1"),  # offset of a statusword in it [bytes], NO_OFFSET for none
        ("lives", "u1"),  # whether it is a sign of life
    ],
    align=True,
)
"""A frame that may come in any cycle, and changes nothing but the values read from it."""

TIMES = np.dtype(
    [
        ("due", "<f8"),  # time at which the driver itself has something else to do [s]
        ("beat_due", "<f8"),  # time at which the service's next periodic frames (heartbeats, requests) are due [s]
        ("beat_period", "<f8"),  # period of these [s]
        ("beats", "<i8"),  # number of these sent together
        ("next_beat", "<i8"),  # index of the next one
        ("begun", "<i8"),  # frames sent at the newest cycle's beginning before one was refused; NO_OFFSET for none
        ("traffic", "<i8"),  # bits on the bus in quiet cycles since the start
    ],
    align=True,
)
"""Deadlines of quiet cycles, and their progress."""


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
    """Return a row of EXPECTED, from the data received last."""
    wanted = bytes(byte & bits for byte, bits in zip(data, mask, strict=True))
    padded = [tuple(part.ljust(8, b"\0")) for part in (mask, wanted)]
    return identifier, len(data), axis, *padded, position_at, status_at, lives


class Cyclic:
    """Tables of three drives. The drives' state is always in them; the frames are filled in when they are lent."""

    def __init__(self, bus: BusAccess, history: int) -> None:
        """`history`: number of sent setpoints to keep."""
        self.bus = np.array(bus, np.int64)
        """A BusAccess, (3,)."""
        self.axes: NDArray[np.void] = np.zeros(3, AXIS)
        self.times: NDArray[np.void] = np.zeros(1, TIMES)
        self.expected: NDArray[np.void] = np.zeros(0, EXPECTED)
        self.begin = self.beats = self.setpoints = self.outputs = PackedFrames(0)
        """Frames at the beginning of a cycle; periodic frames, sent after those; setpoints, one for each drive; digital
        outputs, one for each drive or none, sent after the setpoints where they change."""
        self.end = self.setpoints.headers
        """Frames at the end of a cycle: the setpoints, or none if they are sent at the beginning of the next."""
        self.history = np.full((history, 3), np.nan)
        """Commanded positions at SYNC n in row n % history [m]; NaN for none."""
        self.arrived = PackedFrames(MOST_FRAMES)

    def expect(self, rows: Sequence[tuple[Any, ...]]) -> None:
        """Replace the expected frames by these rows of EXPECTED."""
        self.expected = np.array(rows, EXPECTED)


@runtime_checkable
class Lender(Protocol):
    """A DriveGroup whose cycles compiled code may run by tables."""

    def lend(self) -> Cyclic | None:
        """Return the tables between two cycles, or None if the next cycle needs more than them.

        While they are lent, only commands such as `disable` or `quick_stop` are called, and then `take_back` before
        the next cycle.
        """

    def take_back(self, handled: int, arrived: int, *, synced: float | None = None, error: int = 0) -> Feedback:
        """Continue from the tables; return the feedback.

        Parameters
        ----------
        handled
            Number of handled frames among the `arrived` ones in the tables.
        arrived
            Number of received frames in the tables.
        synced
            Time at which the SYNC of an unfinished cycle was sent [s]; None if no cycle is unfinished.
        error
            Number of errno.h with which receiving has failed, or 0.
        """

    def send_on(self, first: int) -> None:
        """Send the setpoints in the tables from drive `first` on, which the bus has refused, and changed outputs."""
