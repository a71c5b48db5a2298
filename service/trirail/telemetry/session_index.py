"""The index of a folder of recordings, by which sessions are found without reading them: SQLite, beside the recordings.

It can be made anew from them at any time: one that is damaged or of another version is thrown away.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec import Struct

from trirail.telemetry.retention import IN_USE

if TYPE_CHECKING:
    from trirail.telemetry.contents import Contents

FILE: Final = "sessions.sqlite3"
VERSION: Final = 2
"""Of the tables below; with another one the index is made anew."""
PATIENCE: Final = 2.0
"""How long it is waited for others who write to the index [s]."""
_DAMAGED: Final = {sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}
"""Primary result codes of SQLite; the first one is an unknown table or column, since our SQL is right."""
_TABLES: Final = f"""
CREATE TABLE recording (name TEXT PRIMARY KEY, session TEXT NOT NULL, robot TEXT NOT NULL, began REAL, ended REAL,
                        cycles INTEGER NOT NULL, reason TEXT, trouble TEXT,
                        running INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE sender (name TEXT NOT NULL REFERENCES recording ON DELETE CASCADE, user TEXT NOT NULL);
CREATE TABLE goal (name TEXT NOT NULL REFERENCES recording ON DELETE CASCADE, user TEXT NOT NULL, outcome TEXT NOT NULL,
                   times INTEGER NOT NULL);
CREATE TABLE fault (name TEXT NOT NULL REFERENCES recording ON DELETE CASCADE, time REAL NOT NULL, cause TEXT NOT NULL,
                    drive TEXT NOT NULL, code INTEGER NOT NULL, message TEXT NOT NULL);
CREATE INDEX sender_name ON sender (name);
CREATE INDEX goal_name ON goal (name);
CREATE INDEX fault_name ON fault (name);
PRAGMA user_version = {VERSION};
"""


class Wanted(NamedTuple):
    """Which sessions; None for any."""

    robot: str | None = None
    since: float | None = None
    """Those that went on then or later [s since 1970]."""
    until: float | None = None
    """Those that had begun by then."""
    fault: str | None = None
    """Part of a fault's cause, code as 0x8700, or message, in small letters or large."""
    user: str | None = None
    """Who sent something; with `outcome`, whose goal ended so."""
    outcome: str | None = None


class RecordedSession(Struct):
    """A session, of one file or, where its recording was rotated, several."""

    session: str
    robot: str
    began: float | None
    """[s since 1970]; None where nothing was recorded."""
    ended: float | None
    cycles: int
    files: list[str]
    reason: str | None
    """Of a black box: the fault for which it was kept."""
    trouble: str | None
    """Why one of its files could not be read."""
    users: list[str]
    goals: dict[str, int]
    """How many ended, by outcome."""
    faults: list[str]
    """What was said of each, in order."""
    running: bool = False
    """Whether it is still being recorded: what is said of it is some seconds old."""


class SessionIndex:
    """The index of one folder. Raises sqlite3.Error where it cannot be read or written, but not for being damaged."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = folder / FILE

    def put(self, found: Iterable[Contents]) -> None:
        """Enter what is in files, in place of what stands there of them."""
        rows = list(found)

        def enter(index: sqlite3.Connection) -> None:
            for row in rows:
                _enter(index, row)

        self._do(enter)

    def forget(self, names: Collection[str]) -> None:
        """Take files out that are gone."""
        self._do(lambda index: index.executemany("DELETE FROM recording WHERE name = ?", [(name,) for name in names]))

    def clear(self) -> None:
        """Throw all of it away."""
        self._path.unlink(missing_ok=True)

    def update(self, read: Callable[[Path], Contents] | None = None, now: float | None = None) -> Iterator[Path]:
        """Make it agree with the folder: yield each file that it lacks, then read it; leave out those being written.

        One that is entered as running and is not being written was cut off: it is read as well.
        """
        known: set[str] = set()
        running: set[str] = set()

        def note_names(index: sqlite3.Connection) -> None:
            for name, runs in index.execute("SELECT name, running FROM recording"):
                (running if runs else known).add(name)

        self._do(note_names)
        there = {path.name: path for path in self._folder.glob("*.rrd")}
        if gone := (known | running) - set(there):
            self.forget(gone)
        free_since = (time.time() if now is None else now) - IN_USE
        for name in sorted(set(there) - known):
            try:
                being_written = there[name].stat().st_mtime > free_since
            except FileNotFoundError:
                continue
            if not being_written:
                yield there[name]
                self.put([(read or _read)(there[name])])

    def find(self, wanted: Wanted = Wanted()) -> list[RecordedSession]:  # noqa: B008 - a value, and never changed
        """Return the sessions that are wanted, in the order in which they began."""
        found: dict[str, RecordedSession] = {}

        def select_sessions(index: sqlite3.Connection) -> None:
            found.clear()
            found.update(_sessions(index, wanted))

        if self._do(select_sessions):
            for _ in self.update():  # it was thrown away: all of it is to be read again
                pass
            self._do(select_sessions)
        return list(found.values())

    def faults(self) -> list[str]:
        """Return every fault that is recorded, by cause and code, each once."""
        found: list[str] = []

        def select_faults(index: sqlite3.Connection) -> None:
            found.extend(said for (said,) in index.execute(f"SELECT DISTINCT {_CAUSE} FROM fault ORDER BY cause, code"))

        self._do(select_faults)
        return found

    def _do(self, what: Callable[[sqlite3.Connection], object]) -> bool:
        """Do something with the index in one transaction; whether it was damaged and has been made anew for that."""
        try:
            with self._opened() as index:
                what(index)
        except sqlite3.DatabaseError as error:
            if error.sqlite_errorcode & 0xFF not in _DAMAGED:
                raise
            self.clear()
            with self._opened() as index:
                what(index)
            return True
        return False

    @contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        with closing(sqlite3.connect(self._path, timeout=PATIENCE)) as index, index:
            (version,) = index.execute("PRAGMA user_version").fetchone()
            if version != VERSION:
                index.executescript(_TABLES)  # fails where there are those of another version: it is made anew then
            index.execute("PRAGMA foreign_keys = ON")
            index.execute("BEGIN")
            yield index


def _read(path: Path) -> Contents:
    from trirail.telemetry.contents import of_file  # Rerun, which is most of what to start takes

    return of_file(path)


def _enter(index: sqlite3.Connection, row: Contents) -> None:
    name = row.name
    index.execute("DELETE FROM recording WHERE name = ?", (name,))
    index.execute(
        "INSERT INTO recording VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (name, row.session, row.robot, row.began, row.ended, row.cycles, row.reason, row.trouble, row.running),
    )
    index.executemany("INSERT INTO sender VALUES (?, ?)", [(name, user) for user in row.users])
    goals = [(name, user, outcome, times) for (user, outcome), times in row.goals.items()]
    index.executemany("INSERT INTO goal VALUES (?, ?, ?, ?)", goals)
    faults = [(name, when, fault.cause, fault.drive, fault.code, words) for when, fault, words in row.faults]
    index.executemany("INSERT INTO fault VALUES (?, ?, ?, ?, ?, ?)", faults)


def _sessions(index: sqlite3.Connection, wanted: Wanted) -> dict[str, RecordedSession]:
    conditions, values = _conditions(wanted)
    index.execute("CREATE TEMP TABLE chosen (session TEXT PRIMARY KEY)")
    index.execute(
        "INSERT INTO chosen SELECT session FROM recording GROUP BY session "
        + (f"HAVING {' AND '.join(conditions)}" if conditions else ""),
        values,
    )
    found: dict[str, RecordedSession] = {}
    of_chosen = "FROM recording JOIN chosen USING (session)"
    for name, session, *rest in index.execute(
        f"SELECT name, session, robot, began, ended, cycles, reason, trouble, running {of_chosen} ORDER BY began, name"
    ):
        robot, began, ended, cycles, reason, trouble, running = rest
        if session not in found:
            found[session] = RecordedSession(session, robot, began, ended, 0, [], reason, trouble, [], {}, [])
        known = found[session]
        known.files.append(name)
        known.cycles += cycles
        known.ended = max(filter(None, (known.ended, ended)), default=None)
        known.trouble = known.trouble or trouble
        known.running = known.running or bool(running)
    for session, user in index.execute(f"SELECT DISTINCT session, user {of_chosen} JOIN sender USING (name)"):
        found[session].users.append(user)
    for session, outcome, times in index.execute(
        f"SELECT session, outcome, sum(times) {of_chosen} JOIN goal USING (name) GROUP BY session, outcome"
    ):
        found[session].goals[outcome] = times
    for session, message in index.execute(
        f"SELECT session, message {of_chosen} JOIN fault USING (name) ORDER BY fault.time"
    ):
        found[session].faults.append(message)
    index.execute("DROP TABLE chosen")
    return found


def _conditions(wanted: Wanted) -> tuple[list[str], list[str | float]]:
    """What must hold of a session's files together, and the values for it."""
    has = "session IN (SELECT session FROM recording JOIN {} USING (name) WHERE {})"
    asked: list[tuple[str, str | float | None]] = [
        ("max(robot) = ?", wanted.robot),
        ("max(ended) >= ?", wanted.since),
        ("min(began) <= ?", wanted.until),
        (has.format("fault", f"instr(lower({_SAID}), lower(?))"), wanted.fault),
    ]
    conditions = [(condition, [value]) for condition, value in asked if value is not None]
    if wanted.outcome is not None and wanted.user is not None:
        conditions.append((has.format("goal", "outcome = ? AND user = ?"), [wanted.outcome, wanted.user]))
    elif wanted.outcome is not None:
        conditions.append((has.format("goal", "outcome = ?"), [wanted.outcome]))
    elif wanted.user is not None:
        conditions.append((has.format("sender", "user = ?"), [wanted.user]))
    return [condition for condition, _ in conditions], [value for _, values in conditions for value in values]


_CAUSE: Final = "cause || ' ' || printf('0x%04X', code)"
_SAID: Final = f"{_CAUSE} || ' ' || message"
