"""Search for sessions in a folder of recordings, using the sidecars of the recordings."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from msgspec import Struct

from trirail.telemetry import contents
from trirail.telemetry.contents import Contents
from trirail.telemetry.retention import is_being_written


class SessionFilter(NamedTuple):
    """Filter for sessions; None matches any value."""

    robot: str | None = None
    since: float | None = None
    """Earliest end of a session [s since 1970]."""
    until: float | None = None
    """Latest start of a session [s since 1970]."""
    fault: str | None = None
    """Part of the cause, the code (such as 0x8700) or the message of a fault; case is ignored."""
    user: str | None = None
    """User who sent a goal or command; with `outcome`, user of a goal with that outcome."""
    outcome: str | None = None


class RecordedSession(Struct):
    """Recorded session, in one file or, if its recording was rotated, in several."""

    session: str
    robot: str
    began: float | None
    """Start time [s since 1970]; None if nothing was recorded."""
    ended: float | None
    cycles: int
    files: list[str]
    reason: str | None
    """Fault for which a black box was saved."""
    trouble: str | None
    """Reason why a file of the session could not be read."""
    users: list[str]
    goals: dict[str, int]
    """Number of finished goals by outcome."""
    faults: list[str]
    """Messages of the session's faults, in order."""
    running: bool = False
    """Whether the session is still being recorded, in which case these values are some seconds old."""


def recorded(folder: Path, *, reread: bool = False, on_read: Callable[[Path], None] | None = None) -> list[Contents]:
    """Return the contents of each recording in a folder, in the order of their names.

    A recording that is being written is omitted until its recorder has written its sidecar.

    Parameters
    ----------
    folder
        Folder of the recordings.
    reread
        Whether to read all recordings and write their sidecars again; otherwise, only recordings without a usable
        sidecar are read.
    on_read
        Function called with each recording before it is read.
    """
    listed = []
    for path in sorted(folder.glob("*.rrd"), key=lambda path: path.name):
        known = contents.load(path)
        if known is None or known.running or reread:
            try:
                being_written = is_being_written(path)
            except FileNotFoundError:
                continue
            if not being_written:  # a recording that is still marked as running was cut off
                if on_read is not None:
                    on_read(path)
                known = contents.read_contents(path)
                with contextlib.suppress(OSError):  # the folder belongs to another user: read it again the next time
                    contents.save(path, known)
        if known is not None:
            listed.append(known)
    return listed


def find(files: Iterable[Contents], wanted: SessionFilter = SessionFilter()) -> list[RecordedSession]:  # noqa: B008 - a value, and never changed
    """Return the sessions in files that match a filter, in the order of their start."""
    parts_of: dict[str, list[Contents]] = {}
    for file in sorted(files, key=lambda file: (file.began or 0.0, file.name)):
        parts_of.setdefault(file.session, []).append(file)
    return [_joined(parts) for parts in parts_of.values() if _is_wanted(parts, wanted)]


def fault_codes(files: Iterable[Contents]) -> list[str]:
    """Return the cause and code of each fault in files, without duplicates."""
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
