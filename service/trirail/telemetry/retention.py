"""Retention of recordings: the oldest are deleted when all recordings together take too much space.

File times are not used, because a machine without a battery-backed clock dates files years off until it has the network
time. A file that is being written is locked, and the dates and numbers in the names determine the order of the files.
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
"""Pattern of names given by the recorder. Files with other names belong to users, and are never deleted."""


def sidecar(recording: Path) -> Path:
    """Return the path of the file with a recording's contents, such as demo-20260131-120000.rrd.json."""
    return recording.with_name(f"{recording.name}.json")


class _StoredRecording(NamedTuple):
    path: Path
    size: int
    order: tuple[bool, bool, str, str, int, int]
    """Sort key that puts older recordings first, by date, part and number in the name, and the running session last."""

    @property
    def files(self) -> list[Path]:
        """The recording and the files that belong to it: the log of CAN frames, and the sidecar."""
        beside = (self.path, self.path.with_suffix(".log"), sidecar(self.path))
        return [path for path in beside if path.exists()]


def lock(path: Path) -> int:
    """Lock a file that is being written.

    Return the descriptor that holds the lock, or -1 if the file cannot be opened.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return -1
    with contextlib.suppress(OSError):  # a network file system may not support locks
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    return descriptor


def unlock(descriptor: int) -> None:
    """Release the descriptor that `lock` returned."""
    if descriptor >= 0:
        os.close(descriptor)


def is_being_written(path: Path) -> bool:
    """Whether a recorder in this or another process has locked the file. Raises FileNotFoundError."""
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
    """Delete the oldest recordings until all together take no more than `at_most` bytes; return the deleted files.

    Recordings of the running `session` are deleted after all others, regardless of dates, and black boxes last. Files
    that are being written are kept. Raises OSError if a file cannot be deleted.
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
        except FileNotFoundError:  # another process has just deleted it
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
