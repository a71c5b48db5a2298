"""Export of a recording as a table with one row per cycle, CSV or Parquet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pyarrow import csv, parquet

from trirail.errors import ServiceError
from trirail.telemetry.recording import Recording, table

FORMATS = (".csv", ".parquet")
"""Accepted file suffixes."""


def write(recording: Recording, path: Path, columns: Sequence[str] = ()) -> int:
    """Write the table of a recording, as CSV or Parquet by the file's suffix; return the number of rows.

    Parameters
    ----------
    recording
        Recording to export.
    path
        File to write.
    columns
        Names of columns, as in trirail.telemetry.recording.table; all if empty.

    Raises
    ------
    ServiceError
        A column or the suffix is unknown, the file exists, or it cannot be written.
    """
    if path.suffix not in FORMATS:
        raise ServiceError(f"{path}: its name must end in {' or '.join(FORMATS)}")
    rows = table(recording, columns)
    try:
        # Mode x: an existing file, say another export, is never overwritten.
        with path.open("xb") as file:
            if path.suffix == ".csv":
                csv.write_csv(rows, file)
            else:
                parquet.write_table(rows, file)
    except FileExistsError as error:
        raise ServiceError(f"{path} exists already: name another file") from error
    except OSError as error:
        raise ServiceError(f"cannot write {path}: {error.strerror or error}") from error
    return len(rows)
