"""Arrays of frames that compiled code sends and receives in one call, and the access of compiled code to the bus."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from trirail_drivers.bus.can_frame import CANFD_FRAME, DATA_AT, HEADER, REMOTE
from trirail_drivers.bus.frames import Frame, fd_packed


class BusAccess(NamedTuple):
    """Access of compiled code to a bus: a socket, or two functions if the bus has no socket."""

    descriptor: int
    """Socket that carries one `struct can_frame` or `struct canfd_frame` per packet; negative if there is none and the
    functions must be called.
    """
    receive: int = 0
    """Address of a function that receives frames, up to a given number. It returns the number of frames received, or
    the bitwise complement of that number if receiving then failed.
    """
    send: int = 0
    """Address of a function that sends frames and returns the number of frames sent before the first failure."""


class PackedFrames:
    """Frames for libc's sendmmsg and recvmmsg: `struct mmsghdr` of sys/socket.h, each with one `iovec`."""

    def __init__(self, number: int) -> None:
        self.frames = np.zeros((number, CANFD_FRAME.size), np.uint8)
        """Frames, (number, size) of uint8. Each row has space for a `struct canfd_frame`, since a CAN FD bus carries
        frames of both formats.
        """
        self._vectors = np.zeros((number, 2), np.uint64)
        self.headers = np.zeros((number, 8), np.uint64)
        """`struct mmsghdr` of each frame; the last of its eight numbers is the received length [bytes]."""
        # On 64-bit Linux, a header consists of msg_name, msg_namelen, msg_iov, msg_iovlen, msg_control, msg_controllen,
        # msg_flags and msg_len; each takes eight bytes including padding.
        for frame, vector, header in zip(self.frames, self._vectors, self.headers, strict=True):
            vector[:] = frame.ctypes.data, CANFD_FRAME.size
            header[2:4] = vector.ctypes.data, 1

    def part(self, first: int, end: int) -> PackedFrames:
        """Return a view of a range of the frames."""
        part = PackedFrames.__new__(PackedFrames)
        part.frames, part.headers = self.frames[first:end], self.headers[first:end]
        part._vectors = self._vectors[first:end]
        return part

    def fill(self, frames: Iterable[Frame], *, fd: bool = False) -> None:
        """Replace the frames by frames to send, on a CAN FD bus or on a classical bus."""
        for row, vector, frame in zip(self.frames, self._vectors, frames, strict=True):
            packed = fd_packed(frame.packed) if fd else frame.packed
            row[: len(packed)], vector[1] = np.frombuffer(packed, np.uint8), len(packed)

    def frame(self, number: int) -> Frame:
        """Return one of the frames."""
        return Frame.from_packed(self.frames[number].tobytes())

    def unpacked(self, first: int, end: int) -> list[tuple[int, bytearray]]:
        """Return a range of the frames; each is an identifier with flags, and data."""
        unpacked = []
        for row in self.frames[first:end]:
            packed = row.tobytes()
            identifier, length = HEADER.unpack_from(packed)
            end = DATA_AT + (0 if identifier & REMOTE else length)
            unpacked.append((identifier, bytearray(packed[DATA_AT:end])))
        return unpacked


def packed_frames(frames: Sequence[Frame], *, fd: bool = False) -> PackedFrames:
    """Pack frames to send, on a CAN FD bus or on a classical bus."""
    result = PackedFrames(len(frames))
    result.fill(frames, fd=fd)
    return result
