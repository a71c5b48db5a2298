"""One record a cycle: what the loop commanded, what the drives answered, and how long it took.

Records have a fixed binary layout, are packed by the loop, travel in batches, and are read as numpy arrays.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Part(IntEnum):
    """The parts of a cycle that are timed, in their order."""

    SYNC = 0
    READ = 1
    MODE = 2
    MOTION = 3
    KINEMATICS = 4
    WRITE = 5
    RECORD = 6


PARTS = tuple(part.name.lower() for part in Part)
"""Their names."""


class Record(NamedTuple):
    """One record, with the fields of FIELDS; a field of several numbers is a sequence of so many."""

    cycle: int
    deadline_ns: int
    lateness_ns: int
    parts_ns: Sequence[int]
    overruns: int
    mode: int
    drive_state: Sequence[int]
    age: Sequence[int]
    follows: Sequence[bool]
    homed: Sequence[bool]
    homing: bool
    pose: Sequence[float]
    commanded_pose: Sequence[float]
    commanded_pose_velocity: Sequence[float]
    commanded_pose_acceleration: Sequence[float]
    position: Sequence[float]
    velocity: Sequence[float]
    commanded_position: Sequence[float]
    commanded_velocity: Sequence[float]
    commanded_acceleration: Sequence[float]
    passive_position: Sequence[float]
    following_error: Sequence[float]
    progress: float
    remaining: float


FIELDS: tuple[tuple[str, str, int], ...] = (
    ("cycle", "q", 1),  # SYNCs sent since the start; times the period, the nominal time
    ("deadline_ns", "q", 1),  # when this cycle was due, monotonic clock
    ("lateness_ns", "q", 1),  # how much later it began
    ("parts_ns", "i", len(Part)),  # time spent in each part; "record" is that of the cycle before
    ("overruns", "q", 1),  # ticks missed since the start
    ("mode", "B", 1),  # index into trirail.control.modes.MODES
    ("drive_state", "B", 3),  # trirail_drivers.interface.PowerState of A, B, C
    ("age", "B", 3),  # how many SYNCs ago the positions of A, B, C were sampled; 255 for any more
    ("follows", "B", 3),  # whether A, B, C follow setpoints: not while they are being homed
    ("homed", "B", 3),  # whether it is known from where the positions of A, B, C are counted
    ("homing", "B", 1),  # whether the drives are being homed
    ("pose", "d", 3),  # measured: forward kinematics of the measured sliders; x, y [m], phi [rad]
    ("commanded_pose", "d", 3),
    ("commanded_pose_velocity", "d", 3),
    ("commanded_pose_acceleration", "d", 3),
    ("position", "d", 3),  # measured sliders: lambda_10 of A, B, C [m]
    ("velocity", "d", 3),  # measured sliders [m/s]
    ("commanded_position", "d", 3),  # setpoints written in this cycle [m]
    ("commanded_velocity", "d", 3),  # v_10 [m/s]
    ("commanded_acceleration", "d", 3),  # gamma_10 [m/s²]
    ("passive_position", "d", 3),  # commanded lambda_32 [m]
    ("following_error", "d", 3),  # setpoint due at this SYNC less measured position [m]
    ("progress", "d", 1),  # of the running goal, 0 to 1
    ("remaining", "d", 1),  # of the running goal [s]
)

DTYPE: np.dtype[Any] = np.dtype(
    [
        (name, "<" + {"q": "i8", "i": "i4", "B": "u1", "d": "f8"}[code], (n,) if n > 1 else ())
        for name, code, n in FIELDS
    ]
)
LAYOUT = struct.Struct("<" + "".join(f"{n}{code}" for _, code, n in FIELDS))
"""The same layout as DTYPE, for packing one record: as many values as the fields have, in their order."""
_SINGLE = tuple(n == 1 for _, _, n in FIELDS)


def pack_into(buffer: bytearray, offset: int, record: Record) -> None:
    """Pack a record into a buffer, where LAYOUT.size bytes are free."""
    values: list[Any] = []
    value: Any
    for value, single in zip(record, _SINGLE, strict=True):
        if single:
            values.append(value)
        else:
            values.extend(value)
    LAYOUT.pack_into(buffer, offset, *values)


def last_cycle(batch: bytes) -> int:
    """Return the cycle of the last of packed records."""
    return int.from_bytes(batch[-LAYOUT.size :][:8], "little")


def unpack(batch: bytes | memoryview) -> NDArray[np.void]:
    """View a batch of packed records as an array with the fields of DTYPE, shape (n,)."""
    return np.frombuffer(batch, DTYPE)
