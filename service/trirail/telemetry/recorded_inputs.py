"""Format of the control inputs in recordings: JSON in which the names and the order of fields never change.

The messages between the processes have changed since: a single type of announcement contains any kind of notice, and
the planner's answer contains the reply to the goal as a separate object. In a recording, each kind of notice has a
type of its own, and the fields of the reply are stored among the fields of the answer. Recordings retain this format,
because all versions must be able to read both old and new files.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec

from trirail.wire.decoding import converted, decoded, prepare
from trirail.wire.event_codes import EventCode
from trirail.wire.looks import AlignmentLook, alignment_event_text
from trirail.wire.messages import GoalReply, Notice
from trirail.wire.packets import Announcement, ControlInput, GoalRequest
from trirail.wire.plan_packets import PathExtension, PreemptingMotion


class _RecordedNotice(NamedTuple):
    """Recorded form of the notices of one kind."""

    kind: str
    fields: dict[str, str]
    """Name of each field in a recording, by its name in the notice."""
    constants: dict[str, str]
    """Values of fields that are not recorded, because the kind of notice determines them."""


_CODED = {"message": "message", "event_code": "event_code", "params": "params"}
_NOTICES = {
    "RefusedRequest": _RecordedNotice(
        "refused",
        {"user": "user", "message": "message", "code": "code"},
        {"level": "warning", "event_code": EventCode.REFUSED},
    ),
    "PoseChanged": _RecordedNotice("pose", {"user": "user"} | _CODED, {"level": "info"}),
    "Looked": _RecordedNotice(
        "alignment", {"user": "user", "level": "level", "message": "message", "alignment": "look"}, {}
    ),
    "Remark": _RecordedNotice("service", {"level": "level"} | _CODED, {}),
}
_TYPES = {form.kind: name for name, form in _NOTICES.items()}
_PLANS = {
    "Planned": ("number", "version", "first", "run", "duration", "slowed", "stops_first", "stop", "bound", "lag"),
    "Extended": ("number", "version", "s", "path", "slowed"),
}
"""Recorded fields of each kind of planner's answer, including the fields of the reply to the goal."""
_OLDEST = ("id", "duration", "slowed", "stops_first", "queued", "lag", "accepted")
_REPLY = tuple(name for name in GoalReply.__struct_fields__ if name != "run")
"""Recorded fields of a reply to a goal. The gateway adds `run`, which the loop does not know."""
_LATER = tuple(name for name in _REPLY if name not in _OLDEST)
"""Fields that were added to the reply later. A field is recorded only if its value differs from _PLAIN_REPLY."""
_PLAIN_REPLY = GoalReply("", None)
_Line = dict[str, Any]
prepare(_Line, ControlInput, AlignmentLook)


def encode_input(what: ControlInput) -> str:
    """Encode a control input as JSON in the format of recordings."""
    if isinstance(what.given, Announcement):
        entry = _recorded_notice(what.given.notice)
    elif isinstance(what.given, PreemptingMotion | PathExtension):
        entry = _recorded_plan(what.given)
    elif isinstance(what.given, GoalRequest):
        entry = msgspec.to_builtins(what.given)
        for name in ("marks", "stop_at"):  # these fields were added later, and older programs refuse unknown fields
            if not entry["goal"].get(name, True):
                del entry["goal"][name]
    else:
        return msgspec.json.encode(what).decode()
    return msgspec.json.encode(msgspec.to_builtins(what) | {"given": entry}).decode()


def decode_input(text: str) -> ControlInput:
    """Decode a control input from the JSON of a recording. Raises errors in decoding.INVALID if it is invalid."""
    line = decoded(text, _Line)
    entry = line.get("given")
    if isinstance(entry, dict) and entry.get("type") in _NOTICES:
        line["given"] = _announcement(entry)
    elif isinstance(entry, dict) and entry.get("type") in _PLANS:
        line["given"] = _plan(entry)
    return converted(line, ControlInput)


def _recorded_notice(notice: Notice) -> _Line:
    """Return the fields with which a notice is recorded."""
    name = _TYPES[notice.kind]
    return {"type": name} | {recorded: getattr(notice, field) for field, recorded in _NOTICES[name].fields.items()}


def _recorded_plan(plan: PreemptingMotion | PathExtension) -> _Line:
    """Return the fields with which an answer from the planner is recorded."""
    fields = msgspec.to_builtins(plan)
    reply = fields.pop("reply")
    fields |= {name: reply[name] for name in _REPLY}
    later = [name for name in _LATER if getattr(plan.reply, name) != getattr(_PLAIN_REPLY, name)]
    if plan.switches:
        later.append("switches")
    return {name: fields[name] for name in ("type", *_PLANS[fields["type"]], *later)}


def _announcement(entry: _Line) -> _Line:
    """Return the fields of an announcement, given its recorded fields."""
    kind, fields, constants = _NOTICES[entry["type"]]
    notice: _Line = {"kind": kind} | constants
    notice |= {field: entry[recorded] for field, recorded in fields.items() if recorded in entry}
    if "alignment" in notice:
        look = converted(notice["alignment"], AlignmentLook)
        notice |= alignment_event_text(look, str(notice.get("message"))).fields
    return {"type": Announcement.__name__, "notice": notice}


def _plan(entry: _Line) -> _Line:
    """Return the fields of an answer from the planner, given its recorded fields."""
    reply = {name: entry.pop(name) for name in _REPLY if name in entry}
    unrecorded = {"id": "", "duration": None, "queued": entry["type"] == "Extended"}
    return entry | {"reply": unrecorded | reply}
