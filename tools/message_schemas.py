"""JSON Schemas of the messages, for clients in other languages: python tools/message_schemas.py [--check].

The schemas are generated from the types of trirail.wire, and shipped in service/trirail/wire/schemas, one file for each
kind of message. With --check, nothing is written, and the exit code is 1 if a file differs from the types.
"""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from pathlib import Path
from typing import Any

import docstrings
import msgspec
from trirail.errors import RefusalCode
from trirail.wire import goal_kind, goals, looks, marks, messages, state, vocabulary
from trirail.wire.event_codes import EventCode
from trirail.wire.vocabulary import Command, NoContent

FOLDER = Path(messages.__file__).parent / "schemas"
DIALECT = "https://json-schema.org/draft/2020-12/schema"

MESSAGES: dict[str, tuple[Any, str]] = {
    "goal": (goals.Goal, "What is sent to goal/<user>: a goal of one of the kinds."),
    "goal-reply": (messages.GoalReply, "The reply to a goal that is accepted."),
    "check": (goals.PathGoal, "What is sent to check/<user>: a goal with a path; the reply is that to a goal."),
    **{
        f"command-{name}": (name.accepts, f"The content{', if any,' * name.content.optional} of cmd/<user>/{name}.")
        for name in Command
        if name.content is not NoContent
    },
    "command": (NoContent, "The content, if any, of the other commands."),
    "command-reply": (messages.CommandReply, "The reply to a command that has been carried out."),
    "error-reply": (messages.ErrorReply, "The error reply to a goal or command that is refused, or that fails."),
    "state": (state.State, "What is published on state."),
    "summary": (state.RobotSummary, "What is published on summary."),
    "event": (messages.Event, "What is published on event."),
    "role": (messages.RoleReply, "The reply to a query on role/<user>."),
    "pose": (state.NamedPose, "The reply to a query on teach/<user>/<name> or forget/<user>/<name>."),
    "poses": (state.NamedPoses, "The reply to a query on poses."),
    "alignment": (looks.AlignmentLook, "What is sent to alignment/<user>, and the reply where it is taken."),
    "info": (state.Info, "The reply to a query on info."),
}
"""For each file, the type of the message, and a description of its use."""
MODULES = (
    *(sys.modules[kind.__module__] for kind in goals.KINDS),
    goal_kind,
    marks,
    vocabulary,
    looks,
    messages,
    state,
)
"""Modules that define the types in the messages."""


def schemas() -> dict[str, str]:
    """Return the text of each schema by file name."""
    made = {}
    for name, (kind, where) in MESSAGES.items():
        (schema,), definitions = msgspec.json.schema_components(
            [kind], schema_hook=_anything, ref_template="#/$defs/{name}"
        )
        for struct, definition in definitions.items():
            if struct == RefusalCode.__name__:
                del definition["enum"]
                definition["oneOf"] = [
                    {"const": code, "description": f"{code.meaning}; {code.remedy}"} for code in RefusalCode
                ]
                continue
            if struct == EventCode.__name__:
                del definition["enum"]
                definition["oneOf"] = [{"const": code, "description": _described(code)} for code in EventCode]
                continue
            if "description" in definition:  # msgspec before 0.23 keeps the indentation of docstrings
                definition["description"] = inspect.cleandoc(definition["description"])
            struct_type = next(getattr(module, struct) for module in MODULES if hasattr(module, struct))
            if struct == state.Pose.__name__:  # an array: its items carry the descriptions of the fields
                texts = docstrings.fields(struct_type).items()
                for item, (field, text) in zip(definition["prefixItems"], texts, strict=True):
                    item["description"] = f"{field}: {text}"
                continue
            on_the_wire = {field.name: field.encode_name for field in msgspec.structs.fields(struct_type)}
            for field, text in docstrings.fields(struct_type).items():
                if field in on_the_wire:
                    definition["properties"][on_the_wire[field]]["description"] = text
        whole = {"$schema": DIALECT, "title": f"trirail: {name}", "description": where, **schema, "$defs": definitions}
        made[f"{name}.json"] = json.dumps(whole, indent=2, ensure_ascii=False) + "\n"
    return made


def _described(code: EventCode) -> str:
    return f"{code.meaning}; params: {', '.join(code.params)}" if code.params else code.meaning


def _anything(kind: type) -> dict[str, Any]:
    """Return a schema without restrictions for `object`: the limits and the geometry in Info are as configured."""
    if kind is object:
        return {"description": "As in the configuration."}
    raise NotImplementedError


def stale(folder: Path = FOLDER) -> list[str]:
    """Return the names of files that are missing, superfluous, or different from the types."""
    made = schemas()
    there = {path.name: path.read_text(encoding="utf-8") for path in folder.glob("*.json")}
    return sorted(name for name in {*made, *there} if made.get(name) != there.get(name))


def main() -> int:
    """Write the files, or check them; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if a file is not current")
    if parser.parse_args().check:
        for name in (old := stale()):
            print(f"{FOLDER / name} is not what the types say: run python tools/message_schemas.py")
        return 1 if old else 0
    made = schemas()
    FOLDER.mkdir(exist_ok=True)
    for path in FOLDER.glob("*.json"):
        path.unlink()
    for name, text in made.items():
        (FOLDER / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
