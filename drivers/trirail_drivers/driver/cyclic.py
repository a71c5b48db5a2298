"""Tables of the frames that one cycle exchanges with three drives. The compiled cycle knows only these tables.

The tables always contain the state of each drive. Compiled code runs the cycles while these only have to handle
expected frames and send setpoints. All other frames go to the driver, by `CompiledDrives.continue_in_python`.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import MutableSequence, Sequence
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames
from trirail_drivers.driver.axis_row import AXIS, NO_OFFSET, set_fields
from trirail_drivers.interface import Feedback
from trirail_drivers.timing import BusTiming

MOST_FRAMES: Final = 32
"""Maximum number of frames received in one call; a compiled cycle has fewer."""

MOST_LENGTH: Final = 8
"""Maximum data length of a frame in a compiled cycle [bytes]."""

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
"""Frame that may arrive in any compiled cycle. It has no effect except to update the values that are read from it."""

FrameTimes = MutableSequence[int]
"""Durations of a frame of each data length, 0 to MOST_LENGTH [ns]."""


class CycleTimes(ctypes.Structure):
    """Deadlines and progress of the cycles; the Python attributes are views of the memory that compiled code uses."""

    off_deadline: float
    """Time by which the drives must be without power [s]; inf if no such deadline is set."""
    beat_due: float
    """Time at which the service's next periodic frames (heartbeats, requests) are due [s]; NaN before the first cycle.
    """
    beat_period: float
    """Period of these frames [s]."""
    beats: int
    """Number of these frames sent together."""
    next_beat: int
    """Index of the next of these frames."""
    begun: int
    """Number of frames sent at the start of the newest cycle before one was refused; NO_OFFSET if none was refused."""
    traffic: int
    """Duration of the frames of compiled cycles since the start [ns]."""
    frame_ns: FrameTimes


set_fields(CycleTimes, FrameTimes=ctypes.c_int64 * (MOST_LENGTH + 1))
TIMES: Final = np.dtype(CycleTimes)
"""CycleTimes as a numpy type, for compiled code."""


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
    """Tables of three drives: always the state of the drives; a driver completes the frames before compiled cycles."""

    def __init__(self, bus: BusAccess, history: int, timing: BusTiming) -> None:
        """`history`: number of sent setpoints to keep."""
        self.bus = np.array(bus, np.int64)
        """A BusAccess, (3,)."""
        self.axes: NDArray[np.void] = np.zeros(3, AXIS)
        self.timing = CycleTimes(off_deadline=math.inf, beat_due=math.nan, begun=NO_OFFSET)
        self.timing.frame_ns[:] = timing.frames_ns[: MOST_LENGTH + 1]
        self.times: NDArray[np.void] = np.frombuffer(memoryview(self.timing), TIMES)
        """The row `timing`, for compiled code."""
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

    def expect(self, rows: Sequence[tuple[Any, ...]]) -> None:
        """Replace the expected frames with the given rows of EXPECTED."""
        self.expected = np.array(rows, EXPECTED)


class UnfinishedCycle(NamedTuple):
    """Newest cycle, as far as compiled code has run it."""

    handled: int = 0
    """Number of handled frames among the `arrived` frames in the tables."""
    arrived: int = 0
    """Number of received frames in the tables."""
    synced: float | None = None
    """Time at which the SYNC of the cycle was sent [s]; None if it has not been sent, or the cycle is finished."""
    error: int = 0
    """Error number (errno.h) with which receiving failed, or 0."""


FINISHED: Final = UnfinishedCycle()
"""Value for a cycle that compiled code has finished."""


@runtime_checkable
class CompiledDrives(Protocol):
    """DriveGroup whose cycles compiled code can run."""

    next_sync: float
    """See DriveGroup."""
    tables: Cyclic

    def prepare_tables(self) -> bool:
        """Complete the tables between two cycles, and return True, if they suffice for the next cycles.

        Until `continue_in_python` is called, the caller may then only call commands such as `disable` or `quick_stop`,
        and must call `continue_in_python` after such a command, before the next cycle.
        """

    def continue_in_python(self, newest: UnfinishedCycle = FINISHED) -> Feedback:
        """Continue after compiled cycles, and return the feedback, without new warnings, which `read` returns."""

    def send_on(self, first: int) -> None:
        """Send the setpoints in the tables again from drive `first` on, whose setpoint the bus refused, and then the
        changed outputs.
        """
