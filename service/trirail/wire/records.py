"""One record a cycle: what the loop commanded, what the drives answered, and how long it took.

Records have a fixed binary layout: compiled code writes them, they travel in batches as they are in memory, and are
read as numpy arrays.
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
    """The parts of a cycle that are timed, in their order."""

    SYNC = 0
    READ = 1
    MODE = 2
    MOTION = 3
    KINEMATICS = 4
    WRITE = 5
    RECORD = 6
    DECIDE = 7
    """What is decided, and passed on, in the time that is left behind the setpoints and the record."""


PARTS = tuple(part.name.lower() for part in Part)
"""Their names."""


FIELDS: tuple[tuple[str, str, int], ...] = (
    ("cycle", "q", 1),  # SYNCs sent since the start; times the period, the nominal time
    ("deadline_ns", "q", 1),  # when this cycle was due, monotonic clock
    ("lateness_ns", "q", 1),  # how much later it began
    ("overruns", "q", 1),  # ticks missed since the start
    ("parts_ns", "i", len(Part)),  # time spent in each part; "record" and "decide" are those of the cycle before
    ("mode", "B", 1),  # index into trirail.wire.vocabulary.MODES
    ("drive_state", "B", 3),  # trirail_drivers.interface.PowerState of A, B, C
    ("age", "B", 3),  # how many SYNCs ago the positions of A, B, C were sampled; 255 for any more
    ("follows", "B", 3),  # whether A, B, C follow setpoints: not while they are being homed
    ("homed", "B", 3),  # whether it is known from where the positions of A, B, C are counted
    ("homing", "B", 1),  # whether the drives are being homed
    ("settled", "B", 1),  # whether the robot stands where it is commanded to, by [limits.in_position]
    ("pose", "d", 3),  # measured: forward kinematics of the measured sliders; x, y [m], phi [rad]
    ("commanded_pose", "d", 3),
    ("commanded_pose_velocity", "d", 3),
    ("commanded_pose_acceleration", "d", 3),
    ("position", "d", 3),  # measured sliders: lambda_10 of A, B, C, and what takes up their backlash [m]
    ("backlash", "d", 3),  # that alone: position less this is lambda_10 [m]
    ("velocity", "d", 3),  # measured sliders [m/s]
    ("commanded_position", "d", 3),  # setpoints written in this cycle, with what takes up backlash [m]
    ("commanded_velocity", "d", 3),  # v_10 [m/s]
    ("commanded_acceleration", "d", 3),  # gamma_10 [m/s²]
    ("passive_position", "d", 3),  # commanded, of the cross slides [m]
    ("following_error", "d", 3),  # setpoint due at this SYNC less measured position [m]
    ("progress", "d", 1),  # of the running goal, 0 to 1
    ("remaining", "d", 1),  # of the running goal [s]
    ("outputs", "I", 3),  # wanted output words of the drives A, B, C, from this cycle's setpoints on
    ("inputs", "I", 3),  # input words of the drives A, B, C
)

_NUMPY = {"q": "<i8", "i": "<i4", "I": "<u4", "B": "u1", "d": "<f8"}
DTYPE: np.dtype[Any] = np.dtype(
    [(name, _NUMPY[code], (n,) if n > 1 else ()) for name, code, n in FIELDS],
    align=True,  # as compiled code likes to read and write it
)
"""The layout of a record: in the loop's memory, between the processes and on the wire."""
SIZE = DTYPE.itemsize
"""Bytes of a record."""
LONGEST = 2**31 - 1
"""A part that took longer is recorded as that long [ns]."""
HEAD = struct.Struct(f"<4q{len(Part)}iB")
"""The fields at its beginning that the loop writes, up to `mode`; the control has written the others."""


def last_cycle(batch: bytes) -> int:
    """Return the cycle of the last of packed records."""
    return int.from_bytes(batch[-SIZE:][:8], "little")


def unpack(batch: bytes | memoryview) -> NDArray[np.void]:
    """View a batch of packed records as an array with the fields of DTYPE, shape (n,)."""
    return np.frombuffer(batch, DTYPE)


def checked(payload: bytes) -> bytes:
    """Return packed records: at least one, all whole, of cycles that follow each other. Raises RefusedError."""
    if not payload or len(payload) % SIZE:
        raise RefusedError(RefusalCode.MALFORMED, f"not records: {len(payload)} bytes, and each record has {SIZE}")
    rows = unpack(payload)
    known = np.all(rows["mode"] < len(MODES)) and np.all(rows["drive_state"] < len(PowerState))
    if not known or rows["cycle"][0] < 0 or np.any(np.diff(rows["cycle"]) != 1):
        raise RefusedError(RefusalCode.MALFORMED, "not records: modes, states or cycles that there are not")
    return payload
