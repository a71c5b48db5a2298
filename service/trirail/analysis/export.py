"""A recording as one table, a row a cycle, for other programs: CSV or Parquet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pyarrow import csv, parquet

from trirail.errors import ServiceError
from trirail.telemetry.reading import Recording
from trirail.telemetry.recording_table import table

FORMATS = (".csv", ".parquet")
"""What a file's name may end in."""


def write(recording: Recording, path: Path, columns: Sequence[str] = ()) -> int:
    """Write the table of a recording, as CSV or Parquet by the end of the file's name; return its rows.

    `columns` as trirail.telemetry.recording_table.table has them. Raises ServiceError where one is none, the name ends
    otherwise, the file exists, or it cannot be written.
    """
    if path.suffix not in FORMATS:
        raise ServiceError(f"{path}: its name must end in {' or '.join(FORMATS)}")
    rows = table(recording, columns)
    try:
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
