"""Export of a recording as a table with one row per cycle or one row per switched output, as CSV, Parquet or numpy."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, Final

import numpy as np
import pyarrow as pa
from pyarrow import csv, parquet

from trirail.analysis.new_file import new_file
from trirail.errors import ServiceError
from trirail.telemetry.recording import Recording, table
from trirail.wire.marks import Switch, switch_rows

FORMATS = (".csv", ".parquet", ".npy")
"""Accepted file suffixes."""
SWITCHES: Final = pa.schema(
    [
        ("goal", pa.string()),
        ("mark", pa.int64()),
        ("output", pa.string()),
        ("value", pa.bool_()),
        ("cycle", pa.int64()),
        *((name, pa.float64()) for name in ("t", "time")),
        ("closed", pa.bool_()),
        *((f"{kind}_{name}", pa.float64()) for kind in ("commanded", "measured") for name in ("x", "y", "phi")),
    ]
)
"""Columns of the table of switches; lengths are in m, angles in rad, times in s."""


def write(recording: Recording, path: Path, columns: Sequence[str] = ()) -> int:
    """Write a recording as a table in the format of the file's suffix; return the number of rows.

    Parameters
    ----------
    recording
        Recording to export.
    path
        File to write.
    columns
        Names of columns, as in trirail.telemetry.recording.table; all columns if empty.

    Raises
    ------
    ServiceError
        A column or the suffix is unknown, or the file already exists or cannot be written.
    """
    return _write(path, lambda: table(recording, columns))


def write_switches(
    recording: Recording, path: Path, begin: float | None = None, end: float | None = None, goal: str | None = None
) -> int:
    """Write a table of the outputs that were switched on the paths of goals; return the number of rows.

    The table has one row per switched output. `path` and the errors are the same as for `write`, and the other
    parameters are those of `switches`. The columns are the fields of trirail.wire.marks.Switch; a field with several
    numbers has one column per number.
    """
    return _write(path, lambda: pa.Table.from_pylist(switch_rows(switches(recording, begin, end, goal)), SWITCHES))


def switches(
    recording: Recording, begin: float | None = None, end: float | None = None, goal: str | None = None
) -> tuple[Switch, ...]:
    """Return the switches of outputs on the paths of goals, in the order of their cycles.

    An event reports a switch up to 0.1 s later, and a pulse may end after its goal. A part of a recording may therefore
    lack switches: give the whole recording, and select by the times `begin` and `end` of the switches [s] or by a goal.
    """
    first, last = -math.inf if begin is None else begin, math.inf if end is None else end
    events = (line.event for line in recording.events if line.event is not None)
    chosen = (
        switch
        for event in events
        for switch in event.marks
        if first <= switch.t <= last and goal in (None, switch.goal)
    )
    return tuple(sorted(chosen, key=lambda switch: switch.cycle))


def _write(path: Path, make: Callable[[], pa.Table]) -> int:
    if path.suffix not in FORMATS:
        raise ServiceError(f"{path}: the name must end in {', '.join(FORMATS[:-1])} or {FORMATS[-1]}")
    rows = make()
    with new_file(path) as file:
        _WRITERS[path.suffix](rows, file)
    return len(rows)


def _save_numpy(rows: pa.Table, file: BinaryIO) -> None:
    """Write a structured array with one field per column."""
    columns = [column.to_numpy() for column in rows.columns]
    columns = [column.astype(str) if column.dtype == object else column for column in columns]
    array = np.empty(len(rows), [(name, column.dtype) for name, column in zip(rows.column_names, columns, strict=True)])
    for name, column in zip(rows.column_names, columns, strict=True):
        array[name] = column
    # numpy would write to the descriptor of a file itself, and ignore an error of its last write.
    writer: Any = SimpleNamespace(write=file.write)
    np.save(writer, array)


_WRITERS: Final[Mapping[str, Callable[[pa.Table, BinaryIO], None]]] = {
    ".csv": csv.write_csv,
    ".parquet": parquet.write_table,
    ".npy": _save_numpy,
}
