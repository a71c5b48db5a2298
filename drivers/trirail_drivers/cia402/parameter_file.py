"""A drive's parameters in a file: one TOML a drive, with who the drive is."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import msgspec
from msgspec import Meta, Struct

from trirail_drivers import files
from trirail_drivers.cia402.objects import Key
from trirail_drivers.cia402.parameters import KINDS, Parameter, Value, encoded, named
from trirail_drivers.errors import DriveError, FileError

_HEAD: Final = "# The parameters of one drive, as trirail drives save has read them; for compare and restore."
_KEY: Final = re.compile(r"[0-9A-F]{4}:[0-9A-F]{2}")
_Number = Annotated[int, Meta(ge=0, le=2**32 - 1)]


class Origin(Struct, frozen=True, forbid_unknown_fields=True):
    """Which drive it is. None is what a drive does not tell (1018h)."""

    axis: Annotated[str, Meta(pattern="^[ABC]$")]
    node: Annotated[int, Meta(ge=1, le=127)]
    device_type: _Number
    saved: str
    """When, by the wall clock (ISO 8601)."""
    dictionary: str
    """Which EDS has named its objects."""
    vendor: _Number | None = None
    product: _Number | None = None
    revision: _Number | None = None
    serial: _Number | None = None


@dataclass(frozen=True, slots=True)
class Saved:
    """What a drive held."""

    origin: Origin
    parameters: Mapping[Key, Parameter]
    unread: Mapping[Key, str]
    """What it did not tell, and why."""


class Different(NamedTuple):
    """A parameter that two drives, or files, do not have alike."""

    key: Key
    name: str
    one: Parameter | None
    """None where there is none."""
    other: Parameter | None


class _Entry(Struct, frozen=True, forbid_unknown_fields=True):
    type: str
    value: int | float | str
    name: str = ""


class _Content(Struct, frozen=True, forbid_unknown_fields=True):
    drive: Origin
    parameters: dict[str, _Entry]
    unread: dict[str, str] = {}


def compare(one: Saved, other: Saved) -> list[Different]:
    """What differs, in the order of the objects; what one of them was not told of is not compared."""
    found = []
    for key in sorted({*one.parameters, *other.parameters} - {*one.unread, *other.unread}):
        mine, theirs = one.parameters.get(key), other.parameters.get(key)
        if mine is None or theirs is None or mine.data != theirs.data:
            known = mine or theirs
            found.append(Different(key, known.name if known else "", mine, theirs))
    return found


def told(value: int | None) -> str:
    """A number of an origin for people."""
    return "not told" if value is None else f"{value:08X}h"


def write(path: Path, saved: Saved) -> None:
    """Write a file whole or not at all; FileError where it cannot be."""
    try:
        files.replace(path, ("\n".join(_lines(saved)) + "\n").encode())
    except OSError as error:
        raise FileError(f"{path}: {error.strerror}") from error


def read(path: Path) -> Saved:
    """What a file has; FileError where it cannot be read, DriveError where it is none of a drive's parameters."""
    text = files.text(path)
    try:
        content = msgspec.toml.decode(text, type=_Content)
        parameters = {_key(at): _parameter(at, entry) for at, entry in content.parameters.items()}
        return Saved(content.drive, parameters, {_key(at): why for at, why in content.unread.items()})
    except ValueError as error:  # msgspec's own among them
        raise DriveError(f"{path} is no file of a drive's parameters: {' '.join(str(error).split())}") from error


def _lines(saved: Saved) -> Iterator[str]:
    yield from (_HEAD, "", "[drive]")
    for field, told in msgspec.structs.asdict(saved.origin).items():
        if told is not None:
            yield f"{field} = {_literal(told) if field == 'node' or isinstance(told, str) else f'0x{told:08X}'}"
    yield from ("", "[parameters]")
    for key, parameter in sorted(saved.parameters.items()):
        value, name = _literal(parameter.value), _literal(parameter.name)
        yield f'"{named(key)}" = {{ type = "{parameter.kind}", value = {value}, name = {name} }}'
    yield from ("", "[unread]")
    for key, why in sorted(saved.unread.items()):
        yield f'"{named(key)}" = {_literal(why)}'


def _literal(value: Value) -> str:
    if isinstance(value, str):
        return json.dumps(value).replace("\x7f", "\\u007f")  # as TOML's basic strings have them
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # TOML has inf, -inf and nan
    return repr(value)


def _key(text: str) -> Key:
    if not _KEY.fullmatch(text):
        raise ValueError(f'"{text}" is no object; as in "6065:00"')
    return int(text[:4], 16), int(text[5:], 16)


def _parameter(at: str, entry: _Entry) -> Parameter:
    if entry.type not in KINDS:
        raise ValueError(f'parameters.{at}: type "{entry.type}" is unknown; known are {", ".join(KINDS)}')
    try:
        return Parameter(entry.type, encoded(entry.type, entry.value), entry.name)
    except ValueError as error:
        raise ValueError(f"parameters.{at}: {error}") from error
