"""Arrays as Rerun's columns, for many entities at once: a fraction of the cost of a call for each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from service.records import DTYPE

SECOND = 1_000_000_000  # [ns]


class Timelines:
    """The two times of everything: `t`, nominal, since the loop's start, and `wall`, the wall clock."""

    def __init__(self, rate_hz: int, wall_offset_ns: int) -> None:
        self._rate_hz = rate_hz
        self._wall_offset_ns = wall_offset_ns

    def of(self, records: NDArray[np.void]) -> list[rr.TimeColumn]:
        """Return the times of records. Steps of `t` are exact if the period is a whole number of nanoseconds."""
        t = records["cycle"] * SECOND // self._rate_hz
        wall = records["deadline_ns"] + self._wall_offset_ns
        return _times(t, wall)


def moment(t: float, wall: float) -> list[rr.TimeColumn]:
    """Return one nominal time [s] and wall clock [s since 1970]."""
    return _times(np.array([round(t * SECOND)]), np.array([round(wall * SECOND)]))


def scalars(times: list[rr.TimeColumn], curves: Mapping[str, NDArray[np.float64]]) -> list[Chunk]:
    """Return the values of curves, by entity: (N, lines) for N times."""
    kind = rr.Scalars.descriptor_scalars()
    metadata = {"rerun:archetype": kind.archetype, "rerun:component_type": kind.component_type}
    fields, arrays = _indexes(times)
    for path, values in curves.items():
        array = _lists(pa.array(np.ascontiguousarray(values).ravel()), len(values))
        arrays.append(array)
        fields.append(
            pa.field(
                f"{path}:{kind.component}",
                array.type,
                metadata={"rerun:entity_path": path, "rerun:component": kind.component, **metadata},
            )
        )
    return _chunks(fields, arrays, times)


def structs(times: list[rr.TimeColumn], path: str, records: NDArray[np.void]) -> list[Chunk]:
    """Return records with every field as it is: one struct for each, component `fields` of the entity."""
    fields, arrays = _indexes(times)
    names = DTYPE.names or ()
    array = _lists(pa.StructArray.from_arrays([_field(records[name]) for name in names], names), len(records))
    return _chunks([*fields, pa.field(f"{path}:fields", array.type)], [*arrays, array], times)


def _times(t: NDArray[np.int64], wall: NDArray[np.int64]) -> list[rr.TimeColumn]:
    return [
        rr.TimeColumn("t", duration=t.astype("timedelta64[ns]")),
        rr.TimeColumn("wall", timestamp=wall.astype("datetime64[ns]")),
    ]


def _indexes(times: list[rr.TimeColumn]) -> tuple[list[pa.Field], list[pa.Array]]:
    arrays = [time.as_arrow_array() for time in times]
    return [pa.field(time.timeline_name(), array.type) for time, array in zip(times, arrays, strict=True)], arrays


def _field(values: NDArray[np.generic]) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values).ravel())
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _lists(flat: pa.Array, rows: int) -> pa.ListArray:
    """Return the values in lists of the same length, as many as there are rows."""
    return pa.ListArray.from_arrays(np.linspace(0, len(flat), rows + 1).astype(np.int32), flat)


def _chunks(fields: list[pa.Field], arrays: list[pa.Array], times: list[rr.TimeColumn]) -> list[Chunk]:
    batch = pa.record_batch(arrays, schema=pa.schema(fields))
    return Chunk.from_record_batch(batch, index=[time.timeline_name() for time in times])
