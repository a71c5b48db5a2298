"""Recording as numpy arrays, with methods to select a time span, a goal or fewer rows, and to return tables."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from trirail_drivers.interface import NAMES

from trirail.errors import ServiceError
from trirail.telemetry.journal import Line
from trirail.wire.looks import AlignmentLook
from trirail.wire.packets import ControlInput, GoalRequest
from trirail.wire.records import DTYPE, PART_NAMES
from trirail.wire.text import quoted
from trirail.wire.units import TIME, quantity
from trirail.wire.vocabulary import MODES

if TYPE_CHECKING:
    import pandas as pd

FIELD_NAMES = DTYPE.names or ()
TIMES = ("t", "wall")
"""Columns in addition to the record's fields: nominal time since the start of the loop [s], and wall clock (UTC)."""
_COORDINATES = ("x", "y", "phi")
_SLIDERS = tuple(name.lower() for name in NAMES)
_ROUNDING = 1e-6
"""Tolerance against rounding errors, as a fraction of the interval of rows.

With the tolerance, an interval of 10 ms is exactly ten cycles of one millisecond.
"""


class RecordedAlignment(NamedTuple):
    """Looks of one alignment, calibration or check, as reported by the client that ran it."""

    id: str
    """Prefix of the ids of the alignment's goals."""
    user: str
    purpose: str
    """One of alignment, calibration and check."""
    t: tuple[float, ...]
    """Nominal times at which the looks were reported, since the start of the loop [s]."""
    looks: tuple[AlignmentLook, ...]
    """Looks in order. The last entry has the reason for the end.

    If an error or a calibration ended the sequence, the last entry only reports the end, and is not a picture.
    """

    @property
    def end(self) -> str:
        """Reason why the alignment ended; "unknown" if no end was reported."""
        return self.looks[-1].end or "unknown"

    @property
    def marks(self) -> tuple[str, ...]:
        """Sorted names of the marks that were found, one for each row of `residuals`."""
        return tuple(sorted({mark.name for look in self.looks for mark in look.marks}))

    @property
    def residuals(self) -> NDArray[np.float64]:
        """Distance of each mark from its target in each look, (marks, looks) [m]; NaN if the distance is unknown."""
        ways = [
            {mark.name: math.hypot(*mark.to_go) for mark in look.marks if mark.to_go is not None} for look in self.looks
        ]
        rows = [[way.get(name, math.nan) for way in ways] for name in self.marks]
        return np.array(rows).reshape(len(self.marks), len(self.looks))


class Recording(NamedTuple):
    """Content of a recording."""

    name: str
    """Name of the recording, with the robot's name and the start time; empty if the file has no name."""
    records: NDArray[np.void]
    """Records that reached the file, (N,), in order of `cycle`; their type is wire.records.DTYPE."""
    t: NDArray[np.float64]
    """Nominal times of the records since the start of the loop, (N,) [s]."""
    wall: NDArray[np.datetime64]
    """Wall-clock times of the records, (N,), UTC [ns]."""
    events: list[Line]
    """Lines of the log of events, in order of time."""
    texts: dict[str, str]
    """Text documents that are valid for the whole session, by entity path: /configuration and /software."""
    requests: tuple[ControlInput, ...] = ()
    """Inputs to the control in order, such as goals, commands and disturbances, with the cycle that handled each."""

    def __repr__(self) -> str:
        """Return one line with the name, the duration, the number of cycles and the number of events."""
        duration = float(self.t[-1] - self.t[0]) if len(self.t) else 0.0
        name = self.name or "unnamed"
        return f"<Recording {name}: {duration:.1f} s, {len(self.records)} cycles, {len(self.events)} events>"

    def part(
        self,
        begin: float | None = None,
        end: float | None = None,
        *,
        goal: str | None = None,
        every: float | None = None,
    ) -> Recording:
        """Return a part of the recording.

        Parameters
        ----------
        begin, end
            First and last time `t` [s].
        goal
            Id of a goal. If it is given, only the cycles from the goal's acceptance to its end are returned.
        every
            Interval of the rows [s]. Of each interval, the first row is returned, not a mean.

        Returns
        -------
        Recording
            The part. It retains all requests of the recording, which are needed to look up goals.

        Raises
        ------
        ServiceError
            No row is left, or the goal is not in the recording.
        """
        t = self.t
        chosen = np.ones(len(t), np.bool)
        if goal is not None:
            first, last = _goal(self, goal)
            chosen &= (self.records["cycle"] >= first) & (t <= last)
        if begin is not None:
            chosen &= t >= begin
        if end is not None:
            chosen &= t <= end
        rows = np.flatnonzero(chosen)
        if not len(rows):
            words = {"of goal": goal and quoted(goal), "from": begin, "to": end}
            asked = " ".join(f"{word} {value}" for word, value in words.items() if value is not None)
            raise ServiceError(f"{self.name}: no cycles {asked}: the recording covers {t[0]:.3f} to {t[-1]:.3f} s")
        # Events before the first or after the last record belong to the beginning or to the end of the recording.
        earliest = t[rows[0]] if rows[0] > 0 else -math.inf
        latest = t[rows[-1]] if rows[-1] < len(t) - 1 else math.inf
        if every is not None:
            if not every > 0.0:
                raise ServiceError(f"the interval of the rows, {every:g} s, must be positive: use a time such as 10ms")
            number = np.floor((t[rows] - t[rows[0]]) / every + _ROUNDING)
            rows = rows[np.concatenate([[True], np.diff(number) > 0])]
        return self._replace(
            records=self.records[rows],
            t=t[rows],
            wall=self.wall[rows],
            events=[line for line in self.events if earliest <= line.t <= latest],
        )

    @property
    def alignments(self) -> list[RecordedAlignment]:
        """Alignments, camera calibrations and checks that clients reported, in order, with all of their looks."""
        return _alignments(self.events)

    def table(self, every: float | str | None = None, columns: Sequence[str] = ()) -> pd.DataFrame:
        """Return the records as a pandas DataFrame, indexed by `t` [s], in SI units and radians.

        Parameters
        ----------
        every
            Interval of the rows, in seconds or as text such as "10ms" or "0.01"; None for all rows.
        columns
            Names of fields, or words that occur in names, such as pose or error; all fields if empty. Columns of poses
            end in _x, _y, _phi, and columns of sliders end in _a, _b, _c.

        Raises
        ------
        ServiceError
            A column is unknown, or pandas is not installed.
        """
        try:
            import pandas as pd  # noqa: F401 - to_pandas needs it
        except ImportError as error:
            raise ServiceError("a DataFrame needs pandas: pip install 'trirail[analysis]'") from error
        recording = self
        if every is not None:
            try:
                seconds = quantity(every, TIME) if isinstance(every, str) else every
            except ValueError as error:
                raise ServiceError(f"the interval of the rows: {error}") from error
            recording = self.part(every=seconds)
        made: pd.DataFrame = table(recording, columns).to_pandas().set_index("t")
        return made


def table(recording: Recording, columns: Sequence[str] = ()) -> pa.Table:
    """Return the records as a table with SI units and radians.

    The columns are t [s], wall (UTC), the name of the mode, and the other fields of wire.records.FIELDS. Columns of
    sliders end in _a, _b, _c, columns of poses in _x, _y, _phi, and columns of the parts of a cycle in the name of the
    part. The position of a slider is valid only if the slider is homed, and the pose only if all sliders are. If
    `columns` is given, the table contains only t and the selected fields. A field is selected by its name or by a word
    in its name, such as error or commanded. Raises ServiceError for an unknown column.
    """
    fields = chosen(columns)
    table_columns: dict[str, pa.Array] = {"t": pa.array(recording.t)}
    if "wall" in fields:
        table_columns["wall"] = pa.array(recording.wall)
    for name in fields:
        if name in FIELD_NAMES:
            table_columns |= dict(_columns(name, recording.records[name]))
    return pa.table(table_columns)


def chosen(columns: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the requested fields without duplicates, or of all fields if `columns` is empty.

    Raises ServiceError if no field has a requested name or word.
    """
    everything = ("wall", "mode", *(name for name in FIELD_NAMES if name != "mode"))
    fields: list[str] = []
    for column in columns:
        exact = [name for name in (*TIMES, *everything) if name == column]
        matches = exact or [name for name in everything if column in name.split("_")]
        if not matches:
            words = dict.fromkeys(word for name in everything for word in (name, *name.split("_")))
            close = difflib.get_close_matches(column, words, n=1)
            hint = (
                f"did you mean {close[0]}?"
                if close
                else f"use one of these names, or a word of one: {', '.join(everything)}"
            )
            raise ServiceError(f"no column {quoted(column)}: {hint}")
        fields += matches
    return tuple(dict.fromkeys(fields)) if columns else everything


def _columns(name: str, values: NDArray[np.void]) -> Iterator[tuple[str, pa.Array]]:
    """Yield the name and the values of each column into which a field is split."""
    if name == "mode":
        yield name, pa.DictionaryArray.from_arrays(pa.array(values), pa.array([str(mode) for mode in MODES]))
    elif values.ndim == 1:
        yield name, pa.array(np.ascontiguousarray(values))
    else:
        ends = PART_NAMES if name == "parts_ns" else _COORDINATES if "pose" in name else _SLIDERS
        for place, end in enumerate(ends):
            yield f"{name}_{end}", pa.array(np.ascontiguousarray(values[:, place]))


def _goal(recording: Recording, goal: str) -> tuple[int, float]:
    """Return the cycle that accepted a goal, and the time at which the goal ended [s], or infinity if unrecorded."""
    taken_at = {
        item.given.id: item.cycle for item in reversed(recording.requests) if isinstance(item.given, GoalRequest)
    }
    ended = {line.event.id: line.t for line in recording.events if line.event is not None and line.event.kind == "goal"}
    if goal not in taken_at:
        last = ", ".join(list(taken_at)[:5]) or "none"
        raise ServiceError(f"{recording.name}: the recording has no goal {quoted(goal)}; its newest goals: {last}")
    return taken_at[goal], ended.get(goal, np.inf)


def _alignments(events: Iterable[Line]) -> list[RecordedAlignment]:
    """Return the alignments reported in a log, in the order of their first looks."""
    looks_of: dict[tuple[str, str, str], list[tuple[float, AlignmentLook]]] = {}
    for line in events:
        if line.event is not None and (look := line.event.alignment) is not None:
            looks_of.setdefault((look.id, line.event.user or "", look.purpose), []).append((line.t, look))
    return [
        RecordedAlignment(*name, tuple(t for t, _ in reported), tuple(look for _, look in reported))
        for name, reported in looks_of.items()
    ]
