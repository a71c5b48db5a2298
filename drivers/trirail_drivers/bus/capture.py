"""Every frame that passes a bus, noted down in the cycle and written to a file elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator

import can

from trirail_drivers.bus.can_frame import CAPTURED
from trirail_drivers.bus.frames import packed

CHUNK = 1024
"""Frames handed over at a time."""
KEPT = 100_000
"""Frames kept for somebody who does not take them; those after are dropped."""


class Capture:
    """Frames noted since they were last taken."""

    def __init__(self) -> None:
        self._frames = bytearray()

    def note(self, frame: bytes | bytearray, t: float) -> None:
        """Note a `struct can_frame` and its time, in seconds since 1970."""
        if len(self._frames) < KEPT * CAPTURED.size:
            self._frames += CAPTURED.pack(t, frame)

    def drain(self) -> Iterator[bytes]:
        """Hand over what has been noted, in chunks of at most CHUNK frames."""
        frames, self._frames = self._frames, bytearray()
        for start in range(0, len(frames), CHUNK * CAPTURED.size):
            yield bytes(frames[start : start + CHUNK * CAPTURED.size])


class CapturedBus(can.BusABC):
    """A bus whose frames are noted on their way."""

    def __init__(self, bus: can.BusABC, capture: Capture) -> None:
        self.inner = bus
        """The bus underneath."""
        self.capture = capture
        """Where its frames are noted."""
        self.channel_info = f"{bus.channel_info}, captured"
        super().__init__(channel=self.channel_info)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send and note a frame."""
        self.inner.send(msg, timeout)
        self.capture.note(packed(msg), time.time())

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Receive and note a frame."""
        frame = self.inner.recv(timeout)
        if frame is not None:
            self.capture.note(packed(frame), time.time())
        return frame

    def fileno(self) -> int:
        """As the bus underneath."""
        return self.inner.fileno()

    def shutdown(self) -> None:
        """Close the bus underneath."""
        super().shutdown()
        self.inner.shutdown()
