"""CAN frames as a log file in candump's format, which can-utils, python-can and Wireshark read."""

from __future__ import annotations

from pathlib import Path

from trirail_drivers.bus.capture import FRAME
from trirail_drivers.bus.frames import CAN_FRAME, ERROR, EXTENDED, EXTENDED_BITS, REMOTE, STANDARD_BITS


class CandumpLog:
    """A log of one bus's frames."""

    def __init__(self, path: Path, channel: str) -> None:
        self.failures = 0
        """Writes that the disk refused; their frames are missing."""
        self._channel = channel
        self._file = path.open("wb", buffering=0)

    def write(self, batch: bytes) -> None:
        """Append a batch of captured frames."""
        lines = "".join(f"({t:.6f}) {self._channel} {_written(frame)}\n" for t, frame in FRAME.iter_unpack(batch))
        try:
            self._file.write(lines.encode())
        except OSError:
            self.failures += 1

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _written(frame: bytes) -> str:
    """A `struct can_frame` in candump's words: 3 digits of an 11-bit identifier, 8 of others and of error frames."""
    identifier, length, data = CAN_FRAME.unpack(frame)
    if identifier & ERROR:
        name = f"{identifier & (ERROR | EXTENDED_BITS):08X}"
    elif identifier & EXTENDED:
        name = f"{identifier & EXTENDED_BITS:08X}"
    else:
        name = f"{identifier & STANDARD_BITS:03X}"
    return f"{name}#{'R' if identifier & REMOTE else data[:length].hex().upper()}"
