"""CAN frames as a log file in candump's format, which can-utils, python-can and Wireshark read."""

from __future__ import annotations

from pathlib import Path

from trirail_drivers.capture import FRAME, REMOTE


class CandumpLog:
    """A log of one bus's frames."""

    def __init__(self, path: Path, channel: str) -> None:
        self.failures = 0
        """Writes that the disk refused; their frames are missing."""
        self._channel = channel
        self._file = path.open("wb", buffering=0)

    def write(self, batch: bytes) -> None:
        """Append a batch of captured frames."""
        lines = "".join(
            f"({t:.6f}) {self._channel} {identifier:03X}#{'R' if length & REMOTE else data[:length].hex().upper()}\n"
            for t, identifier, length, data in FRAME.iter_unpack(batch)
        )
        try:
            self._file.write(lines.encode())
        except OSError:
            self.failures += 1

    def close(self) -> None:
        """Close the file."""
        self._file.close()
