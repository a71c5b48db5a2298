"""Rotated files of a session's recording; each file is complete in itself."""

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
"""Delay from the failure of a file to the first attempt with another one, and interval between further attempts [s]."""
TRIAL = 1 << 19
"""Size of the test data written to a new file [bytes]. It exceeds the initial content, whose writing is not checked."""

Open = Callable[[Path], rr.RecordingStream]
Close = Callable[[rr.RecordingStream], None]


class RotatedFiles:
    """Writes batches to the newest of several files.

    A new file begins on `turn`, or when the newest file fails or is deleted; `warn` receives a report of a deletion.
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
        """Reason why the most recently lost batch was lost."""
        self._first = path
        self._begin = begin
        self._end = end
        self._reserve = reserve
        self._clock = clock
        self._warn = warn
        self._number = 1
        self._lost_before = 0
        self._failed: list[tuple[rr.RecordingStream, Archive]] = []  # destroying them would wait for the disk
        self._retry: float | None = None
        self._lock = -1
        """Descriptor of the lock that shows other processes that the newest file is being written."""
        self._open()

    @property
    def lost(self) -> int:
        """Number of batches that did not reach any file."""
        return self._lost_before + self._archive.lost

    @property
    def trouble(self) -> str:
        """Reason why the last batch did not reach any file; empty if it did."""
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
        """Write a batch, or count it as lost, without waiting long for the disk."""
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
        """Continue in another file; if it cannot be written, stay in this file and return False."""
        number = self._number + 1
        try:
            path = claim(self._first.parent, f"{self._first.stem}-part{number}")
        except OSError:
            return False
        self._lost_before += self._archive.lost
        if self._archive.stuck:
            self._failed.append((self._stream, self._archive))
        else:
            self._archive.close()
        self._end(self._stream)
        retention.unlock(self._lock)
        self.path, self._number = path, number
        self._open()
        return True

    def close(self) -> None:
        """Finish the newest file, unless the disk is not responding."""
        self._archive.close()
        retention.unlock(self._lock)
        self._lock = -1

    def _open(self) -> None:
        self._lock = retention.lock(self.path)
        self._stream = self._begin(self.path)
        self._archive = Archive(self._stream, self.path, self._reserve)
        self._began = self._clock()


def claim(directory: Path, name: str) -> Path:
    """Create an empty file with an unused name. Raises OSError if it cannot be written."""
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
    """Check that data reaches the disk, since an empty file can be created even on a full disk. Raises OSError."""
    if os.write(descriptor, bytes(TRIAL)) < TRIAL:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    os.fsync(descriptor)
    os.ftruncate(descriptor, 0)
