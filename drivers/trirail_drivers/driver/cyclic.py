"""What one cycle exchanges with three drives, as data: who compiles the cycle knows these tables, and no protocol.

A driver fills them in while all it would do in a cycle is to take positions that it expects and to send setpoints. What
it keeps of each drive is in them as long as they are lent, and goes back to it with `Lender.take_back`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trirail_drivers.bus.packets import BusAccess, Packets
from trirail_drivers.interface import Feedback

MOST_FRAMES: Final = 32
"""Frames that are taken at once; more than a cycle's are no quiet one's."""
NOWHERE: Final = -1
"""Of a place in a frame: it has no such number."""

AXIS = np.dtype(
    [
        ("position", "<f8"),  # newest position [m]
        ("actual", "<i8"),  # likewise [counts]
        ("heard", "<f8"),  # when a frame said last that the drive lives [s]
        ("status_heard", "<f8"),  # when it told its state last [s]
        ("statusword", "<i8"),  # the newest one
        ("seen_clear", "<i8"),  # its bits that have been 0 since somebody began to watch
        ("syncs", "<i8"),  # as trirail_drivers.driver.answers.Answers has it, down to `prompt`
        ("sampled", "<i8"),
        ("late", "<i8"),
        ("lost", "<i8"),
        ("between", "u1"),
        ("prompt", "u1"),
        ("came", "u1"),  # whether a position has come in this cycle
        ("newest", "<i8"),  # counts that came last, and how far these were from those before
        ("step", "<i8"),
        ("stands_at", "<i8"),  # counts where the slider has been, and since when [s]
        ("stands_since", "<f8"),
        ("command_age", "<i8"),  # SYNCs since it was sent a command
        ("target", "<i8"),  # position and velocity that were sent last, in its units, where these are whole
        ("offset", "<i8"),
        ("wanted", "<f8", 2),  # setpoint that was written last [m], [m/s]
        ("sent", "<f8", 2),  # and what the last SYNC has sent of it, where setpoints wait for one
        ("in_force", "<f8"),  # position that the bus has taken last [m]
        # What stays as it is.
        ("floats", "u1"),  # whether positions are 32-bit floats; else whole counts
        ("waits", "u1"),  # whether setpoints go with the next SYNC; else at once
        ("follows_within", "<f8"),  # how far it may be from where it is to be [m]; infinite where nobody watches that
        ("counts_per_metre", "<f8"),
        ("zero", "<f8"),  # slider position at zero counts [m]
        ("velocity_per_metre", "<f8"),
        ("velocity_step", "<f8"),  # by which that is divided
        ("velocity_bytes", "<i8"),
        ("still", "<f8"),  # counts within which a slider stands
        ("heard_within", "<f8"),  # how old that may be [s]
        ("status_within", "<f8"),
        ("position_at", "<i8"),  # where in its setpoint's frame position and velocity go; NOWHERE for neither
        ("velocity_at", "<i8"),
    ],
    align=True,
)
"""One drive."""
_NAMES: Final = AXIS.names or ()
Row = dict[str, Any]
"""The same by its names: twenty numbers of an array, one by one, would take Python longer than a cycle."""

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
        ("traffic", "<i8"),  # bits that have passed the bus
        ("cycles", "<i8"),  # whole cycles
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
    """The tables of three drives, made once, and filled in each time that they are lent."""

    def __init__(self, bus: BusAccess, begin: Packets, beats: Packets, setpoints: Packets, history: int = 0) -> None:
        """`history`: so many setpoints are kept of those that were sent."""
        self.bus = np.array(bus, np.int64)
        """A BusAccess, (3,)."""
        self.axes: NDArray[np.void] = np.zeros(3, AXIS)
        self.times: NDArray[np.void] = np.zeros(1, TIMES)
        self.expected: NDArray[np.void] = np.zeros(0, EXPECTED)
        self.begin = begin
        """What begins a cycle."""
        self.beats = beats
        """What goes behind that from time to time: that the drives know the service to live, what they are asked."""
        self.setpoints = setpoints
        """One frame for each drive, in their order."""
        self.end = setpoints.headers
        """What ends a cycle: those, or none of them where they go with what begins the next."""
        self.history = np.full((history, 3), np.nan)
        """Positions that the drives were to have reached at each SYNC, the newest last [m]; NaN where none was sent."""
        self.arrived = Packets(MOST_FRAMES)

    def write(self, rows: Sequence[Row]) -> None:
        """Have what is kept of the three drives."""
        self.axes[:] = [tuple(row.get(name, 0) for name in _NAMES) for row in rows]

    def rows(self) -> list[Row]:
        """What is kept of the three drives."""
        return [dict(zip(_NAMES, row, strict=True)) for row in self.axes.tolist()]

    def expect(self, rows: Sequence[tuple[Any, ...]]) -> None:
        """Expect these frames: rows of EXPECTED."""
        self.expected = np.array(rows, EXPECTED)


@runtime_checkable
class Lender(Protocol):
    """A DriveGroup whose cycles somebody else may run, by tables."""

    def lend(self) -> Cyclic | None:
        """Between two cycles: the tables of a cycle, where all that drives need is to have it run by these.

        None where there is more to do. As long as they are lent, nothing else is called.
        """

    def take_back(self, arrived: int, *, synced: float | None = None, error: int = 0) -> Feedback:
        """Go on from what the tables hold; return what the drives had said at the end of the last whole cycle.

        The first `arrived` frames in them have not been looked at. `synced` is when the SYNC of a cycle was sent whose
        feedback has not been read [s], if there is one; `error` with which taking frames has failed (errno.h).
        """

    def send_on(self, first: int) -> None:
        """Send the setpoints in the tables from that of drive `first` on, which the bus has not taken."""
