"""Log files of CAN frames in candump's format, which can-utils, python-can and Wireshark read."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from trirail_drivers.bus.can_frame import (
    BIT_RATE_SWITCH,
    CAPTURED,
    DATA_AT,
    ERROR,
    ERROR_STATE,
    EXTENDED,
    EXTENDED_BITS,
    FD_FLAGS_AT,
    FD_FORMAT,
    HEADER,
    REMOTE,
    STANDARD_BITS,
)

from trirail.telemetry.sinks import RESERVE, disk_shortage, identity
from trirail.wire.event_codes import EventCode, EventText, coded


class CandumpLog:
    """Log file of the frames on one bus.

    Nothing is written while fewer than RESERVE bytes of the disk are free. If the file is deleted, it is created again,
    and `warn` receives a report.
    """

    def __init__(self, path: Path, channel: str, warn: Callable[[EventText], None] = lambda _: None) -> None:
        self.lost = 0
        """Number of batches that could not be written."""
        self.trouble = ""
        """Reason why the last batch could not be written; empty if it was written."""
        self._path = path
        self._channel = channel
        self._warn = warn
        self._begin("wb")

    def write(self, batch: bytes) -> None:
        """Append a batch of captured frames; if that fails, count the batch as lost."""
        self.trouble = self._append(batch)
        self.lost += bool(self.trouble)

    def _append(self, batch: bytes) -> str:
        """Append a batch completely or not at all; return the reason for a failure, or "" on success."""
        if identity(self._path) != self._identity:
            try:
                self._recreate()
            except OSError as error:
                return f"{self._path} was deleted or moved, and cannot be created again: {error.strerror}"
        if full := disk_shortage(self._path.parent, RESERVE):
            return full
        lines = "".join(
            f"({t:.6f}) {self._channel} {_format_frame(frame)}\n" for t, frame in CAPTURED.iter_unpack(batch)
        )
        content = lines.encode()
        try:
            written = self._file.write(content)
            if written == len(content):
                self._size += written
                return ""
            reason = os.strerror(errno.ENOSPC)
        except OSError as error:
            reason = error.strerror or str(error)
        with contextlib.suppress(OSError):  # a partial line would corrupt the next one
            self._file.truncate(self._size)
            self._file.seek(self._size)
        return f"{self._path} cannot be written: {reason}"

    def turn(self, path: Path) -> None:
        """Continue in another file. If that file cannot be created, continue in the present file."""
        present, before = self._path, self._file
        self._path = path
        try:
            self._begin("wb")
        except OSError:
            self._path = present
        else:
            before.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _begin(self, mode: Literal["wb", "xb"]) -> None:
        self._file, self._size = self._path.open(mode, buffering=0), 0
        self._identity = identity(self._path)

    def _recreate(self) -> None:
        deleted = self._file
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._begin("xb")  # a new file of this name belongs to another process: do not overwrite it
        deleted.close()
        words = f"{self._path} was deleted or moved, and has been created again"
        self._warn(coded(words, EventCode.CAPTURE_MOVED, file=str(self._path)))


def _format_frame(frame: bytes) -> str:
    """Format the first bytes of a `struct can_frame` or `struct canfd_frame` as candump does.

    An 11-bit identifier has 3 digits; a longer identifier and that of an error frame have 8 digits.
    """
    identifier, length = HEADER.unpack_from(frame)
    flags, data = frame[FD_FLAGS_AT], frame[DATA_AT:]
    if identifier & ERROR:
        name = f"{identifier & (ERROR | EXTENDED_BITS):08X}"
    elif identifier & EXTENDED:
        name = f"{identifier & EXTENDED_BITS:08X}"
    else:
        name = f"{identifier & STANDARD_BITS:03X}"
    content = data[:length].hex().upper()
    if flags & FD_FORMAT:
        return f"{name}##{flags & (BIT_RATE_SWITCH | ERROR_STATE):X}{content}"
    return f"{name}#{'R' if identifier & REMOTE else content}"
