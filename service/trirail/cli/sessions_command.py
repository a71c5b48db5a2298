"""`trirail sessions`: list recorded sessions, selected by robot, time, fault, user and outcome."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Sequence
from datetime import date, datetime, time
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter, Token, validators

from trirail.cli import terminal
from trirail.cli.options import Flag, Json
from trirail.errors import ServiceError
from trirail.telemetry import palette
from trirail.wire.messages import Outcome
from trirail.wire.text import quoted, wall_clock

if TYPE_CHECKING:
    from trirail.telemetry.sessions import RecordedSession

FOLDER = Path("recordings")
"""Default folder for recordings, which is correct for a service that was started in the current folder."""


def _moment(_: Any, tokens: Sequence[Token]) -> datetime:
    try:
        moment = datetime.fromisoformat(tokens[0].value)
        moment.timestamp()  # fails in the first days of year 1
    except (ValueError, OverflowError) as error:
        raise ValueError(
            f"{quoted(tokens[0].value)!r} is not a day or time such as 2026-01-31 or 2026-01-31T12:00:00"
        ) from error
    return moment


def _last_moment(kind: Any, tokens: Sequence[Token]) -> datetime:
    moment = _moment(kind, tokens)
    with contextlib.suppress(ValueError):  # not a day but a time
        return datetime.combine(date.fromisoformat(tokens[0].value), time.max)
    return moment


Moment = Annotated[datetime, Parameter(converter=_moment, n_tokens=1)]
"""The beginning of a day, or a time on a day, in local time."""
LastMoment = Annotated[datetime, Parameter(converter=_last_moment, n_tokens=1)]
"""The end of a day, or a time on a day, in local time."""


def sessions(
    folder: Path = FOLDER,
    /,
    *,
    robot: Annotated[str | None, Parameter(env_var="TRIRAIL_ROBOT")] = None,
    since: Moment | None = None,
    until: LastMoment | None = None,
    fault: Annotated[str | None, Parameter(validator=lambda _kind, words: _check_code(words))] = None,
    user: str | None = None,
    outcome: Outcome | None = None,
    last: Annotated[int, Parameter(validator=validators.Number(gte=0))] = 20,
    rebuild: Annotated[bool, Flag] = False,
    json: Json = False,
) -> int:
    """List recorded sessions, the newest last, running ones too.

    The list shows times, the outcomes of goals by user, faults, and the reasons for black boxes.

    A recording without a usable .json file beside it, for example after the service was killed, is read first.

    Parameters
    ----------
    folder
        Folder of recordings, as in [telemetry] directory. If absent, recordings/ in the current folder.
    robot
        Only sessions of this robot.
    since
        Only sessions that ended at this time or later: 2026-01-31 or 2026-01-31T12:00:00, local time.
    until
        Only sessions that began at this time, on this day, or earlier.
    fault
        Only sessions with a fault whose cause, code or message contains this text: emcy, 0x8700, "drive A".
    user
        Only sessions in which this user sent a goal or command.
    outcome
        Only sessions with a goal of this outcome; with --user, a goal of that user.
    last
        Maximum number of sessions to list, the newest ones; 0 for all.
    rebuild
        Read every recording, and write the .json file beside it again.
    """
    from trirail.telemetry.sessions import SessionFilter, fault_codes, find, recorded, unreadable

    if not folder.is_dir():
        raise ServiceError(f"{folder}: no such folder: use the folder of [telemetry] directory")
    wanted = SessionFilter(
        robot, since.timestamp() if since else None, until.timestamp() if until else None, fault, user, outcome
    )
    files = recorded(folder, reread=rebuild, on_read=_ReadingReport())
    matches = find(files, wanted)
    known = fault_codes(files) if fault is not None and not find(files, SessionFilter(fault=fault)) else []
    shown = matches[-last:] if last else matches
    unknown = unreadable(files, matches)
    if json:
        content = {"folder": str(folder), "found": len(matches), "sessions": msgspec.to_builtins(shown)}
        terminal.json(content | {"unreadable": unknown})
        return 0
    _print(shown, len(matches))
    if unknown:
        terminal.print_line(f"not listed, because they cannot be read: {', '.join(unknown)}")
    if known:
        terminal.print_line(f"no recorded fault contains {quoted(fault or '')}; known faults: {', '.join(known)}")
    return 0


def _check_code(words: str | None) -> None:
    """Refuse text that begins like a code but cannot be one. Codes have 16 bits or, on an ODrive, 32."""
    if words and words[:2].lower() == "0x" and re.fullmatch(r"[0-9a-fA-F]{0,8}", words[2:]) is None:
        raise ValueError(f"{quoted(words)!r} is not a code such as 0x8700")


REPORT_INTERVAL_S = 1.0
"""Interval at which the progress of reading recordings is printed [s]."""


class _ReadingReport:
    """Progress report that prints the recording being read if reading takes long."""

    def __init__(self) -> None:
        self._due = monotonic() + REPORT_INTERVAL_S
        self._count = 0

    def __call__(self, path: Path) -> None:
        self._count += 1
        if monotonic() >= self._due:
            self._due = monotonic() + REPORT_INTERVAL_S
            print(f"reading {path.name}, recording {self._count} without a usable .json", file=sys.stderr)  # noqa: T201


def _print(listed: list[RecordedSession], of: int) -> None:
    for session in listed:
        head = (
            f"[bold]{wall_clock(session.began) if session.began is not None else 'nothing recorded'}[/]",
            _lasted(session),
            "[bold]running[/]" if session.running else "",
            f"[bold]{terminal.plain(session.robot)}[/]",
            *(
                f"[{palette.code(palette.OUTCOMES[outcome])}]{times} {outcome}[/]"
                for outcome, times in session.goals.items()
            ),
            terminal.plain(", ".join(session.users)),
        )
        terminal.out.print("  ".join(filter(None, head)), soft_wrap=True)
        for line in filter(None, (*map(terminal.plain, session.files), _faults(session), _lost(session))):
            terminal.out.print(f"    {line}", soft_wrap=True)
    sessions = terminal.counted(of, "session")
    terminal.print_line(f"{len(listed)} of {sessions}" if len(listed) < of else sessions)


def _lasted(session: RecordedSession) -> str:
    if session.began is None:
        return ""
    minutes, seconds = divmod(round(session.duration), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}"


def _faults(session: RecordedSession) -> str:
    """Return the reason of a black box, or a session's first fault and the number of further ones."""
    if session.trouble is not None:
        return f"[yellow]{terminal.plain(session.trouble)}[/]"
    if session.reason is not None:
        return f"[bold red]kept for:[/] {terminal.plain(session.reason)}"
    if not session.faults:
        return ""
    more = len(session.faults) - 1
    return f"[red]{terminal.plain(session.faults[0])}[/]{f' and {more} more' if more else ''}"


def _lost(session: RecordedSession) -> str:
    """Return a warning if cycles could not be written; otherwise ""."""
    if not session.lost_cycles:
        return ""
    return f"[yellow]not recorded: {terminal.counted(session.lost_cycles, 'cycle')}, because writing failed[/]"
