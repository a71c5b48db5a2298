"""Access to a bus for compiled cycles: the socket of the bus or, if the bus has no socket, two Python functions.

Compiled code calls the functions like libc's recvmmsg and sendmmsg. They move the same frames in the same order, one by
one. An exception cannot pass through compiled code, so the functions store it, and the next `send` or `receive` raises
it.
"""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Collection
from typing import Protocol

from trirail_drivers.bus.can_frame import CAN_FRAME, CANFD_FRAME
from trirail_drivers.bus.frame_io import FrameIO, Received, SocketFrames
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames

_CALL = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
"""Type of a C function whose arguments are the address and the number of consecutive rows of a PackedFrames."""


class SharedFrames(FrameIO, Protocol):
    """Access to a bus for Python and compiled code, which uses it only while Python does not."""

    @property
    def access(self) -> BusAccess:
        """Bus access for compiled code."""

    def put_back(self, arrived: PackedFrames, handled: int, number: int, error: int) -> None:
        """Put frames back that compiled code has received: `number`, of which it has handled the first `handled`.

        `receive` returns the remaining frames, and then raises `error` (errno.h) unless `error` is 0.
        """


def shared_frames(frames: FrameIO) -> SharedFrames:
    """Return access for compiled code as well: the socket of the bus, unless every frame must be captured."""
    return frames if isinstance(frames, SocketFrames) and not frames.captured else FrameCalls(frames)


class FrameCalls:
    """Frame access to any bus for compiled code; Python moves the frames."""

    def __init__(self, frames: FrameIO) -> None:
        self._frames = frames
        self._last_received: list[Received] = []
        """Frames from the last receiving call."""
        self._put_back: deque[Received] = deque()
        self._failure: BaseException | None = None
        """Exception raised while receiving, to be raised again after the frames that were put back."""
        self._refusal: BaseException | None = None
        """Exception raised while sending, to be raised again by the next `send`."""
        self._calls = _CALL(self._receive_all), _CALL(self._send_all)
        receive, send = (ctypes.cast(call, ctypes.c_void_p).value or 0 for call in self._calls)
        self.access = BusAccess(-1, receive, send)

    def send(self, frame: Frame) -> None:
        """Send a frame without waiting, or raise."""
        if self._refusal is not None:
            error, self._refusal = self._refusal, None
            try:
                raise error
            finally:
                del error  # its traceback keeps this frame, and the loop has no garbage collector to end such a cycle
        self._frames.send(frame)

    def receive(self, timeout: float = 0.0) -> Received | None:
        """Return the next frame that has arrived or arrives within `timeout` [s]; otherwise None."""
        if self._put_back:
            return self._put_back.popleft()
        if self._failure is not None:
            error, self._failure = self._failure, None
            try:
                raise error
            finally:
                del error  # as in `send`
        return self._frames.receive(timeout)

    def set_identifiers(self, identifiers: Collection[int]) -> None:
        """Restrict the received identifiers; see FrameIO."""
        self._frames.set_identifiers(identifiers)

    def put_back(self, arrived: PackedFrames, handled: int, number: int, error: int) -> None:  # noqa: ARG002 - frames and error are kept here
        """Put back the frames of the last receiving call; `receive` returns all except the first `handled` frames."""
        self._put_back.extend(self._last_received[handled:number])

    def _receive_all(self, address: int, most: int) -> int:
        frames = self._last_received = []
        try:
            while len(frames) < most and (received := self._frames.receive()) is not None:
                identifier, data = received
                ctypes.memmove(address, CAN_FRAME.pack(identifier, len(data), data), CAN_FRAME.size)
                frames.append(received)
                address += CANFD_FRAME.size
        except BaseException as error:  # noqa: BLE001 - no exception passes compiled code; the next receive raises it
            self._failure = error
            return ~len(frames)  # negative even if 0 frames were received
        return len(frames)

    def _send_all(self, address: int, number: int) -> int:
        try:
            for sent in range(number):
                packed = ctypes.string_at(address + sent * CANFD_FRAME.size, CAN_FRAME.size)
                self._frames.send(Frame.from_packed(packed))
        except BaseException as error:  # noqa: BLE001 - the next send raises it
            self._refusal = error
            return sent
        return number
