"""Records, each with the setpoints, feedback and timing of one cycle.

Records have a fixed binary layout. Compiled code writes the records, the processes send them in batches with the same
bytes as in memory, and readers view them as NumPy arrays.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import PowerState

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.vocabulary import MODES


class Part(IntEnum):
    """Parts of a cycle, in order, for each of which the time is measured."""

    SYNC = 0
    READ = 1
    MODE = 2
    MOTION = 3
    KINEMATICS = 4
    WRITE = 5
    RECORD = 6
    DECIDE = 7
    """Decisions and messages in the remaining time of the cycle, after the setpoints and the record are written."""


PART_NAMES = tuple(part.name.lower() for part in Part)
"""Names of the parts."""


FIELDS: tuple[tuple[str, str, int], ...] = (
    ("cycle", "q", 1),  # number of SYNCs sent since the start; times the period, this is the nominal time
    ("deadline_ns", "q", 1),  # time at which this cycle was due, on the monotonic clock
    ("lateness_ns", "q", 1),  # delay of the start of this cycle
    ("overruns", "q", 1),  # number of ticks missed since the start
    ("parts_ns", "i", len(Part)),  # time spent in each part; for "record" and "decide", in the previous cycle
    ("mode", "B", 1),  # index into trirail.wire.vocabulary.MODES
    ("drive_state", "B", 3),  # trirail_drivers.interface.PowerState of A, B, C
    ("age", "B", 3),  # age of the positions of A, B, C in SYNCs, at most 255
    ("follows", "B", 3),  # whether A, B, C follow setpoints; false during homing
    ("homed", "B", 3),  # whether the absolute positions of A, B, C are known
    ("homing", "B", 1),  # whether the drives are being homed
    ("settled", "B", 1),  # whether the robot is in position according to [limits.in_position]
    ("pose", "d", 3),  # measured pose x, y [m], phi [rad], from the measured sliders; unknown unless all are homed
    ("commanded_pose", "d", 3),
    ("commanded_pose_velocity", "d", 3),
    ("commanded_pose_acceleration", "d", 3),
    ("position", "d", 3),  # measured positions of the sliders A, B, C: lambda_10 plus backlash compensation [m]
    ("backlash", "d", 3),  # backlash compensation of A, B, C [m]; position minus backlash is lambda_10
    ("velocity", "d", 3),  # measured velocities of the sliders [m/s]
    ("commanded_position", "d", 3),  # setpoints written in this cycle, with backlash compensation [m]
    ("commanded_velocity", "d", 3),  # v_10 [m/s]
    ("commanded_acceleration", "d", 3),  # gamma_10 [m/s²]
    ("passive_position", "d", 3),  # commanded positions of the cross slides [m]
    ("following_error", "d", 3),  # setpoint due at this SYNC minus measured position [m]
    ("progress", "d", 1),  # progress of the goal, 0 to 1
    ("remaining", "d", 1),  # remaining time of the goal [s]
    ("outputs", "I", 3),  # requested output words of the drives A, B, C, starting with this cycle's setpoints
    ("inputs", "I", 3),  # input words of the drives A, B, C
)

_NUMPY = {"q": "<i8", "i": "<i4", "I": "<u4", "B": "u1", "d": "<f8"}
DTYPE: np.dtype[Any] = np.dtype(
    [(name, _NUMPY[code], (n,) if n > 1 else ()) for name, code, n in FIELDS],
    align=True,  # aligned fields, which compiled code reads and writes faster
)
"""Layout of a record in the loop's memory, in packets between the processes, and on the network."""
SIZE = DTYPE.itemsize
"""Size of a record [bytes]."""
MAX_PART_NS = 2**31 - 1
"""Greatest value with which the duration of a part is recorded [ns]."""
HEADER = struct.Struct(f"<4q{len(Part)}iB")
"""Layout of the first fields of a record, up to `mode`. The loop writes these, and the control the other fields."""


def last_cycle(batch: bytes) -> int:
    """Return the cycle of the last record in a batch."""
    return int.from_bytes(batch[-SIZE:][:8], "little")


def unpack(batch: bytes | memoryview) -> NDArray[np.void]:
    """Return a view of a batch of records as an array with the fields of DTYPE, shape (n,)."""
    return np.frombuffer(batch, DTYPE)


def slider_positions(records: NDArray[np.void] | np.void) -> NDArray[np.float64]:
    """Return the measured positions lambda_10 of the sliders [m], without the backlash compensation of the drives."""
    positions: NDArray[np.float64] = records["position"] - records["backlash"]
    return positions


def are_known(records: NDArray[np.void]) -> bool:
    """Return True if the records contain only known modes and drive states."""
    return bool(np.all(records["mode"] < len(MODES)) and np.all(records["drive_state"] < len(PowerState)))


def checked(payload: bytes) -> bytes:
    """Check a batch of records; return the batch.

    Raises RefusedError if the batch does not consist of one or more complete records of consecutive cycles, or if it
    contains an unknown mode or drive state.
    """
    if not payload or len(payload) % SIZE:
        raise RefusedError(
            RefusalCode.MALFORMED, f"records: {len(payload)} bytes are not a multiple of {SIZE}, the size of a record"
        )
    rows = unpack(payload)
    if not are_known(rows) or rows["cycle"][0] < 0 or np.any(np.diff(rows["cycle"]) != 1):
        raise RefusedError(RefusalCode.MALFORMED, "records: unknown modes or drive states, or cycles out of order")
    return payload
