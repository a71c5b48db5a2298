"""Retention of recordings: deletion of the oldest when all together take too much space.

No file time decides here: a machine without a battery clock dates files years off until it has the network's time.
A file that is being written is locked, and the dates and numbers in the names give the order of files.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

BLACK_BOX = "fault-"
"""Prefix of the names of black boxes."""
_NAME = re.compile(r"(?P<name>[A-Za-z0-9_-]+)-(?P<date>\d{8}-\d{6})(-part(?P<part>\d+))?(-(?P<again>\d+))?\.rrd")
"""Names given by the recorder. Files with other names belong to users, and are never deleted."""


def sidecar(recording: Path) -> Path:
    """Return the file with the contents of a recording: demo-20260131-120000.rrd.json."""
    return recording.with_name(f"{recording.name}.json")


class _StoredRecording(NamedTuple):
    path: Path
    size: int
    order: tuple[bool, bool, str, str, int, int]
    """Sorting key: older recordings first, by date, part and number in the name, those of the running session last."""

    @property
    def files(self) -> list[Path]:
        """The recording, and the files beside it: the log of CAN frames, and the sidecar."""
        beside = (self.path, self.path.with_suffix(".log"), sidecar(self.path))
        return [path for path in beside if path.exists()]


def lock(path: Path) -> int:
    """Lock a file as being written, and return the descriptor that holds the lock; -1 where it cannot be opened."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return -1
    with contextlib.suppress(OSError):  # a network file system may have no locks
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    return descriptor


def unlock(descriptor: int) -> None:
    """Release the descriptor that `lock` returned."""
    if descriptor >= 0:
        os.close(descriptor)


def is_being_written(path: Path) -> bool:
    """Whether a recorder, of this or another process, has the file locked. Raises FileNotFoundError."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    finally:
        os.close(descriptor)
    return False


def tidy(directory: Path, at_most: float, session: str = "") -> list[Path]:
    """Delete the oldest recordings until all together take no more than `at_most` bytes; return the deleted ones.

    Recordings of the running `session` are deleted after all others, regardless of dates, and black boxes last. Files
    that are being written stay. Raises OSError if a file cannot be deleted.
    """
    recordings = sorted(_recordings(directory, session), key=lambda kept: kept.order)
    total = sum(kept.size for kept in recordings)
    deleted: list[Path] = []
    for kept in recordings:
        if total <= at_most:
            break
        try:
            if is_being_written(kept.path):
                continue
            for path in kept.files:
                path.unlink()
        except FileNotFoundError:  # another process deleted it just now
            pass
        else:
            deleted.append(kept.path)
        total -= kept.size
    return deleted


def _recordings(directory: Path, session: str) -> Iterator[_StoredRecording]:
    for path in directory.glob("*.rrd"):
        match = _NAME.fullmatch(path.name)
        if match is None:
            continue
        try:
            log = path.with_suffix(".log")
            size = path.stat().st_size + (log.stat().st_size if log.exists() else 0)
        except FileNotFoundError:
            continue
        name, date, part, again = match["name"], match["date"], int(match["part"] or 1), int(match["again"] or 1)
        own = session != "" and path.stem.startswith(session)
        yield _StoredRecording(path, size, (f"{name}-" == BLACK_BOX, own, date, name, part, again))
