"""Logs in a recording: the control inputs and the events of the service, stored in addition to the records.

Each line contains a text for people and the message itself as JSON for programs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import msgspec
import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from trirail.telemetry import columns
from trirail.telemetry.columns import SECOND, Column
from trirail.telemetry.recorded_inputs import encode_input
from trirail.wire.goals import kind_name
from trirail.wire.messages import Event, Level
from trirail.wire.packets import (
    Announcement,
    CheckRequest,
    CommandRequest,
    ControlInput,
    DecidedAhead,
    Disturbance,
    DrivesFault,
    GoalRequest,
    PlannerLost,
)
from trirail.wire.plan_packets import NotPlanned, PathExtension, PreemptingMotion

EVENTS, REQUESTS = "/events", "/requests"
TEXT, LEVEL = rr.TextLog.descriptor_text(), rr.TextLog.descriptor_level()
JSON, WORDS = rr.ComponentDescriptor("json"), rr.ComponentDescriptor("words")
"""Components in addition to the text that a viewer shows: the message as JSON, and the text without its time."""
LogLevel = Level | Literal["trace"]
"""Level of a log entry; a trace helps only to replay the recording."""
LEVELS: dict[LogLevel, str] = {"trace": "TRACE", "info": "INFO", "warning": "WARN", "error": "ERROR"}


class Entry(NamedTuple):
    """Line to be written to a log."""

    log: str
    """EVENTS or REQUESTS."""
    t: float
    """Nominal time since the start of the loop [s]."""
    wall: float
    """Wall clock [s since 1970]."""
    text: str
    level: LogLevel = "info"
    message: Event | ControlInput | None = None
    """The message itself; None for a line from the recorder."""


class Line(NamedTuple):
    """Line read from a log: an event of the service, or a message from the recorder."""

    t: float
    """Nominal time since the start of the loop [s]."""
    wall: np.datetime64
    level: str
    """INFO, WARN or ERROR."""
    text: str
    event: Event | None = None
    """The event itself; None for a message from the recorder."""


def event_entry(event: Event) -> Entry:
    """Return the log entry of an event of the service."""
    return Entry(EVENTS, event.t, event.time, event.message, event.level, event)


def input_entry(item: ControlInput, rate_hz: int, wall_offset_ns: int) -> Entry:
    """Return the log entry of a control input, at the nominal time of the cycle that handled the input."""
    wall = (item.now_ns + wall_offset_ns) / SECOND
    level: LogLevel = "trace" if isinstance(item.given, DecidedAhead) else "info"
    return Entry(REQUESTS, item.cycle / rate_hz, wall, _input_text(item), level, item)


def chunks(entries: Sequence[Entry]) -> list[Chunk]:
    """Return log entries as Rerun chunks, with one chunk per log."""
    logs = dict.fromkeys(entry.log for entry in entries)
    return [_chunk(log, [entry for entry in entries if entry.log == log]) for log in logs]


def _chunk(log: str, entries: Sequence[Entry]) -> Chunk:
    messages = [[_encoded(entry.message)] if entry.message else [] for entry in entries]
    parts = [
        # The viewer's own time column is too narrow for these times, and cannot be widened.
        Column(log, TEXT, pa.array([[f"{entry.t:9.3f} s   {entry.text}"] for entry in entries])),
        Column(log, WORDS, pa.array([[entry.text] for entry in entries])),
        Column(log, LEVEL, pa.array([[LEVELS[entry.level]] for entry in entries])),
        Column(log, JSON, pa.array(messages, pa.list_(pa.string()))),
    ]
    times = columns.times(_nanoseconds(entry.t for entry in entries), _nanoseconds(entry.wall for entry in entries))
    (chunk,) = columns.chunks(times, parts)
    return chunk


def _encoded(message: Event | ControlInput) -> str:
    return encode_input(message) if isinstance(message, ControlInput) else msgspec.json.encode(message).decode()


def _nanoseconds(seconds: Iterable[float]) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([round(value * SECOND) for value in seconds])


def _input_text(item: ControlInput) -> str:
    match item.given:
        case GoalRequest(id=name, user=user, goal=goal):
            return f"goal {name} of {user}: {kind_name(goal)}"
        case CheckRequest(user=user, goal=goal):
            return f"check of {user}: {kind_name(goal)}"
        case CommandRequest(name=name, user=user):
            return f"{name} by {user}"
        case Disturbance(event=event, reason=reason):
            return f"{event.lower().replace('_', ' ')}: {reason}"
        case DrivesFault(message=message):
            return message or "the drives' fault is over"
        case PreemptingMotion(number=number, run=run):
            return f"plan {number}: a motion of {len(run.path.knots) // 8 - 1} pieces"
        case PathExtension(number=number, s=s):
            return f"plan {number}: a motion blended into the previous one, {s:.3f} s along its path"
        case NotPlanned(number=number, message=message):
            return f"plan {number}: {message}"
        case PlannerLost(reason=reason):
            return reason
        case DecidedAhead(cycles=cycles):
            return f"decided {cycles} cycles ahead"
        case Announcement(notice):
            return notice.message
