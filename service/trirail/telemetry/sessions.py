"""Search for sessions in a folder of recordings. A summary next to each recording, its sidecar, is read if possible."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterable
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from msgspec import Struct

from trirail.telemetry import contents
from trirail.telemetry.contents import Contents
from trirail.telemetry.retention import STAMP, NameOrder, is_being_written, order_in


class SessionFilter(NamedTuple):
    """Conditions that a session must meet; None matches any value."""

    robot: str | None = None
    since: float | None = None
    """Earliest end of a session [s since 1970]."""
    until: float | None = None
    """Latest start of a session [s since 1970]."""
    fault: str | None = None
    """Text that the cause, the code (such as 0x8700) or the message of a fault must contain; case is ignored."""
    user: str | None = None
    """User who sent a goal or command. If `outcome` is given too, that user must have sent a goal with that outcome."""
    outcome: str | None = None


class RecordedSession(Struct):
    """Recorded session, which has several files if its recording was rotated."""

    session: str
    robot: str
    began: float | None
    """Start time [s since 1970]; None if nothing was recorded."""
    ended: float | None
    cycles: int
    files: list[str]
    reason: str | None
    """Message of the fault for which the black box was saved; None if the session is not a black box."""
    trouble: str | None
    """Reason why a file of the session could not be read; None if all files were read."""
    users: list[str]
    goals: dict[str, int]
    """Number of finished goals by outcome."""
    faults: list[str]
    """Messages of the session's faults, in order."""
    running: bool = False
    """True while the session is still being recorded. The values are then some seconds old."""
    lost_cycles: int = 0
    """Number of cycles that could not be written, for example because the disk was full."""
    duration: float = 0.0
    """Time that was recorded [s], even if the wall clock was set meanwhile."""


def recorded(folder: Path, *, reread: bool = False, on_read: Callable[[Path], None] | None = None) -> list[Contents]:
    """Return the contents of each recording in a folder, sorted by the name of the recording.

    A recording that is still being written is omitted until the recorder has written a sidecar for it. If a recording
    cannot be read, no sidecar is written, because the reason can lie outside the file: no space for a copy of it, no
    permission, or an older version of the software.

    Parameters
    ----------
    folder
        Folder of the recordings.
    reread
        True to read all recordings again and to rewrite their sidecars; False to read only recordings without a usable
        sidecar. A sidecar with `trouble`, from an earlier version, is not usable.
    on_read
        Function called with each recording before it is read.

    Raises
    ------
    OSError
        The folder cannot be listed.
    """
    listed = []
    # glob hides that a folder is unreadable
    recordings = [path for path in folder.iterdir() if path.suffix == ".rrd" and path.is_file()]
    for path in sorted(recordings, key=lambda path: path.name):
        known = contents.load(path)
        if known is None or known.running or known.trouble is not None or reread:
            try:
                being_written = is_being_written(path)
            except FileNotFoundError:
                continue
            if not being_written:  # a recording that is still marked as running was cut off
                if on_read is not None:
                    on_read(path)
                known = contents.read_contents(path)
                if known.trouble is None:
                    with contextlib.suppress(OSError):  # the folder belongs to another user: read it again next time
                        contents.save(path, known)
        if known is not None:
            listed.append(known)
    return listed


def find(files: Iterable[Contents], wanted: SessionFilter = SessionFilter()) -> list[RecordedSession]:  # noqa: B008 - a value, and never changed
    """Return the sessions that match a filter, in the order of their start, given the contents of all files."""
    parts_of: dict[str, list[Contents]] = {}
    for file in sorted(files, key=lambda file: _order(file, without_time="~")):
        parts_of.setdefault(file.session, []).append(file)
    wanted_parts = [parts for parts in parts_of.values() if _is_wanted(parts, wanted)]
    return [_joined(parts) for parts in sorted(wanted_parts, key=lambda parts: _order(parts[0], without_time=""))]


def _order(file: Contents, without_time: str) -> tuple[NameOrder, float]:
    """Return the sort key of a file: that in its name, which is right even if the clock was wrong, else its start."""
    order = order_in(file.name)
    if order is None:
        began = without_time if file.began is None else f"{datetime.fromtimestamp(file.began).astimezone():{STAMP}}"
        order = NameOrder(began, "")
    return order, file.began or 0.0


def unreadable(files: Iterable[Contents], matches: Iterable[RecordedSession]) -> list[str]:
    """Return the names of the files that cannot be read and of whose sessions it is thus unknown if they match."""
    listed = {name for session in matches for name in session.files}
    return [file.name for file in files if file.trouble is not None and file.name not in listed]


def fault_codes(files: Iterable[Contents]) -> list[str]:
    """Return the sorted causes and codes of the faults in files, such as "emcy 0x8700", without duplicates."""
    return sorted({entry.code for file in files for entry in file.faults})


def _joined(parts: list[Contents]) -> RecordedSession:
    goals = Counter[str]()
    for part in parts:
        for outcomes in part.goals.values():
            goals.update(outcomes)
    faults = sorted((entry for part in parts for entry in part.faults), key=lambda entry: entry.time)
    return RecordedSession(
        session=parts[0].session,
        robot=parts[0].robot,
        began=min((part.began for part in parts if part.began is not None), default=None),
        ended=max((part.ended for part in parts if part.ended is not None), default=None),
        cycles=sum(part.cycles for part in parts),
        files=[part.name for part in parts],
        reason=parts[0].reason,
        trouble=next((part.trouble for part in parts if part.trouble), None),
        users=sorted(set().union(*(part.users for part in parts))),
        goals=dict(sorted(goals.items())),
        faults=[entry.message for entry in faults],
        running=any(part.running for part in parts),
        lost_cycles=sum(part.lost_cycles for part in parts),
        duration=sum(part.duration for part in parts),
    )


def _is_wanted(parts: list[Contents], wanted: SessionFilter) -> bool:
    began = [part.began for part in parts if part.began is not None]
    ended = [part.ended for part in parts if part.ended is not None]
    if wanted.robot is not None and all(part.robot != wanted.robot for part in parts):
        return False
    if wanted.since is not None and not any(time >= wanted.since for time in ended):
        return False
    if wanted.until is not None and not any(time <= wanted.until for time in began):
        return False
    if wanted.fault is not None:
        words = wanted.fault.lower()
        if not any(words in f"{entry.code} {entry.message}".lower() for part in parts for entry in part.faults):
            return False
    if wanted.outcome is not None:
        whose = (goals for part in parts for user, goals in part.goals.items() if wanted.user in (None, user))
        return any(wanted.outcome in outcomes for outcomes in whose)
    return wanted.user is None or any(wanted.user in part.users for part in parts)
