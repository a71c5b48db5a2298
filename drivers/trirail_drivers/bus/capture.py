"""Capture of every frame on a bus. The cycle buffers the frames here; the recorder writes them to a file."""

from __future__ import annotations

import time
from collections.abc import Iterator

import can

from trirail_drivers.bus.can_frame import CAPTURED
from trirail_drivers.bus.frames import fd_message, is_fd, packed
from trirail_drivers.bus.own_frames import OwnFrames

CHUNK_FRAMES = 1024
"""Maximum number of frames in a chunk."""
MAX_FRAMES = 100_000
"""Maximum number of buffered frames; further frames are dropped."""


class Capture:
    """Buffer of the captured frames that have not been drained."""

    def __init__(self) -> None:
        self._frames = bytearray()

    def note(self, frame: bytes | bytearray, t: float) -> None:
        """Add a `struct can_frame` or `struct canfd_frame` and its time, in seconds since 1970, if there is space."""
        if len(self._frames) < MAX_FRAMES * CAPTURED.size:
            self._frames += CAPTURED.pack(t, frame)

    def drain(self) -> Iterator[bytes]:
        """Yield the frames in chunks of at most CHUNK_FRAMES. Each is removed when the next is requested."""
        size = CHUNK_FRAMES * CAPTURED.size
        while self._frames:
            yield bytes(self._frames[:size])
            del self._frames[:size]


class CapturedBus(can.BusABC):
    """Bus that captures every frame."""

    def __init__(self, bus: can.BusABC, capture: Capture) -> None:
        self.inner = bus
        """The underlying bus."""
        self.capture = capture
        """Buffer of the captured frames."""
        self.channel_info = f"{bus.channel_info}, captured"
        self._own = OwnFrames(bus)
        self._can_protocol = bus.protocol
        super().__init__(channel=self.channel_info)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send and capture a frame."""
        self.inner.send(msg, timeout)
        self._own.note(msg)
        self.capture.note(packed(fd_message(msg) if is_fd(self.inner) else msg), time.time())

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Receive a frame, and capture it unless it is a frame of this end, which has already been captured."""
        frame = self.inner.recv(timeout)
        if frame is not None and not self._own.include(frame):
            self.capture.note(packed(frame), time.time())
        return frame

    def fileno(self) -> int:
        """Return the file descriptor of the underlying bus."""
        return self.inner.fileno()

    def shutdown(self) -> None:
        """Close the underlying bus."""
        super().shutdown()
        self.inner.shutdown()
