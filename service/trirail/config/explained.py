"""A wrong value in words of the file: which key, what it is, what is allowed, and what was probably meant."""

from __future__ import annotations

import copy
import difflib
import math
import re
from collections.abc import Iterable, Iterator
from types import UnionType
from typing import Annotated, Any, Final, Literal, NamedTuple, get_args, get_origin

import msgspec

from trirail.config.tables import Config
from trirail.wire.decoding import converted
from trirail.wire.vocabulary import Role

Place = tuple[str | int, ...]
"""Where in nested tables and arrays: names and indices."""


def leaves(value: object, place: Place = ()) -> Iterator[tuple[Place, object]]:
    """Yield every value that is no table or array, with where it stands in the file."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from leaves(inner, (*place, name))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from leaves(inner, (*place, index))
    else:
        yield place, value


_AT = re.compile(r"^(?P<what>.*?)(?: - at (?P<key>`key` in )?`\$(?P<path>[^`]*)`)?$", re.DOTALL)
NAMED = "[...]"
"""What msgspec says in the place of a key of a table whose keys are names."""
_FIELD = re.compile(r"^Object (?P<how>contains unknown|missing required) field `(?P<name>[^`]*)`")
_SHAPE = re.compile(r"^Field `(?P<name>[^`]*)`")
"""What a table itself says of a field of it."""


class Mistake(NamedTuple):
    """What a configuration file cannot have."""

    key: str
    """Where."""
    text: str
    """Key, value and what is allowed, in words."""


def overlap(keys: Iterable[str], others: Iterable[str]) -> bool:
    """Whether one of the keys is, holds, or is in, one of the others: limits holds limits.slider.position[0]."""
    beside = tuple(others)
    return any(one == other or _holds(one, other) or _holds(other, one) for one in keys for other in beside)


def _holds(table: str, key: str) -> bool:
    return key.startswith((f"{table}.", f"{table}["))


def repaired(raw: dict[str, Any]) -> tuple[Config, list[Mistake]]:
    """Return what tables hold, with all that is no value of its key; in the place of each stands one that is."""
    tables = copy.deepcopy(raw)
    found = []
    for place, value in leaves(raw):
        if isinstance(value, float) and not math.isfinite(value):
            key = _key(place)
            found.append(Mistake(key, f"{key} = {value}: it must be a finite number"))
            _repair(place, tables)
    seen: set[Place] = set()
    while True:
        try:
            return converted(tables, Config), found
        except msgspec.ValidationError as error:
            place, text = _explained(str(error), tables, Config)
        key = _key(place)
        if not overlap((key,), (each.key for each in found)):
            found.append(Mistake(key, text))
        while place in seen:  # no value for it was found: the table that it is in goes
            place = place[:-1]
        seen.add(place)
        _repair(place, tables)


def explain(error: str, raw: dict[str, Any], kind: type[msgspec.Struct] = Config) -> str:
    """Turn msgspec's words of a file of a kind into a key, the value found there, and what is allowed."""
    return _explained(error, raw, kind)[1]


def _explained(error: str, raw: dict[str, Any], kind: Any) -> tuple[Place, str]:
    """Return where a file of a kind is wrong, and the words for people."""
    found = _AT.match(error)
    what, path = (found["what"], (found["path"] or "").lstrip(".")) if found else (error, "")
    if field := _FIELD.match(what):
        place = (*_place(path), field["name"])
        if field["how"] == "missing required":
            return place, f"{_key(place)}: missing {'key' if path else 'section'}"
        allowed = _type_at(_place(path), kind).__struct_fields__
        close = difflib.get_close_matches(field["name"], allowed, n=1)
        hint = f"did you mean {close[0]}?" if close else f"allowed are {', '.join(allowed)}"
        return place, f"{_key(place)}: unknown {'key' if path else 'section'}; {hint}"
    keys = bool(found and found["key"])
    place = _place(path)
    if keys or NAMED in path:
        table, _, rest = path.partition(NAMED)
        names = _place(table)
        name = _culprit(_at(names, raw), get_args(_type_at(names, kind))[0 if keys else 1], of_keys=keys)
        if keys:
            return (*names, name), f"{table}: {name!r} is no name here: {what[0].lower()}{what[1:].replace('`', '')}"
        place = (*names, name, *_place(rest))
    if field := _SHAPE.match(what):
        place = (*place, field["name"])
    said = f"{_key(place)} = {_at(place, raw)!r}"
    if field or what.startswith(("Expected `float | array`", "Expected `array`")):
        wanted = _described(place, kind)
        return place, f"{said}: {f'wanted {wanted}' if wanted else what[0].lower() + what[1:].replace('`', '')}"
    if what.startswith("Invalid enum value"):
        enum = _type_at(place, kind)
        values = [str(each) for each in enum] if enum is Role else get_args(enum)
        return place, f"{said}: allowed are {', '.join(map(repr, values))}"
    return place, f"{said}: {what[0].lower()}{what[1:].replace('`', '').replace(' | null', '')}"  # TOML has no null


def _repair(place: Place, tables: Any) -> None:
    """Put a value that is possible where an impossible one is; take out what there is no key for."""
    *path, last = place
    table = _at(tuple(path), tables)
    try:
        table[last] = _stand_in(_type_at(place, Config))
    except (StopIteration, msgspec.ValidationError):
        del table[last]


_POSSIBLE: Final[tuple[object, ...]] = (1, 0.5, 0, 10, 1000, 50_000, True, "x", "605A", "counts/s", [], {})
"""Of these some value is possible for every key that is no table with keys that it must have."""


def _stand_in(kind: Any) -> object:
    """Return a value of a type. Raises ValidationError where there is none."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return {field.name: _stand_in(field.type) for field in msgspec.structs.fields(kind) if field.required}
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        return [_stand_in(each) for each in (kinds[:1] * 2 if Ellipsis in kinds else kinds)]
    allowed = get_args(kind) if get_origin(kind) is Literal else tuple(kind) if kind is Role else _POSSIBLE
    for value in allowed:
        try:
            msgspec.convert(value, kind)
        except msgspec.ValidationError:
            continue
        return value
    raise msgspec.ValidationError(f"nothing is possible for {kind}")


def _at(place: Place, raw: Any) -> Any:
    """The value that was given at a place."""
    for part in place:
        raw = raw[part]
    return raw


def _key(place: Place) -> str:
    """A place as people write it: limits.platform.x[0]."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".")


def _place(path: str) -> Place:
    return tuple(int(part) if part.isdigit() else part for part in re.findall(r"[^.\[\]]+", path))


def _culprit(table: Any, kind: Any, *, of_keys: bool) -> str:
    """The first name in a table of names whose key, or value, is not of a type: msgspec does not say which."""
    for name, value in table.items():
        try:
            msgspec.convert(name if of_keys else value, kind)
        except msgspec.ValidationError:
            return str(name)
    return NAMED


def _described(place: Place, kind: Any) -> str | None:
    """What a key takes, where its type has words of its own for that."""
    *path, name = place
    table = _type_at(tuple(path), kind)
    fields = msgspec.structs.fields(table) if isinstance(table, type) and issubclass(table, msgspec.Struct) else ()
    metas = [meta for field in fields if field.name == name for meta in getattr(field.type, "__metadata__", ())]
    return next((meta.description for meta in metas if isinstance(meta, msgspec.Meta)), None)


def _type_at(place: Place, kind: Any) -> Any:
    """The type that the key or table at a place of a kind of file must have."""
    for part in place:
        if isinstance(part, int):
            kind = get_args(kind)[0]
        elif get_origin(kind) is dict:
            kind = get_args(kind)[1]
        else:
            kind = next(field.type for field in msgspec.structs.fields(kind) if field.name == part)
        if isinstance(kind, UnionType) or (get_origin(kind) is Annotated and get_origin(get_args(kind)[0]) is not None):
            kind = get_args(kind)[0]
    return kind
