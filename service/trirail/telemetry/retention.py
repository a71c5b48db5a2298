"""Retention of recordings: the oldest recordings are deleted when all recordings together need too much space, or when
their disk is nearly full.

The age of a recording follows from the dates and numbers in its name, not from file times. On a machine without a
battery-backed clock, file times can be wrong by years until the machine has received the network time, which a machine
without a network never does. The recorder does not wait for it. Instead, it never gives a new recording an earlier date
than that of another recording in the folder. A file that is being written is locked, so that other processes do not
delete the file.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from trirail.naming import BLACK_BOX

MAGIC = b"RRF2"
"""First bytes of an RRD file: Rerun's crate re_log_encoding, src/rrd/frames.rs."""
_PART = re.compile(r"-part\d+(-\d+)?$")
_BLACK_BOX = re.compile(rf"{BLACK_BOX}-\d{{8}}-\d{{6}}")
_NAME = re.compile(
    r"(?P<name>[A-Za-z0-9_-]+)-(?P<date>\d{8}-\d{6})(-(?P<number>\d+))?"
    r"(-part(?P<part>\d+)(-(?P<again>\d+))?)?\.rrd"
)
"""Pattern of the file names that the recorder chooses. Files with other names belong to users and are never deleted.

The session and each part have a number if their name without it was in use.
"""


STAMP = "%Y%m%d-%H%M%S"
"""Format of the local time in a recording's name: its start time or, for a black box, the time of the fault."""


class NameOrder(NamedTuple):
    """Parts of the name of a recording, by which recordings are sorted in the order in which they were begun."""

    date: str
    name: str
    number: int = 1
    part: int = 1
    again: int = 1


def order_in(name: str) -> NameOrder | None:
    """Return the place of a file name in the order of recordings; None for names that the recorder did not choose."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    number, part, again = (int(match[key] or 1) for key in ("number", "part", "again"))
    return NameOrder(match["date"], match["name"], number, part, again)


def session_of(name: str) -> str:
    """Return the name of the session of a recording: the name of the session's first file, without suffix."""
    return _PART.sub("", name.removesuffix(".rrd"))


def name_in_order(directory: Path, name: str) -> str:
    """Return the name, without suffix, of a new recording in a folder, given a name with the present time.

    If the clock is behind the newest recording, the new one is dated one second after that. Names that are no dates are
    ignored.
    """
    own = order_in(f"{name}.rrd")
    for newest in sorted(filter(None, (order_in(path.name) for path in directory.glob("*.rrd"))), reverse=True):
        if own is None or own.date >= newest.date:
            break
        with contextlib.suppress(ValueError, OverflowError):
            date = datetime.strptime(newest.date, STAMP)  # noqa: DTZ007 - local time, of which only the text is needed
            return f"{own.name}-{date + timedelta(seconds=1):{STAMP}}"
    return name


def robot_in(name: str) -> str:
    """Return the robot in a file name that the recorder chose; "" for a black box and for other names."""
    match = _NAME.fullmatch(name)
    return match["name"] if match is not None and not is_black_box(name) else ""


def is_black_box(name: str) -> bool:
    """Return True if a file name begins like that of a black box, as that of a copy does."""
    return _BLACK_BOX.match(name) is not None


def sidecar(recording: Path) -> Path:
    """Return the path of a recording's sidecar, which contains a summary, such as demo-20260131-120000.rrd.json."""
    return recording.with_name(f"{recording.name}.json")


def delete(recording: Path) -> None:
    """Delete a recording with its log of CAN frames and its sidecar, as far as they exist. Raises OSError."""
    for path in (recording, recording.with_suffix(".log"), sidecar(recording)):
        path.unlink(missing_ok=True)


class _StoredRecording(NamedTuple):
    path: Path
    size: int
    order: tuple[bool, bool, NameOrder]
    """Sort key in the order of deletion.

    Recordings are sorted by date, number and part in their names, the running session after all others, and black boxes
    last.
    """


def lock(path: Path) -> int:
    """Lock a file while it is being written.

    Return a file descriptor, which must be passed to `unlock` later, or -1 if the file cannot be opened.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return -1
    with contextlib.suppress(OSError):  # a network file system may not support locks
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    return descriptor


def unlock(descriptor: int) -> None:
    """Close a descriptor that `lock` returned, which releases the lock."""
    if descriptor >= 0:
        os.close(descriptor)


def is_being_written(path: Path) -> bool:
    """Return True if a recorder in this or another process has locked the file. Raises FileNotFoundError."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # a FIFO would wait for a writer
    except PermissionError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    finally:
        os.close(descriptor)
    return False


class Space:
    """Free space of a disk that recordings should leave, as long as deleting recordings frees space.

    On some file systems, a deleted file frees no space, or not soon, and another program may fill the disk.
    """

    def __init__(self, wanted: float) -> None:
        self._wanted = wanted
        self._before = 0.0
        self._grows = True

    def shortage(self, free: float) -> float:
        """Return how much space to free, given the free space [bytes]; 0 while deleting recordings frees nothing."""
        self._before, self._grows = free, self._grows or free >= self._wanted
        return max(0.0, self._wanted - free) if self._grows else 0.0

    def note_deletion(self, free: float) -> None:
        """Compare the free space right after a deletion with that before it [bytes]."""
        self._grows = free > self._before


class Tidied(NamedTuple):
    """Result of a deletion of old recordings."""

    deleted: list[Path]
    errors: list[OSError]
    """Reasons why older recordings could not be deleted."""


def tidy(directory: Path, at_most: float, session: str = "", shortage: float = 0.0) -> Tidied:
    """Delete the oldest recordings until the others need at most `at_most` bytes and `shortage` bytes have become free.

    Because of a shortage, no black box is deleted: something else may be filling the disk. Recordings of the running
    `session` are deleted after those of other sessions, regardless of their dates. Black boxes are deleted last. A file
    that is being written is not deleted, and all such files count for at most half of `at_most`: a single large one
    would otherwise take the place of every other recording. A recording that cannot be deleted is reported and does not
    count, for the same reason.
    """
    try:
        recordings = sorted(_recordings(directory, session), key=lambda kept: kept.order)
    except OSError as error:
        return Tidied([], [error])
    if sum(kept.size for kept in recordings) <= at_most and shortage <= 0.0:
        return Tidied([], [])
    finished, errors = list[_StoredRecording](), list[OSError]()
    being_written = 0
    for kept in recordings:
        try:
            if is_being_written(kept.path):
                being_written += kept.size
            else:
                finished.append(kept)
        except FileNotFoundError:  # another process has just deleted the recording
            pass
        except OSError as error:
            errors.append(error)
    total = sum(kept.size for kept in finished) + min(being_written, at_most / 2.0)
    deleted = list[Path]()
    for kept in finished:
        is_black_box = kept.order[0]
        if total <= at_most and (shortage <= 0.0 or is_black_box):
            break
        try:
            delete(kept.path)
        except OSError as error:
            errors.append(error)
        else:
            deleted.append(kept.path)
            shortage -= kept.size
        total -= kept.size
    return Tidied(deleted, errors)


def _recordings(directory: Path, session: str) -> Iterator[_StoredRecording]:
    for path in directory.glob("*.rrd"):
        order = order_in(path.name)
        if order is None:
            continue
        try:
            log = path.with_suffix(".log")
            size = path.stat().st_size + (log.stat().st_size if log.exists() else 0)
        except OSError:  # another process has just deleted the recording, or it is a link that leads nowhere
            continue
        yield _StoredRecording(path, size, (is_black_box(path.name), session_of(path.name) == session, order))
