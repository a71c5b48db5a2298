"""Reading of recordings into numpy: the exact record of each cycle, the log of events, and the text documents.

from trirail import read
recording = read("recordings/demo-20260101-120000.rrd")
error = recording.records["following_error"]      # (N, 3) [m]; the fields are those of trirail.wire.records
session = read_session(paths)                     # all files of a rotated recording, in any order
"""

from __future__ import annotations

import os
import shutil
import signal
import struct
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, TypeVar

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
from trirail.telemetry.columns import FIELDS, RECORD, SECOND, layout
from trirail.telemetry.journal import EVENTS, JSON, REQUESTS, WORDS, Line
from trirail.telemetry.provenance import SOFTWARE
from trirail.telemetry.recorded_inputs import decode_input
from trirail.telemetry.recording import Recording
from trirail.telemetry.retention import MAGIC
from trirail.wire.decoding import INVALID, decoded, prepare
from trirail.wire.messages import Event
from trirail.wire.packets import ControlInput
from trirail.wire.records import DTYPE, are_known

# Structure of an RRD file: Rerun's crate re_log_encoding, src/rrd/frames.rs.
_FILE_HEADER = 12
"""Size of the file header, which contains magic number, version and options [bytes]."""
_MESSAGE_HEADER = struct.Struct("<QQ")
"""Header of each message: the kind of the message, and the number of bytes that follow the header."""
_END = 0
"""Kind of the last message of a properly closed file. Its content is a table of contents, so it is never empty."""
_LAST_NULS = 1
"""Number of NUL bytes with which a complete message can end: its last field is the flag of static data."""
_BLOCK = 1 << 20
"""Number of bytes read at a time in the search for the end of the data."""

_DECODE = "import sys; from rerun_bindings import RrdReaderInternal as R; [None for _ in R(sys.argv[1]).stream()]"
"""Program that decodes a recording, with the class behind RrdReader, which is imported 50 times as fast."""

_LEVEL = rr.TextLog.descriptor_level().component
_DOCUMENT = rr.TextDocument.descriptor_text().component
_READ_ENTITIES = (RECORD, EVENTS, REQUESTS)
T = TypeVar("T", bound=msgspec.Struct)
prepare(Event)
BY_CYCLE = "cycle"
"""Field by which records are sorted."""
CONTRADICTION_S = 1e-6
"""Difference between the time of a record and the time of its cycle above which the record is damaged [s]."""
_LAYOUT = layout(DTYPE)
"""Arrow types of the fields of a record in a file."""


class OlderRecordingWarning(UserWarning):
    """Warning that a recording lacks fields that were added to the records later."""


class SkippedFileWarning(UserWarning):
    """Warning that one of a session's files cannot be read, and is left out."""


def read(path: str | os.PathLike[str]) -> Recording:
    """Read a recording (.rrd), without changing the file.

    Fields, units and frames of the records are those of trirail.wire.records.FIELDS: SI units and radians, sliders in
    the order A, B, C, poses in the base frame. If the file was cut off or is still being written, all of its complete
    messages are read.

    Raises
    ------
    ServiceError
        The file cannot be read, is not a recording, or is of another version.
    EmptyRecordingError
        The recording holds no records.

    Warns
    -----
    OlderRecordingWarning
        The recording lacks fields that were added later. Those fields are NaN, or 0 if they are not floats.
    """
    recording = read_part(path)
    if not len(recording.records):
        raise _empty(path)
    return recording


def _empty(path: str | os.PathLike[str]) -> EmptyRecordingError:
    return EmptyRecordingError(
        f"{path}: the recording is empty, because the service or its recorder ended before a cycle was recorded"
    )


def read_part(path: str | os.PathLike[str]) -> Recording:
    """Read one file of a session, which may hold events and inputs without records. Otherwise the same as `read`."""
    path = Path(path)
    size = _size(path)
    try:
        with without_partial_message(path) as whole:
            chunks = _chunks(whole, path)
    except ServiceError:
        if _size(path) == size:
            raise
        with without_partial_message(path, growing=True) as whole:  # the file was being written while Rerun read it
            chunks = _chunks(whole, path)
    texts = _static(chunks, _DOCUMENT)
    kept = [chunk for chunk in chunks if chunk.entity_path == RECORD]
    if SOFTWARE in texts and not kept:
        records, t, wall = np.zeros(0, DTYPE), np.zeros(0), np.zeros(0, "datetime64[ns]")
    else:
        records, t, wall = _cycles([chunk.to_record_batch() for chunk in kept], path)
    return Recording(
        name=next(iter(_static(chunks, "RecordingInfo:name").values()), ""),
        records=records,
        t=t,
        wall=wall,
        events=_events([chunk for chunk in chunks if chunk.entity_path == EVENTS], path),
        texts=texts,
        requests=_requests([chunk for chunk in chunks if chunk.entity_path == REQUESTS], path),
    )


def read_session(paths: Sequence[str | os.PathLike[str]]) -> Recording:
    """Read and join the files of a session, given in any order.

    If there are several files, a file that cannot be read is left out. A power cut can leave such a file.

    Raises
    ------
    ServiceError
        No file can be read, or the recordings belong to different sessions.
    EmptyRecordingError
        The files hold no records.

    Warns
    -----
    SkippedFileWarning
        A file was left out.
    """
    parts: list[Recording] = []
    errors: list[ServiceError] = []
    for path in paths:
        try:
            parts.append(read_part(path))
        except ServiceError as error:
            errors.append(error)
    if not parts:
        raise errors[0]
    for each in errors:
        warnings.warn(f"{each}; this file is left out", SkippedFileWarning, stacklevel=2)
    session = join(parts)
    if not len(session.records):
        raise _empty(paths[0])
    return session


def join(parts: Sequence[Recording]) -> Recording:
    """Join the recordings of a session's files, given in any order. What several files contain is read once.

    Raises ServiceError if the recordings belong to different sessions.
    """
    first, *others = parts
    for other in others:
        if (other.name, other.texts) != (first.name, first.texts):
            raise ServiceError(
                f"{other.name!r} is not of the same session as {first.name!r}: "
                "join files whose names differ only in -part2 and so on"
            )
    _, rows = np.unique(np.concatenate([part.records["cycle"] for part in parts]), return_index=True)
    return Recording(
        name=first.name,
        records=np.concatenate([part.records for part in parts])[rows],
        t=np.concatenate([part.t for part in parts])[rows],
        wall=np.concatenate([part.wall for part in parts])[rows],
        events=sorted(
            {_identity(line): line for part in parts for line in part.events}.values(), key=lambda line: line.t
        ),
        texts=first.texts,
        requests=tuple(
            sorted({item.seq: item for part in parts for item in part.requests}.values(), key=lambda item: item.seq)
        ),
    )


def _identity(line: Line) -> tuple[object, ...]:
    """Return a key that only the copies of a line in several files share."""
    return (line.t, line.text) if line.event is None else (line.event.run, line.event.seq)


def _size(path: Path) -> int | None:
    """Return the size of a file [bytes]; None if the file is missing or its folder cannot be searched."""
    try:
        return path.stat().st_size
    except (OSError, ValueError):
        return None


@contextmanager
def without_partial_message(path: Path, *, growing: bool = False) -> Iterator[Path]:
    """Yield the file itself or, if its last message was cut off, a copy without that message.

    Rerun cannot read a file that contains a partial message. If the file is still `growing`, always yield a copy.
    Raises ServiceError if the file is not a recording, or cannot be read or copied.
    """
    try:
        size, length = path.stat().st_size, _complete_length(path)
    except FileError as error:
        raise ServiceError(str(error)) from error
    except OSError as error:
        raise ServiceError(f"{path}: {error.strerror}") from error
    if length == size and not growing:
        yield path
        return
    with files.temporary_folder() as folder:
        try:
            copy = Path(shutil.copyfile(path, f"{folder}/{path.name}"))
            os.truncate(copy, length)
        except OSError as error:
            raise ServiceError(
                f"{path} is incomplete, and cannot be copied to {folder} for reading: {error.strerror}"
            ) from error
        yield copy


def _complete_length(path: Path) -> int:
    """Return the length of a file up to its last complete message [bytes]; for a closed file, its whole length.

    After a power cut, the end of a file can consist of NUL bytes: the file system has stored the new size, but not yet
    the data. A message that extends into these bytes is not complete.
    """
    with files.open_regular(path) as file:
        begin = file.read(len(MAGIC))
        if begin.strip(b"\0") and begin != MAGIC:
            raise ServiceError(f"{path}: not a recording: an RRD file begins with {MAGIC.decode()}")
        if begin != MAGIC or os.fstat(file.fileno()).st_size < _FILE_HEADER:
            raise ServiceError(f"{path}: cut off in its header: the recording is empty")
        size, end = os.fstat(file.fileno()).st_size, _FILE_HEADER
        filled = min(size, _filled_length(file, size) + _LAST_NULS)
        while end + _MESSAGE_HEADER.size <= size:
            file.seek(end)
            kind, length = _MESSAGE_HEADER.unpack(file.read(_MESSAGE_HEADER.size))
            if kind == _END and length and end + _MESSAGE_HEADER.size + length <= size:
                return size
            if end + _MESSAGE_HEADER.size + length > filled:
                break
            end += _MESSAGE_HEADER.size + length
    return end


def _filled_length(file: BinaryIO, size: int) -> int:
    """Return the length of a file without the NUL bytes at its end [bytes]."""
    end = size
    while end > 0:
        start = max(0, end - _BLOCK)
        file.seek(start)
        block = file.read(end - start).rstrip(b"\0")
        if block:
            return start + len(block)
        end = start
    return 0


def _chunks(whole: Path, path: Path) -> list[Chunk]:
    """Return the chunks of records, the chunks of logs, and the static chunks."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "RRD file has no footer", RerunWarning)  # the file was cut off
            reader = RrdReader(whole)
        if not reader.recordings():
            raise ServiceError(f"{path}: contains no recording")
        _check_decoding(whole, path)
        return [chunk for chunk in reader.stream() if chunk.is_static or chunk.entity_path in _READ_ENTITIES]
    except (RuntimeError, ValueError) as error:
        reason = str(error).replace(str(whole), str(path))  # Rerun names the file, which can be a copy
        raise ServiceError(f"{path}: cannot be read as a recording: {reason}") from error


_CRASHES = (signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV)
"""Signals with which damaged data may end the decoder."""


def _check_decoding(whole: Path, path: Path) -> None:
    """Decode a recording in another process. Raises ServiceError if damaged data end this process.

    For some damaged data, Rerun reports no error but aborts the process. The check takes the time to start Python,
    and a fifth of the time for reading a large recording. Where another program contains Python, there is no check.
    """
    if not Path(sys.executable or "").name.startswith("python"):
        return
    try:
        command = [sys.executable, "-P", "-W", "ignore", "-c", _DECODE, str(whole)]
        code = subprocess.run(
            command, check=False, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ).returncode
    except OSError as error:
        raise ServiceError(f"{path}: cannot be checked for damage: {error}") from error
    if -code in _CRASHES:
        raise ServiceError(f"{path}: damaged: Rerun's decoder ended with {signal.Signals(-code).name}")


def _cycles(
    batches: Sequence[pa.RecordBatch], path: Path
) -> tuple[NDArray[np.void], NDArray[np.float64], NDArray[np.datetime64]]:
    """Return the records in the order of their cycles, and their times as returned by `_times`.

    Errors and warnings are the same as for `read`.
    """
    if not any(batch.num_rows for batch in batches):
        raise ServiceError(
            f"{path}: contains no records of cycles (entity {RECORD}); check that trirail made this file"
        )
    parts = [batch.column(FIELDS.component).flatten() for batch in batches]
    for kind in {part.type for part in parts}:
        _check_layout(kind, path)
    records, end = np.zeros(sum(map(len, parts)), DTYPE), 0
    for part in parts:  # a single batch stays in the processor's cache while its fields are copied
        end += len(part)
        _place(part, records[end - len(part) : end])
    t, wall = _times(batches)
    cycle = records["cycle"]
    # A flipped bit passes Rerun's decoder. The time of a record is its cycle number times the period.
    apart = np.abs(t * float(cycle[-1]) - cycle * t[-1]) > CONTRADICTION_S * abs(float(cycle[-1]))
    if cycle.min() < 0 or apart.any() or not are_known(records):
        raise ServiceError(f"{path}: damaged: its records have unknown states, or cycle numbers that contradict times")
    if np.all(cycle[1:] >= cycle[:-1]):
        return records, t, wall
    order = np.argsort(cycle, kind="stable")
    return records[order], t[order], wall[order]


def _check_layout(kind: pa.StructType, path: Path) -> None:
    """Warn about fields that are missing from records of type `kind`.

    Raises ServiceError if the records have unknown fields, or have no cycle number.
    """
    if odd := set(kind) - set(_LAYOUT):
        names = ", ".join(sorted({field.name for field in odd}))
        raise ServiceError(f"{path}: written by another version: its records differ in {names}")
    there = {field.name for field in kind}
    if missing := [name for name in DTYPE.names or () if name not in there]:
        if BY_CYCLE in missing:
            raise ServiceError(f"{path}: written by another version: its records have no {BY_CYCLE}")
        warnings.warn(
            f"{path}: written by an older version: its records have no {', '.join(missing)}; read as NaN, or 0 where "
            "the field is not a float",
            OlderRecordingWarning,
            stacklevel=5,
        )


def _place(part: pa.StructArray, records: NDArray[np.void]) -> None:
    """Copy the fields that were read into `records`, which must be zero. Set missing floats to NaN."""
    there = {field.name: values for field, values in zip(part.type, part.flatten(), strict=True)}
    for name in DTYPE.names or ():
        values = there.get(name)
        if values is None:
            if np.issubdtype(DTYPE[name].base, np.floating):
                records[name] = np.nan
        else:
            flat = values.flatten() if records[name].ndim > 1 else values
            records[name] = np.from_dlpack(flat).reshape(records[name].shape)


def _times(batches: Sequence[pa.RecordBatch]) -> tuple[NDArray[np.float64], NDArray[np.datetime64]]:
    """Return two times for each row: nominal time since the start of the loop [s], and wall-clock time in UTC [ns]."""
    t, wall = (
        np.concatenate([np.from_dlpack(batch.column(timeline).view(pa.int64())) for batch in batches])
        for timeline in ("t", "wall")
    )
    return t / SECOND, wall.view("datetime64[ns]")


def _events(chunks: list[Chunk], path: Path) -> list[Line]:
    lines: list[Line] = []
    for batch in (chunk.to_record_batch() for chunk in chunks):
        t, wall = _times([batch])
        levels, texts = (_texts(batch, name, path, "events") for name in (_LEVEL, WORDS.component))
        messages = batch.column(JSON.component).to_pylist() if JSON.component in batch.schema.names else [None] * len(t)
        events = [_decoded(content[0], _event, path, "events") if content else None for content in messages]
        lines += map(Line, t.tolist(), wall, levels, texts, events)
    return sorted(lines, key=lambda line: line.t)


def _event(text: str) -> Event:
    return decoded(text, Event)


def _requests(chunks: list[Chunk], path: Path) -> tuple[ControlInput, ...]:
    rows = [row for chunk in chunks for row in _texts(chunk.to_record_batch(), JSON.component, path, "requests")]
    inputs = (_decoded(row, decode_input, path, "requests") for row in rows)
    return tuple(sorted(inputs, key=lambda item: item.seq))


def _texts(batch: pa.RecordBatch, component: str, path: Path, what: str) -> list[str]:
    if component not in batch.schema.names:
        raise ServiceError(f"{path}: written by another version: its {what} have no {component}")
    texts: list[str] = batch.column(component).flatten().to_pylist()
    return texts


def _decoded(row: str, decode: Callable[[str], T], path: Path, what: str) -> T:
    try:
        return decode(row)
    except INVALID as error:
        raise ServiceError(f"{path}: written by another version: its {what} cannot be read: {error}") from error


def _static(chunks: list[Chunk], component: str) -> dict[str, str]:
    """Return the static texts of a component, which are valid for the whole session, by entity path."""
    return {
        chunk.entity_path: batch.column(component).flatten()[0].as_py()
        for chunk in chunks
        if chunk.is_static and component in (batch := chunk.to_record_batch()).schema.names
    }
