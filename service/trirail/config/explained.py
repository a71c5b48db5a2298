"""Messages about wrong values in a file. Each gives the key, its value, the allowed values and a suggestion."""

from __future__ import annotations

import copy
import difflib
import functools
import math
import re
from collections.abc import Iterable, Iterator
from typing import Any, Final, NamedTuple

import msgspec
from msgspec import inspect as mi
from trirail_drivers.config import NO_LINE_BREAK, Coordinate

from trirail.config.tables import Angle, Config, ShapeError
from trirail.quantities import as_familiar_unit, rounded_inwards
from trirail.wire.decoding import converted
from trirail.wire.text import printable, quoted

Place = tuple[str | int, ...]
"""Position of a value in nested tables and arrays, as names and indices."""


def leaves(value: object, place: Place = ()) -> Iterator[tuple[Place, object]]:
    """Yield each value that is neither a table nor an array, with its position in the file."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from leaves(inner, (*place, name))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from leaves(inner, (*place, index))
    else:
        yield place, value


class Mistake(NamedTuple):
    """A mistake in a configuration file."""

    key: str
    """Key that has the mistake."""
    text: str
    """Message with the key, its value and the allowed values."""


def overlap(keys: Iterable[str], others: Iterable[str]) -> bool:
    """Return whether any of the keys equals, contains or is contained in any of the others.

    For example, limits contains limits.slider.position[0].
    """
    beside = tuple(others)
    return any(one == other or _holds(one, other) or _holds(other, one) for one in keys for other in beside)


def _holds(table: str, key: str) -> bool:
    return key.startswith((f"{table}.", f"{table}["))


class _WrongValue(NamedTuple):
    """Value that its type does not accept."""

    place: Place
    text: str
    kind: mi.Type | None
    """Expected type; None for an unknown key."""


_type_info = functools.cache(mi.type_info)


def wrong_values(raw: dict[str, Any], kind: type[msgspec.Struct]) -> list[Mistake]:
    """Return a mistake for each value in nested tables that `kind`, the type of the file, does not accept."""
    return [Mistake(_key(wrong.place), wrong.text) for wrong in _wrong_values(raw, _type_info(kind), ())]


def repaired(raw: dict[str, Any]) -> tuple[Config, list[Mistake]]:
    """Return a configuration in which a valid value replaces each wrong one, and the list of mistakes."""
    tables, mistakes = copy.deepcopy(raw), list[Mistake]()
    while wrong := list(_wrong_values(tables, _type_info(Config), ())):
        for place, text, kind in wrong:
            table, key = _at(place[:-1], tables), _key(place)
            if kind is None:
                del table[place[-1]]
            else:
                table[place[-1]] = _stand_in(kind)
            if not overlap((key,), (each.key for each in mistakes)):  # else the stand-ins may conflict
                mistakes.append(Mistake(key, text))
    return converted(tables, Config), mistakes


def _wrong_values(value: object, kind: mi.Type, place: Place) -> Iterator[_WrongValue]:
    """Yield the parts of a value that a type does not accept, or the value itself if it is wrong as a whole."""
    if isinstance(value, float) and not math.isfinite(value):
        yield _WrongValue(place, f"{_key(place)} = {value}: it must be a finite number", kind)
        return
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        text = f"{_key(place)}: integers in TOML have at most 64 bits; expected {expected(kind)}"
        yield _WrongValue(place, text, kind)
        return
    match kind, value:
        case mi.Metadata(type=inner), _:
            for wrong in _wrong_values(value, inner, place):
                yield _unexpected(value, kind, place) if wrong.place == place else wrong
        case mi.UnionType(types=types), _:
            of_each = [list(_wrong_values(value, part, place)) for part in types]
            if all(of_each):
                # If the value has the shape of one of the types, its errors are the answer. Otherwise no type
                # is closer than another.
                inside = (
                    errors
                    for part, errors in zip(types, of_each, strict=True)
                    if all(wrong.place != place for wrong in errors) or _is_table(part, value)
                )
                yield from next(inside, [_unexpected(value, kind, place)])
        case mi.StructType(), dict():
            yield from _wrong_fields(value, kind, place)
        case mi.DictType(), dict():
            yield from _wrong_names(value, kind, place)
        case ((mi.TupleType() | mi.VarTupleType()), list()) if _has_length(kind, len(value)):
            types = kind.item_types if isinstance(kind, mi.TupleType) else (kind.item_type,) * len(value)
            for index, (each, inner) in enumerate(zip(value, types, strict=True)):
                yield from _wrong_values(each, inner, (*place, index))
        case _ if not _accepts(kind, value):
            yield _unexpected(value, kind, place)


def _is_table(kind: mi.Type, value: object) -> bool:
    return isinstance(kind, mi.StructType) and isinstance(value, dict)


def _wrong_fields(table: dict[str, Any], kind: mi.StructType, place: Place) -> Iterator[_WrongValue]:
    """Yield the wrong keys and values of a table or, if there are none, values that contradict each other."""
    word = "key" if place else "section"
    fields = {field.encode_name: field for field in kind.fields}
    wrong_fields: list[_WrongValue] = []
    for name, value in table.items():
        at = (*place, name)
        if name in fields:
            wrong_fields += _wrong_values(value, fields[name].type, at)
        else:
            close = difflib.get_close_matches(name, fields, n=1)
            hint = f"did you mean {close[0]}?" if close else f"allowed are {', '.join(fields)}"
            wrong_fields.append(_WrongValue(at, f"{_key(at)}: unknown {word}; {hint}", None))
    for name, field in fields.items():
        if field.required and name not in table:
            wrong_fields.append(_WrongValue((*place, name), f"{_key((*place, name))}: missing {word}", field.type))
    yield from wrong_fields
    if not wrong_fields and hasattr(kind.cls, "__post_init__"):
        try:
            msgspec.convert(table, kind.cls)
        except msgspec.ValidationError as error:
            cause = error.__cause__
            if isinstance(cause, ShapeError):
                yield _unexpected(table[cause.field], fields[cause.field].type, (*place, cause.field))
            else:
                yield _WrongValue(place, f"{_key(place)} = {_shown(table)}: {cause}", kind)


def _wrong_names(table: dict[str, Any], kind: mi.DictType, place: Place) -> Iterator[_WrongValue]:
    """Yield the wrong names and values of a table whose keys are names."""
    for name, value in table.items():
        if _accepts(kind.key_type, name):
            yield from _wrong_values(value, kind.value_type, (*place, name))
        else:
            text = f"{_key(place)}: {quoted(name)!r} is not a valid name here: expected {expected(kind.key_type)}"
            yield _WrongValue((*place, name), text, None)


def _accepts(kind: mi.Type, value: object) -> bool:
    """Return whether a type accepts a value. Tables and arrays of the right length are checked elsewhere."""
    match kind:
        case mi.NoneType():
            return value is None
        case mi.BoolType():
            return isinstance(value, bool)
        case mi.LiteralType(values=values):
            return any(type(value) is type(each) and value == each for each in values)
        case mi.EnumType(cls=cls):
            return isinstance(value, str) and value in [each.value for each in cls]
        case mi.StrType(pattern=pattern):
            return (
                isinstance(value, str)
                and _fits(len(value), kind)
                and (pattern is None or re.search(pattern, value) is not None)
            )
        case mi.IntType():
            return isinstance(value, int) and not isinstance(value, bool) and _is_within(value, kind)
        case mi.FloatType():
            return isinstance(value, int | float) and not isinstance(value, bool) and _is_within(value, kind)
    return False


def _is_within(value: float, kind: mi.IntType | mi.FloatType) -> bool:
    return (
        (kind.ge is None or value >= kind.ge)
        and (kind.gt is None or value > kind.gt)
        and (kind.le is None or value <= kind.le)
        and (kind.lt is None or value < kind.lt)
    )


def _has_length(kind: mi.TupleType | mi.VarTupleType, length: int) -> bool:
    return length == len(kind.item_types) if isinstance(kind, mi.TupleType) else _fits(length, kind)


def _fits(length: int, kind: mi.StrType | mi.VarTupleType) -> bool:
    return (kind.min_length or 0) <= length and (kind.max_length is None or length <= kind.max_length)


def _unexpected(value: object, kind: mi.Type, place: Place) -> _WrongValue:
    """Return a message with the value at a position and the values that its type accepts."""
    text = f"{_key(place)} = {_shown(value)}: expected {expected(kind)}{_other_unit(value, kind)}"
    return _WrongValue(place, text, kind)


def _shown(value: object) -> str:
    """Return a value in one line. An integer in a table or an array may have more digits than Python writes."""
    try:
        return quoted(repr(value))
    except ValueError:
        return "…"


def expected(kind: mi.Type) -> str:
    """Return a description of the values that a type accepts."""
    match kind:
        case mi.Metadata(type=inner, extra_json_schema={"description": words}):
            number = next((part for part in getattr(inner, "types", ()) if isinstance(part, mi.FloatType)), None)
            return f"{words}; each {bounds(number).removeprefix(', ')}" if number is not None else str(words)
        case mi.UnionType(types=types):
            return " or ".join(expected(part) for part in types if not isinstance(part, mi.NoneType))
        case mi.LiteralType(values=values):
            return f"one of {', '.join(map(repr, values))}"
        case mi.EnumType(cls=cls):
            return f"one of {', '.join(repr(each.value) for each in cls)}"
        case mi.IntType():
            return f"integer{bounds(kind)}"
        case mi.FloatType():
            return f"number{bounds(kind)}"
        case mi.BoolType():
            return "true or false"
        case mi.StrType(pattern=pattern):
            return (
                "text"
                + (f" of {kind.max_length} characters at most" if kind.max_length else "")
                + (f" matching {pattern.removesuffix(NO_LINE_BREAK)}" if pattern else "")
            )
        case mi.TupleType(item_types=types):
            return f"array of length {len(types)}"
        case mi.VarTupleType():
            return "array" + (f" of length {kind.min_length or 0} to {kind.max_length}" if kind.max_length else "")
    return "table"


def bounds(kind: mi.IntType | mi.FloatType) -> str:
    """Return the bounds of a number in words that can follow the name of its type."""
    digits = 10 if isinstance(kind, mi.IntType) else 6
    signs = {">": kind.gt, "≥": kind.ge, "<": kind.lt, "≤": kind.le}
    shown = {
        sign: f"{rounded_inwards(bound, digits, low=sign in '>≥'):.{digits}g}"
        for sign, bound in signs.items()
        if bound is not None
    }
    if shown.keys() == {"≥", "≤"}:
        return f", {shown['≥']} to {shown['≤']}"
    return " and".join(f" {sign} {bound}" for sign, bound in shown.items())


_UNITS: Final = (
    (mi.type_info(Angle), 2.0 * math.pi, "rad", "Angles are in radians"),
    (mi.type_info(Coordinate), 100.0, "m", "Lengths are in metres"),
)


def _other_unit(value: object, kind: mi.Type) -> str:
    """Return a question whether an out-of-range number was meant to be in degrees or millimetres."""
    for number, limit, unit, words in _UNITS:
        if number in (kind, *getattr(kind, "types", ())) and isinstance(value, int | float):
            likely = as_familiar_unit(value, limit, unit)
            return f"; did you mean {likely:.4g}? {words}" if likely is not None else ""
    return ""


_POSSIBLE: Final[tuple[object, ...]] = (1, 0.5, 0, 10, 1000, 50_000, True, "x", "605A", "counts/s", "0" * 8)
"""Candidate values. Every key that is neither a table nor an array accepts at least one of them."""


def _stand_in(kind: mi.Type) -> object:
    """Return any value that a type accepts."""
    match kind:
        case mi.Metadata(type=inner):
            return _stand_in(inner)
        case mi.UnionType(types=types):
            return _stand_in(types[0])
        case mi.StructType(fields=fields):
            return {field.encode_name: _stand_in(field.type) for field in fields if field.required}
        case mi.DictType():
            return {}
        case mi.TupleType(item_types=types):
            return [_stand_in(each) for each in types]
        case mi.VarTupleType(item_type=inner):
            return [_stand_in(inner)] * max(2, kind.min_length or 0)  # two form a range, as in limits.slider.position
        case mi.LiteralType(values=values):
            return values[0]
        case mi.EnumType(cls=cls):
            return next(iter(cls)).value
    return next(value for value in _POSSIBLE if _accepts(kind, value))


def _at(place: Place, raw: Any) -> Any:
    """Return the value at a position in the file."""
    for part in place:
        raw = raw[part]
    return raw


def _key(place: Place) -> str:
    """Return a position in the notation that people use, such as limits.platform.x[0]."""
    return printable("".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip("."))
