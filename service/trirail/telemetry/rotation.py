"""The files of a session's recording, one after the other, each complete in itself."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import rerun as rr
from rerun.chunk import Chunk

from trirail.telemetry.sinks import Archive

SOON, RETRY = 1.0, 10.0
"""How long after a file has failed another one is tried, and how often from then on [s]."""
TRIAL = 1 << 19
"""What a new file must take before it is trusted [bytes]: more than it begins with, whose writing is not watched."""

Open = Callable[[Path], rr.RecordingStream]
Close = Callable[[rr.RecordingStream], None]


class RotatedFiles:
    """Takes batches into the newest file; `turn` begins another one, and so does a file that fails, or that is deleted.

    `warn` is told of the latter.
    """

    def __init__(
        self,
        path: Path,
        begin: Open,
        end: Close,
        reserve: int,
        clock: Callable[[], float],
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.path = path
        """The newest file."""
        self.cause = ""
        """Why the newest of the lost batches was lost."""
        self._first = path
        self._begin = begin
        self._end = end
        self._reserve = reserve
        self._clock = clock
        self._warn = warn
        self._number = 1
        self._lost_before = 0
        self._failed: list[tuple[rr.RecordingStream, Archive]] = []  # to destroy them would wait for their disk
        self._retry: float | None = None
        self._open()

    @property
    def lost(self) -> int:
        """Batches that are in no file."""
        return self._lost_before + self._archive.lost

    @property
    def trouble(self) -> str:
        """Why the last batch is in no file; empty if it is in one."""
        return self._archive.trouble

    @property
    def age(self) -> float:
        """How long ago the newest file was begun [s]."""
        return self._clock() - self._began

    @property
    def size(self) -> int:
        """How large the newest file is [bytes]."""
        try:
            return self.path.stat().st_size
        except OSError:
            return 0

    def write_chunks(self, chunks: list[Chunk]) -> None:
        """Write a batch, or count it as lost. Waits for the disk, but not for long."""
        now = self._clock()
        if self._archive.gone and (self._retry is None or now >= self._retry):
            self._retry, deleted = now + RETRY, self.path
            if self.turn():
                self._warn(f"{deleted} has been deleted or moved: the recording goes on in {self.path}")
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
        """Go on in another file; False, and it goes on in this one, where that cannot be written."""
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
        self.path, self._number = path, number
        self._open()
        return True

    def close(self) -> None:
        """Complete the newest file, unless the disk is stuck."""
        self._archive.close()

    def _open(self) -> None:
        self._stream = self._begin(self.path)
        self._archive = Archive(self._stream, self.path, self._reserve)
        self._began = self._clock()


def claim(directory: Path, name: str) -> Path:
    """Create an empty file with a name that is not taken. Raises OSError where one cannot be written."""
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
    """See whether what is written to a file gets to the disk: an empty file can be made on one that is full."""
    if os.write(descriptor, bytes(TRIAL)) < TRIAL:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    os.fsync(descriptor)
    os.ftruncate(descriptor, 0)
