"""Format of the control inputs in recordings: JSON with unchanged names and order of fields.

Between the processes, an announcement is one record with a notice, and an answer from the planner contains the reply to
the goal. The format of recordings is older: it has one record for each kind of notice, and stores the fields of the
reply among those of the answer. It is kept so that files of any age can be read, and older programs can read new files.
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
    """Recorded name of each field, keyed by its name in the notice."""
    constants: dict[str, str]
    """Values of fields that are not recorded because the kind determines them."""


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
"""Recorded fields of the planner's answers, including the fields of their reply."""
_OLDEST = ("id", "duration", "slowed", "stops_first", "queued", "lag", "accepted")
_LATER = tuple(name for name in GoalReply.__struct_fields__ if name not in _OLDEST)
"""Fields that were added to a reply later; they are recorded only if they differ from the reply below."""
_PLAIN_REPLY = GoalReply("", None)
_Line = dict[str, Any]
prepare(_Line, ControlInput, AlignmentLook)


def encode_input(what: ControlInput) -> str:
    """Return an input as JSON."""
    if isinstance(what.given, Announcement):
        entry = _recorded_notice(what.given.notice)
    elif isinstance(what.given, PreemptingMotion | PathExtension):
        entry = _recorded_plan(what.given)
    elif isinstance(what.given, GoalRequest):
        entry = msgspec.to_builtins(what.given)
        for name in ("marks", "stop_at"):  # fields of later goals: older programs refuse fields that they do not know
            if not entry["goal"].get(name, True):
                del entry["goal"][name]
    else:
        return msgspec.json.encode(what).decode()
    return msgspec.json.encode(msgspec.to_builtins(what) | {"given": entry}).decode()


def decode_input(text: str) -> ControlInput:
    """Return an input, given as JSON. Raises msgspec.DecodeError."""
    line = decoded(text, _Line)
    entry = line.get("given")
    if isinstance(entry, dict) and entry.get("type") in _NOTICES:
        line["given"] = _announcement(entry)
    elif isinstance(entry, dict) and entry.get("type") in _PLANS:
        line["given"] = _plan(entry)
    return converted(line, ControlInput)


def _recorded_notice(notice: Notice) -> _Line:
    """Return the recorded fields of an announcement."""
    name = _TYPES[notice.kind]
    return {"type": name} | {recorded: getattr(notice, field) for field, recorded in _NOTICES[name].fields.items()}


def _recorded_plan(plan: PreemptingMotion | PathExtension) -> _Line:
    """Return the recorded fields of an answer from the planner."""
    fields = msgspec.to_builtins(plan)
    fields |= fields.pop("reply")
    later = [name for name in _LATER if getattr(plan.reply, name) != getattr(_PLAIN_REPLY, name)]
    if plan.switches:
        later.append("switches")
    return {name: fields[name] for name in ("type", *_PLANS[fields["type"]], *later)}


def _announcement(entry: _Line) -> _Line:
    """Return the fields of the recorded announcement."""
    kind, fields, constants = _NOTICES[entry["type"]]
    notice: _Line = {"kind": kind} | constants
    notice |= {field: entry[recorded] for field, recorded in fields.items() if recorded in entry}
    if "alignment" in notice:
        look = converted(notice["alignment"], AlignmentLook)
        notice |= alignment_event_text(look, str(notice.get("message"))).fields
    return {"type": Announcement.__name__, "notice": notice}


def _plan(entry: _Line) -> _Line:
    """Return the fields of the recorded answer from the planner."""
    reply = {name: entry.pop(name) for name in GoalReply.__struct_fields__ if name in entry}
    unrecorded = {"id": "", "duration": None, "queued": entry["type"] == "Extended"}
    return entry | {"reply": unrecorded | reply}
