"""Recordings read into numpy: every cycle's record bit for bit, the log of events, and the texts beside them.

from trirail import read
recording = read(Path("recordings/demo-20260101-120000.rrd"))
error = recording.records["following_error"]      # (N, 3) [m]; the fields are those of trirail.wire.records
session = join([read(path) for path in parts])    # of a session whose recording was rotated, in any order
"""

from __future__ import annotations

import os
import shutil
import struct
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import msgspec
import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk, RrdReader
from rerun.error_utils import RerunWarning
from trirail_drivers import files
from trirail_drivers.errors import FileError

from trirail.errors import EmptyRecordingError, ServiceError
from trirail.telemetry import recorded_cycles
from trirail.telemetry.columns import RECORD
from trirail.telemetry.journal import EVENTS, JSON, REQUESTS, WORDS
from trirail.telemetry.provenance import SOFTWARE
from trirail.wire.decoding import decoded, prepare
from trirail.wire.messages import Event
from trirail.wire.packets import ControlInput

if TYPE_CHECKING:
    import pandas as pd

    from trirail.telemetry.alignments import RecordedAlignment

# What an RRD file is made of: Rerun's crate re_log_encoding, src/rrd/frames.rs.
_MAGIC = b"RRF2"
_FILE_HEADER = 12
"""Magic number, version and options [bytes]."""
_MESSAGE_HEADER = struct.Struct("<QQ")
"""A message's kind, and how many bytes follow."""
_END = 0
"""The kind of the last message of a file that was closed; only a table of contents follows."""

_LEVEL = rr.TextLog.descriptor_level().component
_DOCUMENT = rr.TextDocument.descriptor_text().component
_KEPT = (RECORD, EVENTS, REQUESTS)
T = TypeVar("T", bound=msgspec.Struct)
prepare(ControlInput, Event)


class Line(NamedTuple):
    """A line of the log: an event of the service, or what the recorder had to say."""

    t: float
    """Nominal time since the loop's start [s]."""
    wall: np.datetime64
    level: str
    """INFO, WARN or ERROR."""
    text: str
    event: Event | None = None
    """The event itself; None for what the recorder had to say."""


class Recording(NamedTuple):
    """What a recording holds."""

    name: str
    """The robot's name and when it began; empty if the file does not say."""
    records: NDArray[np.void]
    """Of every cycle, (N,), of wire.records.DTYPE, by rising `cycle`. Cycles that did not reach the file lack."""
    t: NDArray[np.float64]
    """Nominal times of the records since the loop's start, (N,) [s]."""
    wall: NDArray[np.datetime64]
    """Wall-clock times of the records, (N,), UTC [ns]."""
    events: list[Line]
    """The log, in order."""
    texts: dict[str, str]
    """Text documents that hold for the whole session, by entity path: /configuration, /software."""
    requests: tuple[ControlInput, ...] = ()
    """What the control was given, in order: goals and commands, each with the cycle that took it, and mishaps."""

    def part(
        self,
        begin: float | None = None,
        end: float | None = None,
        *,
        goal: str | None = None,
        every: float | None = None,
    ) -> Recording:
        """Return a stretch of it: from and to some time `t` [s], while a `goal` of this id lasts, a row `every` [s].

        Of the rows of such a time the first is taken, none is a mean. Requests are kept, for who looks up a goal.
        Raises ServiceError where nothing is left, or there is no such goal.
        """
        from trirail.telemetry import recording_table

        return recording_table.part(self, begin, end, goal=goal, every=every)

    @property
    def alignments(self) -> list[RecordedAlignment]:
        """Alignments, calibrations of cameras and checks that clients told of, in order, with every look."""
        from trirail.telemetry import alignments

        return alignments.of(self.events)

    def table(self, every: float | str | None = None, columns: Sequence[str] = ()) -> pd.DataFrame:
        """Return the records as a DataFrame of pandas, by `t` [s], a row `every` so many seconds, or as "10ms".

        SI units and radians; `columns` are names of fields, or words of names, as pose or error: all if absent. A
        pose's numbers end in _x, _y, _phi, those of sliders in _a, _b, _c. Raises ServiceError where a column is none.
        """
        from trirail.telemetry import recording_table

        return recording_table.frame(self, every, columns)


def read(path: Path) -> Recording:
    """Read a recording; of one that was cut off, or is still being written, all that is whole.

    Rerun's own format (.rrd); the file is not changed. Fields, units and frames of the records are those of
    trirail.wire.records.FIELDS: SI units and radians, sliders in the order A, B, C, poses in the base frame.
    Fields that an older version did not write are NaN, or 0 where they are no floats, and an OlderRecordingWarning says
    so once. Raises ServiceError if the file cannot be read, is not a recording, or is of another version, and of its
    kinds EmptyRecordingError if it holds no records.
    """
    size = path.stat().st_size if path.is_file() else 0
    try:
        with _whole(path) as whole:
            chunks = _chunks(whole, path)
    except ServiceError:
        if not path.is_file() or path.stat().st_size == size:
            raise
        with _whole(path, growing=True) as whole:  # it was being written while Rerun read it
            chunks = _chunks(whole, path)
    texts = _static(chunks, _DOCUMENT)
    kept = [chunk for chunk in chunks if chunk.entity_path == RECORD]
    if SOFTWARE in texts and not kept:
        raise EmptyRecordingError(f"{path}: nothing was recorded: its service ended before the first cycle reached it")
    records, t, wall = recorded_cycles.read([chunk.to_record_batch() for chunk in kept], path)
    return Recording(
        name=next(iter(_static(chunks, "RecordingInfo:name").values()), ""),
        records=records,
        t=t,
        wall=wall,
        events=_events([chunk for chunk in chunks if chunk.entity_path == EVENTS], path),
        texts=texts,
        requests=_requests([chunk for chunk in chunks if chunk.entity_path == REQUESTS], path),
    )


def join(parts: Sequence[Recording]) -> Recording:
    """Put the parts of a session together, in any order. Raises ServiceError if they are of different sessions."""
    first, *others = sorted(parts, key=lambda part: int(part.records["cycle"][0]))
    for other in others:
        if (other.name, other.texts) != (first.name, first.texts):
            raise ServiceError(
                f"{other.name!r} is not of the same session as {first.name!r}: give the parts of one, "
                "which have one name but for -part2 and on"
            )
    _, rows = np.unique(np.concatenate([part.records["cycle"] for part in parts]), return_index=True)
    return Recording(
        name=first.name,
        records=np.concatenate([part.records for part in parts])[rows],
        t=np.concatenate([part.t for part in parts])[rows],
        wall=np.concatenate([part.wall for part in parts])[rows],
        events=sorted((line for part in parts for line in part.events), key=lambda line: line.t),
        texts=first.texts,
        requests=tuple(sorted((given for part in parts for given in part.requests), key=lambda given: given.seq)),
    )


@contextmanager
def _whole(path: Path, *, growing: bool = False) -> Iterator[Path]:
    """Give the file itself or, if its last message was cut off, a copy without that: Rerun would read none of it.

    Of one that is growing, always a copy.
    """
    try:
        size, length = path.stat().st_size, _whole_length(path)
    except FileError as error:
        raise ServiceError(str(error)) from error
    except OSError as error:
        raise ServiceError(f"{path}: {error.strerror}") from error
    if length == size and not growing:
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="trirail-") as folder:
        try:
            copy = Path(shutil.copyfile(path, f"{folder}/{path.name}"))
            os.truncate(copy, length)
        except OSError as error:
            raise ServiceError(f"{path} was cut off, and cannot be copied to {folder}: {error.strerror}") from error
        yield copy


def _whole_length(path: Path) -> int:
    """Return how many bytes of a file end with a whole message; all of a file that was closed."""
    with files.open_regular(path) as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise ServiceError(f"{path}: not a recording: an RRD file begins with {_MAGIC.decode()}")
        size, end = os.fstat(file.fileno()).st_size, _FILE_HEADER
        while end + _MESSAGE_HEADER.size <= size:
            file.seek(end)
            kind, length = _MESSAGE_HEADER.unpack(file.read(_MESSAGE_HEADER.size))
            if end + _MESSAGE_HEADER.size + length > size:
                break
            if kind == _END:
                return size
            end += _MESSAGE_HEADER.size + length
    return end


def _chunks(whole: Path, path: Path) -> list[Chunk]:
    """Return what there is of the records, the log and what holds for the whole session."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "RRD file has no footer", RerunWarning)  # it was cut off
            reader = RrdReader(whole)
        if not reader.recordings():
            raise ServiceError(f"{path}: holds no recording")
        return [chunk for chunk in reader.stream() if chunk.is_static or chunk.entity_path in _KEPT]
    except (RuntimeError, ValueError) as error:
        raise ServiceError(f"{path}: cannot be read as a recording: {error}") from error


def _events(chunks: list[Chunk], path: Path) -> list[Line]:
    lines: list[Line] = []
    for batch in (chunk.to_record_batch() for chunk in chunks):
        t, wall = recorded_cycles.times([batch])
        levels, texts = (_texts(batch, name, path, "events") for name in (_LEVEL, WORDS.component))
        spoken = batch.column(JSON.component).to_pylist() if JSON.component in batch.schema.names else [None] * len(t)
        events = [_decoded(content[0], Event, path, "events") if content else None for content in spoken]
        lines += map(Line, t.tolist(), wall, levels, texts, events)
    return sorted(lines, key=lambda line: line.t)


def _requests(chunks: list[Chunk], path: Path) -> tuple[ControlInput, ...]:
    rows = [row for chunk in chunks for row in _texts(chunk.to_record_batch(), JSON.component, path, "requests")]
    found = (_decoded(row, ControlInput, path, "requests") for row in rows)
    return tuple(sorted(found, key=lambda given: given.seq))


def _texts(batch: pa.RecordBatch, component: str, path: Path, what: str) -> list[str]:
    if component not in batch.schema.names:
        raise ServiceError(f"{path}: written by another version: its {what} have no {component}")
    texts: list[str] = batch.column(component).flatten().to_pylist()
    return texts


def _decoded(row: str, kind: type[T], path: Path, what: str) -> T:
    try:
        return decoded(row, kind)
    except msgspec.DecodeError as error:
        raise ServiceError(f"{path}: written by another version: its {what} cannot be read: {error}") from error


def _static(chunks: list[Chunk], component: str) -> dict[str, str]:
    """Return the texts of a component that hold for the whole session, by entity path."""
    return {
        chunk.entity_path: batch.column(component).flatten()[0].as_py()
        for chunk in chunks
        if chunk.is_static and component in (batch := chunk.to_record_batch()).schema.names
    }
