"""What stands in a recording beside the records: what the control was given, and what it said of it.

Both are lines of a log, for people, that carry the message itself as JSON, for programs.
"""

from __future__ import annotations

import msgspec
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from service import columns
from service.columns import SECOND, Column
from service.messages import Event
from service.packets import CommandRequest, DrivesFault, GoalRequest, Input, Mishap
from service.scene import LEVEL, LEVELS, TEXT

EVENTS, REQUESTS = "/events", "/requests"
JSON = rr.ComponentDescriptor("json")


def said(event: Event) -> Chunk:
    """Return an event of the service."""
    line = event.message, LEVELS[event.level], msgspec.json.encode(event)
    return _line(EVENTS, columns.moment(event.t, event.time), *line)


def given(what: Input, rate_hz: int, wall_offset_ns: int) -> Chunk:
    """Return what the control was given, at the nominal time of its cycle."""
    wall = (what.now_ns + wall_offset_ns) / SECOND
    return _line(REQUESTS, columns.moment(what.cycle / rate_hz, wall), _words(what), "INFO", msgspec.json.encode(what))


def _words(what: Input) -> str:
    match what.given:
        case GoalRequest(id=name, user=user, goal=goal):
            return f"goal {name} of {user}: {type(goal).__name__.removesuffix('Goal').lower()}"
        case CommandRequest(name=name, user=user):
            return f"{name} by {user}"
        case Mishap(event=event, reason=reason):
            return f"{event.lower().replace('_', ' ')}: {reason}"
        case DrivesFault(message=message):
            return message or "the drives' fault is over"
        case refused:
            return refused.message


def _line(path: str, times: dict[str, pa.Array], text: str, level: str, content: bytes) -> Chunk:
    values = {TEXT: text, LEVEL: level, JSON: content.decode()}
    (chunk,) = columns.chunks(times, [Column(path, kind, pa.array([[value]])) for kind, value in values.items()])
    return chunk
