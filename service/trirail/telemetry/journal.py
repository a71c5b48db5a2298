"""What stands in a recording beside the records: what the control was given, and what it said of it.

Both are lines of a log, for people, that carry the message itself as JSON, for programs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from trirail.telemetry import columns
from trirail.telemetry.columns import SECOND, Column
from trirail.wire.messages import Event, Level
from trirail.wire.packets import (
    CommandRequest,
    ControlInput,
    Disturbance,
    DrivesFault,
    GoalRequest,
    Looked,
    PlannerLost,
    PoseChanged,
    RefusedRequest,
    Remark,
)
from trirail.wire.plan_packets import Extended, NotPlanned, Planned

EVENTS, REQUESTS = "/events", "/requests"
TEXT, LEVEL = rr.TextLog.descriptor_text(), rr.TextLog.descriptor_level()
JSON, WORDS = rr.ComponentDescriptor("json"), rr.ComponentDescriptor("words")
"""Beside the line that a viewer shows: the message itself, and the line without its time."""
LEVELS: dict[Level, str] = {"info": "INFO", "warning": "WARN", "error": "ERROR"}


class Entry(NamedTuple):
    """A line of a log."""

    log: str
    """EVENTS or REQUESTS."""
    t: float
    """Nominal time since the loop's start [s]."""
    wall: float
    """Wall clock [s since 1970]."""
    text: str
    level: Level = "info"
    message: Event | ControlInput | None = None
    """The message itself; None for what the recorder has to say."""


def said(event: Event) -> Entry:
    """Return an event of the service."""
    return Entry(EVENTS, event.t, event.time, event.message, event.level, event)


def control_input(what: ControlInput, rate_hz: int, wall_offset_ns: int) -> Entry:
    """Return what the control was given, at the nominal time of its cycle."""
    wall = (what.now_ns + wall_offset_ns) / SECOND
    return Entry(REQUESTS, what.cycle / rate_hz, wall, _words(what), message=what)


def chunks(entries: Sequence[Entry]) -> list[Chunk]:
    """Return lines as Rerun takes them: all of one log together."""
    logs = dict.fromkeys(entry.log for entry in entries)
    return [_chunk(log, [entry for entry in entries if entry.log == log]) for log in logs]


def _chunk(log: str, entries: Sequence[Entry]) -> Chunk:
    messages = [[msgspec.json.encode(entry.message).decode()] if entry.message else [] for entry in entries]
    parts = [
        # The viewer's own column of times is too narrow for them, and cannot be made wider.
        Column(log, TEXT, pa.array([[f"{entry.t:9.3f} s   {entry.text}"] for entry in entries])),
        Column(log, WORDS, pa.array([[entry.text] for entry in entries])),
        Column(log, LEVEL, pa.array([[LEVELS[entry.level]] for entry in entries])),
        Column(log, JSON, pa.array(messages, pa.list_(pa.string()))),
    ]
    times = columns.times(_nanoseconds(entry.t for entry in entries), _nanoseconds(entry.wall for entry in entries))
    (chunk,) = columns.chunks(times, parts)
    return chunk


def _nanoseconds(seconds: Iterable[float]) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([round(value * SECOND) for value in seconds])


def _words(what: ControlInput) -> str:
    match what.given:
        case GoalRequest(id=name, user=user, goal=goal):
            return f"goal {name} of {user}: {type(goal).__name__.removesuffix('Goal').lower()}"
        case CommandRequest(name=name, user=user):
            return f"{name} by {user}"
        case Disturbance(event=event, reason=reason):
            return f"{event.lower().replace('_', ' ')}: {reason}"
        case DrivesFault(message=message):
            return message or "the drives' fault is over"
        case Planned(number=number, run=run):
            return f"plan {number}: a motion of {len(run.path.knots) // 8 - 1} pieces"
        case Extended(number=number, s=s):
            return f"plan {number}: a motion that follows the one before it, {s:.3f} s along its path"
        case NotPlanned(number=number, message=message):
            return f"plan {number}: {message}"
        case PlannerLost(reason=reason):
            return reason
        case RefusedRequest() | PoseChanged() | Looked() | Remark() as told:
            return told.message
