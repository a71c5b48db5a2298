"""What one cycle exchanges with three drives, as data: who compiles the cycle knows these tables, and no protocol.

A driver lends them while all it would do in a cycle is to take positions that it expects and to send setpoints. What it
keeps of each drive is always in them; `Lender.take_back` hands over what nobody has dealt with.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames
from trirail_drivers.driver.axis_row import AXIS, NOWHERE
from trirail_drivers.interface import Feedback

MOST_FRAMES: Final = 32
"""Frames that are taken at once; more than a cycle's are no quiet one's."""

EXPECTED = np.dtype(
    [
        ("identifier", "<u4"),
        ("length", "u1"),
        ("axis", "u1"),
        ("mask", "u1", 8),  # the bits of its data that decide something
        ("data", "u1", 8),  # and what they must be
        ("position_at", "i1"),  # where in it a position stands, 32 bits [counts]
        ("status_at", "i1"),  # where in it the statusword stands
        ("lives", "u1"),  # whether it says that the drive lives
    ],
    align=True,
)
"""A frame that may come in any cycle, and changes nothing but what it is read for."""

TIMES = np.dtype(
    [
        ("due", "<f8"),  # when the driver has to do something else itself [s]
        ("beat_due", "<f8"),  # when the service's own signs of life are due [s], and how often they are
        ("beat_period", "<f8"),
        ("beats", "<i8"),  # so many of them go at once, and which is the next
        ("next_beat", "<i8"),
        ("begun", "<i8"),  # frames of the newest cycle's beginning, before the first that was refused; NOWHERE for none
        ("traffic", "<i8"),  # bits that have passed the bus in quiet cycles
    ],
    align=True,
)
"""What is due when, and what has been."""


def expected(
    identifier: int,
    axis: int,
    data: bytes,
    mask: bytes,
    *,
    position_at: int = NOWHERE,
    status_at: int = NOWHERE,
    lives: bool = False,
) -> tuple[Any, ...]:
    """A row of EXPECTED, from data as it came last."""
    wanted = bytes(byte & bits for byte, bits in zip(data, mask, strict=True))
    padded = [tuple(part.ljust(8, b"\0")) for part in (mask, wanted)]
    return identifier, len(data), axis, *padded, position_at, status_at, lives


class Cyclic:
    """The tables of three drives. What is kept of these lives there; the frames are filled in when they are lent."""

    def __init__(self, bus: BusAccess, history: int) -> None:
        """`history`: so many setpoints are kept of those that were sent."""
        self.bus = np.array(bus, np.int64)
        """A BusAccess, (3,)."""
        self.axes: NDArray[np.void] = np.zeros(3, AXIS)
        self.times: NDArray[np.void] = np.zeros(1, TIMES)
        self.expected: NDArray[np.void] = np.zeros(0, EXPECTED)
        self.begin = self.beats = self.setpoints = PackedFrames(0)
        """What begins a cycle; what goes behind that from time to time, as signs of life; a frame for each drive."""
        self.end = self.setpoints.headers
        """What ends a cycle: those, or none of them where they go with what begins the next."""
        self.history = np.full((history, 3), np.nan)
        """Positions that the drives were to have reached at SYNC n, in row n modulo their number [m]; NaN for none."""
        self.arrived = PackedFrames(MOST_FRAMES)

    def expect(self, rows: Sequence[tuple[Any, ...]]) -> None:
        """Expect these frames: rows of EXPECTED."""
        self.expected = np.array(rows, EXPECTED)


@runtime_checkable
class Lender(Protocol):
    """A DriveGroup whose cycles somebody else may run, by tables."""

    def lend(self) -> Cyclic | None:
        """Between two cycles: the tables of a cycle, where all that drives need is to have it run by these.

        None where there is more to do. As long as they are lent, nothing is called but orders as `disable` or
        `quick_stop`, and then `take_back` before the next cycle.
        """

    def take_back(self, arrived: int, *, synced: float | None = None, error: int = 0) -> Feedback:
        """Go on from what the tables hold; return what the drives had said at the end of the last whole cycle.

        The first `arrived` frames in them have not been looked at. `synced` is when the SYNC of a cycle was sent whose
        feedback has not been read [s], if there is one; `error` with which taking frames has failed (errno.h).
        """

    def send_on(self, first: int) -> None:
        """Send the setpoints in the tables from that of drive `first` on, which the bus has not taken."""
