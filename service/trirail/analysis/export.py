"""A recording as one table, a row a cycle, for other programs: CSV or Parquet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv, parquet
from trirail_drivers.interface import NAMES

from trirail.errors import ServiceError
from trirail.telemetry.reading import Recording
from trirail.wire.records import DTYPE, PARTS
from trirail.wire.vocabulary import MODES

FORMATS = (".csv", ".parquet")
"""What a file's name may end in."""
_COORDINATES = ("x", "y", "phi")
_SLIDERS = tuple(name.lower() for name in NAMES)


def table(recording: Recording) -> pa.Table:
    """Return the records as a table: t [s], wall (UTC), mode by its name, then the fields of wire.records.FIELDS.

    SI units and radians. What there is of each slider ends in _a, _b, _c, of a pose in _x, _y, _phi, of the parts of a
    cycle in their names.
    """
    records = recording.records
    columns = {"t": pa.array(recording.t), "wall": pa.array(recording.wall), "mode": _modes(records["mode"])}
    for name in DTYPE.names or ():
        values = records[name]
        if name == "mode":
            continue
        if values.ndim == 1:
            columns[name] = pa.array(np.ascontiguousarray(values))
            continue
        ends = PARTS if name == "parts_ns" else _COORDINATES if "pose" in name else _SLIDERS
        for place, end in enumerate(ends):
            columns[f"{name}_{end}"] = pa.array(np.ascontiguousarray(values[:, place]))
    return pa.table(columns)


def write(recording: Recording, path: Path) -> int:
    """Write the table of a recording, as CSV or Parquet by the end of the file's name; return its rows.

    Raises ServiceError where the name ends otherwise, the file exists, or it cannot be written.
    """
    if path.suffix not in FORMATS:
        raise ServiceError(f"{path}: its name must end in {' or '.join(FORMATS)}")
    rows = table(recording)
    try:
        with path.open("xb") as file:
            if path.suffix == ".csv":
                csv.write_csv(rows, file)
            else:
                parquet.write_table(rows, file)
    except OSError as error:
        raise ServiceError(f"cannot write {path}: {error.strerror or error}") from error
    return len(rows)


def _modes(numbers: NDArray[np.uint8]) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(numbers), pa.array([str(mode) for mode in MODES]))
