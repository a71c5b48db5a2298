"""Frames in memory as compiled code moves them, many at once, and how it reaches the bus for that."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from trirail_drivers.bus.can_frame import CAN_FRAME, DATA_AT, HEAD
from trirail_drivers.bus.frames import Frame


class BusAccess(NamedTuple):
    """How a bus is reached by who is compiled."""

    descriptor: int
    """Its socket of `struct can_frame`, one a packet; below 0 where it has none, and the functions are to be called."""
    receive: int = 0
    """Address of a function that fills so many frames at most; returns their number, or `~number` if it then failed."""
    send: int = 0
    """Address of a function that sends so many frames; returns how many the bus has taken, before the first refused."""


class PackedFrames:
    """Frames as libc's sendmmsg and recvmmsg take them: `struct mmsghdr` of sys/socket.h, one `iovec` each."""

    def __init__(self, number: int) -> None:
        self.frames = np.zeros((number, CAN_FRAME.size), np.uint8)
        """`struct can_frame`, one a row."""
        self._vectors = np.zeros((number, 2), np.uint64)
        self.headers = np.zeros((number, 8), np.uint64)
        """`struct mmsghdr`: what was received of each is in the last number."""
        for frame, vector, header in zip(self.frames, self._vectors, self.headers, strict=True):
            vector[:] = frame.ctypes.data, CAN_FRAME.size
            header[2:4] = vector.ctypes.data, 1

    def part(self, first: int, end: int) -> PackedFrames:
        """Return some of them, which stay the same."""
        part = PackedFrames.__new__(PackedFrames)
        part.frames, part._vectors, part.headers = self.frames[first:end], self._vectors, self.headers[first:end]
        return part

    def fill(self, frames: Iterable[Frame]) -> None:
        """Have these frames."""
        for row, frame in zip(self.frames, frames, strict=True):
            row[:] = np.frombuffer(frame.packed, np.uint8)

    def unpacked(self, number: int) -> list[tuple[int, bytearray]]:
        """The first so many, as identifier with flags and data."""
        found = []
        for row in self.frames[:number]:
            packed = row.tobytes()
            identifier, length = HEAD.unpack_from(packed)
            found.append((identifier, bytearray(packed[DATA_AT : DATA_AT + length])))
        return found


def packed_frames(frames: Sequence[Frame]) -> PackedFrames:
    """Pack frames."""
    made = PackedFrames(len(frames))
    made.fill(frames)
    return made
