"""Records of cycles, out of the batches that a recording has them in.

They are placed without pyarrow's to_numpy, which imports pandas wherever that is installed: 0.3 s.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from trirail.errors import ServiceError
from trirail.telemetry.columns import FIELDS, RECORD, SECOND, layout
from trirail.wire.records import DTYPE

BY_CYCLE = "cycle"
"""The field by which records are put in order."""
_LAYOUT = layout(DTYPE)
"""The records' fields, as they are in a file."""


class OlderRecordingWarning(UserWarning):
    """A recording was written before its records had all the fields that they have now."""


def read(
    batches: Sequence[pa.RecordBatch], path: Path
) -> tuple[NDArray[np.void], NDArray[np.float64], NDArray[np.datetime64]]:
    """Return records by rising cycle, with their times as `times` has them.

    Raises ServiceError, and warns of fields that were not written, as trirail.telemetry.reading.read says.
    """
    if not any(batch.num_rows for batch in batches):
        raise ServiceError(f"{path}: holds no records of cycles (entity {RECORD}): was it made by trirail?")
    parts = [batch.column(FIELDS.component).flatten() for batch in batches]
    for kind in {part.type for part in parts}:
        _check_layout(kind, path)
    records, end = np.zeros(sum(map(len, parts)), DTYPE), 0
    for part in parts:  # a batch at a time is in the processor's cache while its fields are placed
        end += len(part)
        _place(part, records[end - len(part) : end])
    t, wall = times(batches)
    if np.all(records["cycle"][1:] >= records["cycle"][:-1]):
        return records, t, wall
    order = np.argsort(records["cycle"], kind="stable")
    return records[order], t[order], wall[order]


def _check_layout(kind: pa.StructType, path: Path) -> None:
    """Warn of fields that records of this kind lack. Raises ServiceError where they have others, or no order."""
    if odd := set(kind) - set(_LAYOUT):
        names = ", ".join(sorted({field.name for field in odd}))
        raise ServiceError(f"{path}: written by another version: its records differ in {names}")
    there = {field.name for field in kind}
    if missing := [name for name in DTYPE.names or () if name not in there]:
        if BY_CYCLE in missing:
            raise ServiceError(f"{path}: written by another version: its records have no {BY_CYCLE}")
        warnings.warn(
            f"{path}: written by an older version: its records have no {', '.join(missing)}; read as NaN, or 0 where "
            "that is none",
            OlderRecordingWarning,
            stacklevel=4,
        )


def _place(part: pa.StructArray, records: NDArray[np.void]) -> None:
    """Write the fields of records that were read into records of zeros; floats that are not there are NaN."""
    there = {field.name: values for field, values in zip(part.type, part.flatten(), strict=True)}
    for name in DTYPE.names or ():
        values = there.get(name)
        if values is None:
            if np.issubdtype(DTYPE[name].base, np.floating):
                records[name] = np.nan
        else:
            flat = values.flatten() if records[name].ndim > 1 else values
            records[name] = np.from_dlpack(flat).reshape(records[name].shape)


def times(batches: Sequence[pa.RecordBatch]) -> tuple[NDArray[np.float64], NDArray[np.datetime64]]:
    """Return the times of rows: nominal, since the loop's start [s], and of the wall clock, UTC [ns]."""
    t, wall = (
        np.concatenate([np.from_dlpack(batch.column(timeline).view(pa.int64())) for batch in batches])
        for timeline in ("t", "wall")
    )
    return t / SECOND, wall.view("datetime64[ns]")
