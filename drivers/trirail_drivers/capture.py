"""Every frame that passes a bus, noted down in the cycle and written to a file elsewhere."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator

import can

FRAME = struct.Struct("<dHB8s")
"""A captured frame: seconds since 1970, identifier, length, data. The length of a remote frame has REMOTE added."""
REMOTE = 0x80
CHUNK = 1024
"""Frames handed over at a time."""
KEPT = 100_000
"""Frames kept for somebody who does not take them; those after are dropped."""


class Capture:
    """Frames noted since they were last taken."""

    def __init__(self) -> None:
        self._frames = bytearray()

    def note(self, frame: can.Message) -> None:
        """Note a frame, now."""
        if len(self._frames) < KEPT * FRAME.size:
            length = frame.dlc | REMOTE * frame.is_remote_frame
            self._frames += FRAME.pack(time.time(), frame.arbitration_id, length, bytes(frame.data))

    def take(self) -> Iterator[bytes]:
        """Hand over what has been noted, in chunks of at most CHUNK frames."""
        frames, self._frames = self._frames, bytearray()
        for start in range(0, len(frames), CHUNK * FRAME.size):
            yield bytes(frames[start : start + CHUNK * FRAME.size])


class CapturedBus(can.BusABC):
    """A bus whose frames are noted on their way."""

    def __init__(self, bus: can.BusABC, capture: Capture) -> None:
        self._bus = bus
        self._capture = capture
        self.channel_info = f"{bus.channel_info}, captured"
        super().__init__(channel=self.channel_info)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send and note a frame."""
        self._capture.note(msg)
        self._bus.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Receive and note a frame."""
        frame = self._bus.recv(timeout)
        if frame is not None:
            self._capture.note(frame)
        return frame

    def fileno(self) -> int:
        """As the bus underneath."""
        return self._bus.fileno()

    def shutdown(self) -> None:
        """Close the bus underneath."""
        super().shutdown()
        self._bus.shutdown()
