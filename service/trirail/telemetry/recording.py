"""A recording in numpy, and selections of it: a time span, a goal, fewer rows, some columns, and those as a table."""

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
from trirail.wire.vocabulary import MODES

if TYPE_CHECKING:
    import pandas as pd

FIELD_NAMES = DTYPE.names or ()
TIMES = ("t", "wall")
"""Columns beside the fields: nominal time since the loop's start [s], and wall clock (UTC)."""
_COORDINATES = ("x", "y", "phi")
_SLIDERS = tuple(name.lower() for name in NAMES)
_ROUNDING = 1e-6
"""Tolerance of the time between two rows, so that 10 ms are ten cycles of a millisecond."""


class RecordedAlignment(NamedTuple):
    """Looks that a client reported of one alignment, calibration or check."""

    id: str
    """Prefix of the ids of its goals."""
    user: str
    purpose: str
    """One of alignment, calibration and check."""
    t: tuple[float, ...]
    """Nominal times at which its looks were reported, since the loop's start [s]."""
    looks: tuple[AlignmentLook, ...]
    """Looks in order. The last has the end; if an error or a calibration ended it, it is not one of the cameras."""

    @property
    def end(self) -> str:
        """Reason of its end; unknown where none was reported."""
        return self.looks[-1].end or "unknown"

    @property
    def marks(self) -> tuple[str, ...]:
        """Names of the marks that were found: the rows of `residuals`."""
        return tuple(sorted({mark.name for look in self.looks for mark in look.marks}))

    @property
    def residuals(self) -> NDArray[np.float64]:
        """Distance of each mark from its target at each look, (marks, looks) [m]; NaN where unknown."""
        ways = [
            {mark.name: math.hypot(*mark.to_go) for mark in look.marks if mark.to_go is not None} for look in self.looks
        ]
        rows = [[way.get(name, math.nan) for way in ways] for name in self.marks]
        return np.array(rows).reshape(len(self.marks), len(self.looks))


class Recording(NamedTuple):
    """Content of a recording."""

    name: str
    """Name of the robot and time of the begin; empty if the file has none."""
    records: NDArray[np.void]
    """Records of all cycles, (N,), of wire.records.DTYPE, by rising `cycle`, without those that missed the file."""
    t: NDArray[np.float64]
    """Nominal times of the records since the loop's start, (N,) [s]."""
    wall: NDArray[np.datetime64]
    """Wall-clock times of the records, (N,), UTC [ns]."""
    events: list[Line]
    """Lines of the log, in order."""
    texts: dict[str, str]
    """Text documents that hold for the whole session, by entity path: /configuration, /software."""
    requests: tuple[ControlInput, ...] = ()
    """Inputs of the control, in order: goals and commands, each with the cycle that took it, and disturbances."""

    def __repr__(self) -> str:
        """Return name, duration and numbers of cycles and events in one line."""
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
        """Return a part: from `begin` to `end` in `t` [s], during the `goal` of this id, one row `every` [s].

        Of the rows of each interval the first is taken, not a mean. All requests are kept, for looking up goals.
        Raises ServiceError where nothing is left, or there is no such goal.
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
            raise ServiceError(f"{self.name}: no cycles {asked}: it has those from {t[0]:.3f} to {t[-1]:.3f} s")
        if every is not None:
            if not every > 0.0:
                raise ServiceError(f"a row every {every:g} s: a positive time was expected, as 10ms")
            number = np.floor((t[rows] - t[rows[0]]) / every + _ROUNDING)
            rows = rows[np.concatenate([[True], np.diff(number) > 0])]
        first, last = t[rows[0]], t[rows[-1]]
        return self._replace(
            records=self.records[rows],
            t=t[rows],
            wall=self.wall[rows],
            events=[line for line in self.events if first <= line.t <= last],
        )

    @property
    def alignments(self) -> list[RecordedAlignment]:
        """Alignments, calibrations of cameras and checks that clients reported, in order, with every look."""
        return _alignments(self.events)

    def table(self, every: float | str | None = None, columns: Sequence[str] = ()) -> pd.DataFrame:
        """Return the records as a DataFrame of pandas, by `t` [s], one row `every` number of seconds, or as "10ms".

        SI units and radians; `columns` are names of fields, or words in names, as pose or error; all if absent. Columns
        of poses end in _x, _y, _phi, those of sliders in _a, _b, _c. Raises ServiceError for an unknown column.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ServiceError("a DataFrame needs pandas: pip install 'trirail[analysis]'") from error
        recording = self
        if every is not None:
            try:
                seconds = pd.Timedelta(every).total_seconds() if isinstance(every, str) else every
            except ValueError as error:
                raise ServiceError(f"a row every {quoted(str(every))}: a time was expected, as 10ms") from error
            recording = self.part(every=seconds)
        made: pd.DataFrame = table(recording, columns).to_pandas().set_index("t")
        return made


def table(recording: Recording, columns: Sequence[str] = ()) -> pa.Table:
    """Return the records as a table: t [s], wall (UTC), mode by its name, then the fields of wire.records.FIELDS.

    SI units and radians. Columns of sliders end in _a, _b, _c, of poses in _x, _y, _phi, of the parts of a cycle in
    their names. `columns` selects fields, behind t: each is a field's name, or a word in several names, as error or
    commanded. Raises ServiceError for an unknown column.
    """
    fields = chosen(columns)
    found: dict[str, pa.Array] = {"t": pa.array(recording.t)}
    if "wall" in fields:
        found["wall"] = pa.array(recording.wall)
    for name in fields:
        if name in FIELD_NAMES:
            found |= dict(_columns(name, recording.records[name]))
    return pa.table(found)


def chosen(columns: Sequence[str]) -> tuple[str, ...]:
    """Return the requested fields, each once, or all without a request. Raises ServiceError for an unknown word."""
    everything = ("wall", "mode", *(name for name in FIELD_NAMES if name != "mode"))
    found: list[str] = []
    for column in columns:
        exact = [name for name in (*TIMES, *everything) if name == column]
        meant = exact or [name for name in everything if column in name.split("_")]
        if not meant:
            words = dict.fromkeys(word for name in everything for word in (name, *name.split("_")))
            close = difflib.get_close_matches(column, words, n=1)
            hint = f"did you mean {close[0]}?" if close else f"a word of these was expected: {', '.join(everything)}"
            raise ServiceError(f"no column {quoted(column)}: {hint}")
        found += meant
    return tuple(dict.fromkeys(found)) if columns else everything


def _columns(name: str, values: NDArray[np.void]) -> Iterator[tuple[str, pa.Array]]:
    """Yield a field's columns with their names."""
    if name == "mode":
        yield name, pa.DictionaryArray.from_arrays(pa.array(values), pa.array([str(mode) for mode in MODES]))
    elif values.ndim == 1:
        yield name, pa.array(np.ascontiguousarray(values))
    else:
        ends = PART_NAMES if name == "parts_ns" else _COORDINATES if "pose" in name else _SLIDERS
        for place, end in enumerate(ends):
            yield f"{name}_{end}", pa.array(np.ascontiguousarray(values[:, place]))


def _goal(recording: Recording, goal: str) -> tuple[int, float]:
    """Return the cycle that took a goal, and the time of its end [s]; infinite where that is not recorded."""
    given = {what.given.id: what.cycle for what in reversed(recording.requests) if isinstance(what.given, GoalRequest)}
    ended = {line.event.id: line.t for line in recording.events if line.event is not None and line.event.kind == "goal"}
    if goal not in given:
        last = ", ".join(list(given)[:5]) or "none at all"
        raise ServiceError(f"{recording.name}: no goal {quoted(goal)} in it; the newest: {last}")
    return given[goal], ended.get(goal, np.inf)


def _alignments(events: Iterable[Line]) -> list[RecordedAlignment]:
    """Return the alignments in a log, in the order of their first looks."""
    found: dict[tuple[str, str, str], list[tuple[float, AlignmentLook]]] = {}
    for line in events:
        if line.event is not None and (look := line.event.alignment) is not None:
            found.setdefault((look.id, line.event.user or "", look.purpose), []).append((line.t, look))
    return [
        RecordedAlignment(*name, tuple(t for t, _ in told), tuple(look for _, look in told))
        for name, told in found.items()
    ]
