"""A wrong value in words of the file: which key, what it is, what is allowed, and what was probably meant."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from types import UnionType
from typing import Annotated, Any, get_args, get_origin

import msgspec

from trirail.config.tables import Config
from trirail.wire.vocabulary import Role


def leaves(value: object, key: str = "") -> Iterator[tuple[str, object]]:
    """Yield every value that is no table or array, with the key by which it stands in the file."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from leaves(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from leaves(inner, f"{key}[{index}]")
    else:
        yield key, value


_AT = re.compile(r"^(?P<what>.*?)(?: - at (?P<key>`key` in )?`\$(?P<path>[^`]*)`)?$", re.DOTALL)
NAMED = "[...]"
"""What msgspec says in the place of a key of a table whose keys are names."""
_FIELD = re.compile(r"^Object (?P<how>contains unknown|missing required) field `(?P<name>[^`]*)`")


def explain(error: str, raw: dict[str, Any], kind: type[msgspec.Struct] = Config) -> str:
    """Turn msgspec's words of a file of a kind into a key, the value found there, and what is allowed."""
    found = _AT.match(error)
    what, path = (found["what"], (found["path"] or "").lstrip(".")) if found else (error, "")
    if field := _FIELD.match(what):
        key = f"{path}.{field['name']}" if path else field["name"]
        if field["how"] == "missing required":
            return f"{key}: missing {'key' if path else 'section'}"
        allowed = _type_at(path, kind).__struct_fields__
        close = difflib.get_close_matches(field["name"], allowed, n=1)
        hint = f"did you mean {close[0]}?" if close else f"allowed are {', '.join(allowed)}"
        return f"{key}: unknown {'key' if path else 'section'}; {hint}"
    keys = bool(found and found["key"])
    if keys or NAMED in path:
        table, _, rest = path.partition(NAMED)
        name = _culprit(_at(table, raw), get_args(_type_at(table, kind))[0 if keys else 1], of_keys=keys)
        if keys:
            return f"{table}: {name!r} is no name here: {what[0].lower()}{what[1:].replace('`', '')}"
        path = f"{table}.{name}{rest}"
    value = _at(path, raw)
    if what.startswith("Invalid enum value"):
        enum = _type_at(path, kind)
        values = [str(each) for each in enum] if enum is Role else get_args(enum)
        return f"{path} = {value!r}: allowed are {', '.join(map(repr, values))}"
    return f"{path} = {value!r}: {what[0].lower()}{what[1:].replace('`', '')}"


def _at(path: str, raw: dict[str, Any]) -> object:
    """The value that was given at a path."""
    value: object = raw
    for part in _parts(path):
        value = value[int(part) if isinstance(value, list) else part]  # type: ignore[index]
    return value


def _culprit(table: Any, kind: Any, *, of_keys: bool) -> str:
    """The first name in a table of names whose key, or value, is not of a type: msgspec does not say which."""
    for name, value in table.items():
        try:
            msgspec.convert(name if of_keys else value, kind)
        except msgspec.ValidationError:
            return str(name)
    return NAMED


def _parts(path: str) -> list[str]:
    return re.findall(r"[^.\[\]]+", path)


def _type_at(path: str, kind: Any) -> Any:
    """The type that the key or table at `path` of a kind of file must have."""
    for part in _parts(path):
        if part.isdigit():
            kind = get_args(kind)[0]
        elif get_origin(kind) is dict:
            kind = get_args(kind)[1]
        else:
            kind = next(field.type for field in msgspec.structs.fields(kind) if field.name == part)
        if isinstance(kind, UnionType) or (get_origin(kind) is Annotated and get_origin(get_args(kind)[0]) is not None):
            kind = get_args(kind)[0]
    return kind
