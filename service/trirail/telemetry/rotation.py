"""Files of a session whose recording is rotated. Each file can be viewed without the others."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import rerun as rr
from rerun.chunk import Chunk

from trirail.telemetry import retention
from trirail.telemetry.sinks import Archive
from trirail.wire.event_codes import EventCode, EventText, coded

SOON, RETRY = 1.0, 10.0
"""Delay from a file's failure to the first attempt to begin another file, and interval between further attempts [s]."""
TRIAL = 1 << 19
"""Size of the test data written to a new file [bytes].

The test data is larger than the initial content of a recording, because the writing of that content is not checked.
"""

Open = Callable[[Path], rr.RecordingStream]
Close = Callable[[rr.RecordingStream], None]


class RotatedFiles:
    """Writer of batches to the newest of several files.

    A new file begins when `turn` is called, or when the newest file cannot be written or has been deleted. If the file
    was deleted, `warn` receives a report.
    """

    def __init__(
        self,
        path: Path,
        begin: Open,
        end: Close,
        reserve: int,
        clock: Callable[[], float],
        warn: Callable[[EventText], None] = lambda _: None,
    ) -> None:
        self.path = path
        """Newest file."""
        self.cause = ""
        """Reason why the most recently lost batch was lost; empty if no batch was lost."""
        self._first = path
        self._begin = begin
        self._end = end
        self._reserve = reserve
        self._clock = clock
        self._warn = warn
        self._number = 1
        self._lost_before = 0
        self._retry: float | None = None
        self._lock = -1
        """Descriptor of the lock by which other processes recognise that the newest file is being written."""
        self._open()

    @property
    def lost(self) -> int:
        """Number of batches that were not written to any file."""
        return self._lost_before + self._archive.lost

    @property
    def trouble(self) -> str:
        """Reason why the last batch could not be written; empty if it was written."""
        return self._archive.trouble

    @property
    def age(self) -> float:
        """Age of the newest file [s]."""
        return self._clock() - self._began

    @property
    def size(self) -> int:
        """Size of the newest file [bytes]."""
        try:
            return self.path.stat().st_size
        except OSError:
            return 0

    def write_chunks(self, chunks: list[Chunk]) -> None:
        """Write a batch without waiting long for the disk; if writing fails, count the batch as lost."""
        now = self._clock()
        if self._archive.gone and (self._retry is None or now >= self._retry):
            self._retry, deleted = now + RETRY, self.path
            if self.turn():
                words = f"{deleted} was deleted or moved; the recording continues in {self.path}"
                self._warn(coded(words, EventCode.RECORDING_MOVED, file=str(deleted), next=str(self.path)))
        self._archive.write_chunks(chunks)
        self.cause = self.trouble or self.cause
        if self._archive.gone:
            return
        if not self._archive.stuck:
            self._retry = None
        elif self._retry is None:
            self._retry = now + SOON
        elif now >= self._retry:
            self._retry = now + RETRY
            self.turn()

    def turn(self) -> bool:
        """Continue in another file and return True.

        If no other file can be written, continue in the present file and return False.
        """
        number = self._number + 1
        try:
            path = claim(self._first.parent, f"{self._first.stem}-part{number}")
        except OSError:
            return False
        self._lost_before += self._archive.lost
        self._archive.close()
        self._end(self._stream)
        retention.unlock(self._lock)
        self.path, self._number = path, number
        self._open()
        return True

    def close(self) -> None:
        """Finish the newest file, unless the disk does not respond."""
        self._archive.close()
        retention.unlock(self._lock)
        self._lock = -1

    def _open(self) -> None:
        self._lock = retention.lock(self.path)
        self._stream = self._begin(self.path)
        self._archive = Archive(self._stream, self.path, self._reserve)
        self._began = self._clock()


def claim(directory: Path, name: str) -> Path:
    """Create an empty recording file whose name begins with `name` and is unused; return the path of the file.

    Raises OSError if data cannot be written to the file.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path, number = directory / f"{name}.rrd", 1
    while True:
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        except FileExistsError:
            number += 1
            path = directory / f"{name}-{number}.rrd"
            continue
        try:
            _try(descriptor)
        except OSError:
            path.unlink()
            raise
        finally:
            os.close(descriptor)
        return path


def _try(descriptor: int) -> None:
    """Raise OSError if data does not reach the disk. Even on a full disk, an empty file can be created."""
    if os.write(descriptor, bytes(TRIAL)) < TRIAL:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    os.fsync(descriptor)
    os.ftruncate(descriptor, 0)
