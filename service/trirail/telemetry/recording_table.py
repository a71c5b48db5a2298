"""Of a recording what one wants, a stretch, a goal, fewer rows, some columns, and that as a table."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from trirail_drivers.interface import NAMES

from trirail.errors import ServiceError
from trirail.wire.packets import GoalRequest
from trirail.wire.records import DTYPE, PARTS
from trirail.wire.text import quoted
from trirail.wire.vocabulary import MODES

if TYPE_CHECKING:
    import pandas as pd

    from trirail.telemetry.reading import Recording

FIELD_NAMES = DTYPE.names or ()
TIMES = ("t", "wall")
"""What else there is of a cycle: nominal time since the loop's start [s], and wall clock (UTC)."""
_COORDINATES = ("x", "y", "phi")
_SLIDERS = tuple(name.lower() for name in NAMES)
_ROUNDING = 1e-6
"""Of a row's distance from the one before, so that 10 ms are ten cycles of a millisecond."""


def part(
    recording: Recording,
    begin: float | None = None,
    end: float | None = None,
    *,
    goal: str | None = None,
    every: float | None = None,
) -> Recording:
    """Return what trirail.telemetry.reading.Recording.part says."""
    t = recording.t
    chosen = np.ones(len(t), np.bool)
    if goal is not None:
        first, last = _goal(recording, goal)
        chosen &= (recording.records["cycle"] >= first) & (t <= last)
    if begin is not None:
        chosen &= t >= begin
    if end is not None:
        chosen &= t <= end
    rows = np.flatnonzero(chosen)
    if not len(rows):
        words = {"of goal": goal and quoted(goal), "from": begin, "to": end}
        asked = " ".join(f"{word} {value}" for word, value in words.items() if value is not None)
        raise ServiceError(f"{recording.name}: no cycles {asked}: it has those from {t[0]:.3f} to {t[-1]:.3f} s")
    if every is not None:
        if not every > 0.0:
            raise ServiceError(f"a row every {every:g} s: a positive time was expected, as 10ms")
        number = np.floor((t[rows] - t[rows[0]]) / every + _ROUNDING)
        rows = rows[np.concatenate([[True], np.diff(number) > 0])]
    first, last = t[rows[0]], t[rows[-1]]
    return recording._replace(
        records=recording.records[rows],
        t=t[rows],
        wall=recording.wall[rows],
        events=[line for line in recording.events if first <= line.t <= last],
    )


def table(recording: Recording, columns: Sequence[str] = ()) -> pa.Table:
    """Return the records as a table: t [s], wall (UTC), mode by its name, then the fields of wire.records.FIELDS.

    SI units and radians. What there is of each slider ends in _a, _b, _c, of a pose in _x, _y, _phi, of the parts of a
    cycle in their names. Of `columns` those fields alone, behind t: a field's name, or a word of several names, as
    error or commanded. Raises ServiceError where a column is none.
    """
    fields = chosen(columns)
    found: dict[str, pa.Array] = {"t": pa.array(recording.t)}
    if "wall" in fields:
        found["wall"] = pa.array(recording.wall)
    for name in fields:
        if name in FIELD_NAMES:
            found |= dict(_columns(name, recording.records[name]))
    return pa.table(found)


def frame(recording: Recording, every: float | str | None, columns: Sequence[str] = ()) -> pd.DataFrame:
    """Return what trirail.telemetry.reading.Recording.table says."""
    try:
        import pandas as pd
    except ImportError as error:
        raise ServiceError("a DataFrame needs pandas: pip install 'trirail[analysis]'") from error
    if every is not None:
        try:
            seconds = pd.Timedelta(every).total_seconds() if isinstance(every, str) else every
        except ValueError as error:
            raise ServiceError(f"a row every {quoted(str(every))}: a time was expected, as 10ms") from error
        recording = part(recording, every=seconds)
    made: pd.DataFrame = table(recording, columns).to_pandas().set_index("t")
    return made


def chosen(columns: Sequence[str]) -> tuple[str, ...]:
    """Return the fields that are asked for, each once, all where none is. Raises ServiceError where a word is none."""
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
        ends = PARTS if name == "parts_ns" else _COORDINATES if "pose" in name else _SLIDERS
        for place, end in enumerate(ends):
            yield f"{name}_{end}", pa.array(np.ascontiguousarray(values[:, place]))


def _goal(recording: Recording, goal: str) -> tuple[int, float]:
    """Return the cycle in which a goal was given, and when it ended [s]; infinite where that is not recorded."""
    given = {what.given.id: what.cycle for what in reversed(recording.requests) if isinstance(what.given, GoalRequest)}
    ended = {line.event.id: line.t for line in recording.events if line.event is not None and line.event.kind == "goal"}
    if goal not in given:
        last = ", ".join(list(given)[:5]) or "none at all"
        raise ServiceError(f"{recording.name}: no goal {quoted(goal)} in it; the newest: {last}")
    return given[goal], ended.get(goal, np.inf)
