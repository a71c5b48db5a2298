"""How compiled code, which runs cycles, reaches a bus: on its socket, else by two functions of Python's.

These functions are called as libc's recvmmsg and sendmmsg are, and move the same frames in the same order, one by one.
What they meet is kept for whoever moves the next frame, and raised there: as if he had met it himself.
"""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Collection
from typing import Protocol

from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.bus.frame_io import FrameIO, Received, SocketFrames
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames

_CALL = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
"""Given the address of frames, `struct can_frame` one after the other, and how many these are."""


class LentFrames(FrameIO, Protocol):
    """Frames to and from a bus that somebody else may move for a while."""

    @property
    def access(self) -> BusAccess:
        """How he reaches the bus."""

    def hand_in(self, arrived: PackedFrames, number: int, error: int) -> None:
        """So many frames that he took and has not looked at, and the error that he met after them (errno.h).

        They come before all that is there.
        """


def lendable(frames: FrameIO) -> LentFrames:
    """Return frames that may be lent, on their socket where nothing has to know of each."""
    return frames if isinstance(frames, SocketFrames) and not frames.captured else FrameCalls(frames)


class FrameCalls:
    """Frames to and from any bus, moved by Python for whoever asks."""

    def __init__(self, frames: FrameIO) -> None:
        self._frames = frames
        self._taken: list[Received] = []
        """Frames that the function has taken last."""
        self._handed_in: deque[Received] = deque()
        self._failure: BaseException | None = None
        """With which receiving has failed, behind those handed in."""
        self._refusal: BaseException | None = None
        """With which the next frame has been refused."""
        self._calls = _CALL(self._receive_all), _CALL(self._send_all)
        receive, send = (ctypes.cast(call, ctypes.c_void_p).value or 0 for call in self._calls)
        self.access = BusAccess(-1, receive, send)

    def send(self, frame: Frame) -> None:
        """Send a frame at once, or raise."""
        if self._refusal is not None:
            error, self._refusal = self._refusal, None
            raise error
        self._frames.send(frame)

    def receive(self, timeout: float = 0.0) -> Received | None:
        """The next frame that has arrived, or arrives within `timeout` [s]; None where there is none left."""
        if self._handed_in:
            return self._handed_in.popleft()
        if self._failure is not None:
            error, self._failure = self._failure, None
            raise error
        return self._frames.receive(timeout)

    def hear(self, identifiers: Collection[int]) -> None:
        """As the frames themselves."""
        self._frames.hear(identifiers)

    def hand_in(self, arrived: PackedFrames, number: int, error: int) -> None:  # noqa: ARG002 - both are kept here
        """So many frames of those taken last have not been looked at."""
        self._handed_in.extend(self._taken[:number])

    def _receive_all(self, address: int, most: int) -> int:
        taken = self._taken = []
        try:
            while len(taken) < most and (received := self._frames.receive()) is not None:
                identifier, data = received
                ctypes.memmove(address, CAN_FRAME.pack(identifier, len(data), data), CAN_FRAME.size)
                taken.append(received)
                address += CAN_FRAME.size
        except BaseException as error:  # noqa: BLE001 - nothing gets through compiled code; it is raised behind that
            self._failure = error
            return ~len(taken)
        return len(taken)

    def _send_all(self, address: int, number: int) -> int:
        try:
            for sent in range(number):
                self._frames.send(Frame.of(ctypes.string_at(address + sent * CAN_FRAME.size, CAN_FRAME.size)))
        except BaseException as error:  # noqa: BLE001 - likewise
            self._refusal = error
            return sent
        return number
