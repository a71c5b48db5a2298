"""Conversion of arrays to Rerun columns, for many entities per call, which is much faster than one call per entity."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

SECOND = 1_000_000_000  # [ns]
GOAL = "/robot/goal"
"""Entity path of the outline of the platform at the goal."""
RECORD, FIELDS = "/record", rr.ComponentDescriptor("fields")
"""Entity path and component that store the complete record of each cycle in a recording."""


class Column(NamedTuple):
    """Values of one component of one entity, with one list of values per time."""

    path: str
    kind: rr.ComponentDescriptor
    values: pa.ListArray


class Timelines:
    """Timelines that all data have: `t`, the nominal time since the start of the loop, and `wall`, the wall clock."""

    def __init__(self, rate_hz: int, wall_offset_ns: int) -> None:
        self._rate_hz = rate_hz
        self._wall_offset_ns = wall_offset_ns

    def for_records(self, records: NDArray[np.void]) -> dict[str, pa.Array]:
        """Return the times of records on both timelines.

        The steps of `t` are exact if the period of the loop is a whole number of nanoseconds.
        """
        # The cycles times 1e9 would exceed 64 bits after 107 days at 1 kHz.
        seconds, rest = np.divmod(records["cycle"], self._rate_hz)
        t = seconds * SECOND + rest * SECOND // self._rate_hz
        return times(t, records["deadline_ns"] + self._wall_offset_ns)


def times(t: NDArray[np.int64], wall: NDArray[np.int64]) -> dict[str, pa.Array]:
    """Return times in nanoseconds as Arrow arrays, by the name of their timeline."""
    return {
        "t": pa.array(t.astype("timedelta64[ns]")),
        "wall": pa.array(wall.astype("datetime64[ns]")),
    }


def chunks(times: dict[str, pa.Array], columns: Iterable[Column]) -> list[Chunk]:
    """Return columns that have the same times as Rerun chunks, with one chunk per entity."""
    arrays = list(times.values())
    fields = [pa.field(name, array.type) for name, array in times.items()]
    for path, kind, values in columns:
        metadata = {"rerun:entity_path": path, "rerun:component": kind.component}
        if kind.archetype and kind.component_type:
            metadata |= {"rerun:archetype": kind.archetype, "rerun:component_type": kind.component_type}
        arrays.append(values)
        fields.append(pa.field(f"{path}:{kind.component}", values.type, metadata=metadata))
    batch = pa.record_batch(arrays, schema=pa.schema(fields))
    return Chunk.from_record_batch(batch, index=list(times))


def scalars(values: NDArray[np.float64]) -> pa.ListArray:
    """Convert an array (N, k) to N rows of k numbers."""
    return _lists(pa.array(_flat(values)), values.shape[1])


def vectors(values: NDArray[np.float64]) -> pa.ListArray:
    """Convert an array (N, k, d) to N rows of k vectors in single precision."""
    return _lists(_vectors(values), values.shape[1])


def strips(values: NDArray[np.float64]) -> pa.ListArray:
    """Convert an array (N, m, k, d) to N rows of m lines, each through k points, in single precision."""
    points = _vectors(values)
    return _lists(_lines(points, np.arange(0, len(points) + 1, values.shape[2])), values.shape[1])


def ragged(rows: Sequence[Sequence[NDArray[np.float64]]]) -> pa.ListArray:
    """Convert rows of lines to single precision.

    Each row contains any number of lines, and each line any number k of points, (k, 2).
    """
    lines = [line for row in rows for line in row]
    points = _vectors(np.concatenate([np.empty((0, 2)), *lines]))
    ends = np.cumsum([0, *map(len, rows)], dtype=np.int32)
    return pa.ListArray.from_arrays(ends, _lines(points, np.cumsum([0, *map(len, lines)])))


def layout(kind: np.dtype[Any]) -> pa.StructType:
    """Return the Arrow type that a record of dtype `kind` has in a file."""
    fields = []
    for name in kind.names or ():
        base, shape = kind[name].base, kind[name].shape
        value = pa.from_numpy_dtype(base)
        fields.append((name, pa.list_(value, *shape) if shape else value))
    return pa.struct(fields)


def structs(records: NDArray[np.void]) -> pa.ListArray:
    """Convert records to rows, each with one struct that has the fields of the record."""
    names = records.dtype.names or ()
    fields = []
    for values in (records[name] for name in names):
        flat = pa.array(_flat(values))
        fields.append(flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1]))
    return _lists(pa.StructArray.from_arrays(fields, names), 1)


def _vectors(values: NDArray[np.float64]) -> pa.FixedSizeListArray:
    kind = pa.list_(pa.field("item", pa.float32(), nullable=False), values.shape[-1])
    return pa.FixedSizeListArray.from_arrays(pa.array(_flat(values.astype(np.float32))), type=kind)


def _lines(points: pa.Array, ends: NDArray[np.integer]) -> pa.ListArray:
    kind = pa.list_(pa.field("item", points.type, nullable=False))
    return pa.ListArray.from_arrays(ends.astype(np.int32), points, type=kind)


def _lists(items: pa.Array, length: int) -> pa.ListArray:
    return pa.ListArray.from_arrays(np.arange(0, len(items) + 1, length, dtype=np.int32), items)


def _flat(values: NDArray[np.generic]) -> NDArray[np.generic]:
    return np.ascontiguousarray(values).ravel()
