"""The reference of every configuration key, configs/README.md: python tools/config_reference.py [--check].

It is made from the types in trirail.config and trirail_drivers.config: sections, keys, what is allowed, defaults, and
the docstrings. With --check nothing is written; exit 1 if the file is not what the types say.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import config_limits
import docstrings
import msgspec
from msgspec import inspect as mi
from trirail.cli.config_commands import shipped_files
from trirail.config import Config

_SECTION = re.compile(r"^Section \[[^]]*\](\.|: )")
"""With what the types' docstrings begin, and the headings say already."""

FILE = Path(__file__).parents[1] / "configs/README.md"

HEAD = """\
# Configurations

One TOML file is one robot. It is strict: an unknown key, a wrong type or an impossible value is
refused with the file, the key, the value and what is allowed. SI units and radians throughout.

{files}

```sh
trirail config                              # the list above, wherever trirail is installed
trirail config copy socketcan robot.toml    # one to start from
trirail config show robot.toml              # every key as it will be used, and what differs from sim.toml
trirail doctor robot.toml                   # this machine, its rights, the CAN interface and the bus load for it
```

Alignment stages, UVW and XXY: [which one have I got?](stages.md) A real robot, step by step:
[drivers/README.md](../drivers/README.md#bring-up-a-drive).

What follows is made by `tools/config_reference.py` from `service/trirail/config/tables.py` and
`drivers/trirail_drivers/config.py`: a key's docstring is its row.
"""


LINE = r"^[^\x00-\x1f\x7f]*$"
"""The pattern of any text on one line; nothing that a reader has to know."""


class Section(NamedTuple):
    """A table of the file: its headings as they are written there, and its type."""

    headings: tuple[str, ...]
    kind: type
    needed: bool


def sections(kind: type = Config, path: str = "") -> Iterator[Section]:
    """Yield the tables below a type, in their order; those of one type side by side are one section."""
    found: dict[type, list[tuple[str, bool, bool]]] = {}
    for field in _fields(kind):
        inner, many = _table(field.type)
        if inner is not None:
            name = f"{path}.{field.encode_name}" if path else field.encode_name
            found.setdefault(inner, []).append((name, many, field.required))
    for inner, places in found.items():
        headings = tuple(f"[[{name}]]" if many else f"[{name}]" for name, many, _ in places)
        yield Section(headings, inner, any(needed for _, _, needed in places))
        yield from sections(inner, places[0][0])


def keys(kind: type) -> Iterator[tuple[str, str, str, str]]:
    """Yield of each key of a table that is no table itself: name, what is allowed, default, meaning."""
    said = docstrings.fields(kind)
    for field in _fields(kind):
        if _table(field.type)[0] is None:
            default = "" if field.required else "none" if field.default is None else f"`{json.dumps(_default(field))}`"
            yield field.encode_name, allowed(field.type), default, said.get(field.encode_name, "")


def names() -> set[str]:
    """Return every key by its whole name, as limits.slider.velocity."""
    return {
        f"{heading.strip('[]')}.{key}"
        for headings, kind, _ in sections()
        for heading in headings
        for key, *_ in keys(kind)
    }


def allowed(kind: mi.Type) -> str:
    """Say in words which values a type takes."""
    match kind:
        case mi.Metadata(type=inner, extra_json_schema={"description": said}):
            return f"{said}; each {_number(inner)}"
        case mi.UnionType(types=types):
            return " or ".join(allowed(part) for part in types if not isinstance(part, mi.NoneType))
        case mi.EnumType(cls=cls):
            return ", ".join(f"`{json.dumps(member.value)}`" for member in cls)
        case mi.LiteralType(values=values):
            return ", ".join(f"`{json.dumps(value)}`" for value in values)
        case mi.IntType() | mi.FloatType():
            return ("integer" if isinstance(kind, mi.IntType) else "number") + _bounds(kind)
        case mi.StrType(pattern=pattern):
            return "text" if pattern in (None, LINE) else f"text, `{pattern}`"
        case mi.BoolType():
            return "`true`, `false`"
        case mi.TupleType(item_types=items):
            return f"{len(items)} × {allowed(items[0])}"
        case mi.DictType(value_type=value):
            return f"table of {allowed(value)}"
        case mi.VarTupleType(item_type=item):
            return f"list of {allowed(item)}"
    raise TypeError(f"no words for {kind}: add them here")


def _number(kind: mi.Type) -> str:
    """Say what the numbers of a type may be that takes one or several."""
    match kind:
        case (
            mi.UnionType(types=(mi.FloatType() as number, *_))
            | mi.VarTupleType(item_type=mi.UnionType(types=(mi.FloatType() as number, *_)))
        ):
            return _bounds(number).removeprefix(", ")
    raise TypeError(f"no words for {kind}: add them here")


def reference() -> str:
    """Return the text of the file."""
    files = "\n".join(f"- [{name}]({name}): {purpose}" for name, purpose in shipped_files().items())
    parts = [HEAD.format(files=files), config_limits.table(names())]
    for headings, kind, needed in sections():
        title = ", ".join(f"`{heading}`" for heading in headings) + ("" if needed else ", may be absent")
        doc = _SECTION.sub("", " ".join((kind.__doc__ or "").split()))
        rows = [f"| `{name}` | {_cell(values)} | {default or 'needed'} | {_cell(text)} |"
                for name, values, default, text in keys(kind)]  # fmt: skip
        table = ["", "| key | value | default | meaning |", "|---|---|---|---|", *rows] if rows else []
        parts.append("\n".join([f"## {title}", *(["", doc[0].upper() + doc[1:]] if doc else []), *table]) + "\n")
    for name, values, _, text in keys(Config):  # a table whose keys are names
        rows = [
            "",
            "| key | value | default | meaning |",
            "|---|---|---|---|",
            f"| any name | {values.removeprefix('table of ')} | | |",
        ]
        parts.append("\n".join([f"## `[{name}]`, may be absent", "", text, *rows]) + "\n")
    return "\n".join(parts)


def _fields(kind: type) -> tuple[mi.Field, ...]:
    found = mi.type_info(kind)
    if not isinstance(found, mi.StructType):
        raise TypeError(f"{kind} is no table")
    return found.fields


def _default(field: mi.Field) -> object:
    return field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()


def _table(kind: mi.Type) -> tuple[type | None, bool]:
    """Return the type of the table that a key holds, None if it holds none, and whether it holds several."""
    match kind:
        case mi.UnionType(types=types):
            return next((found for part in types if (found := _table(part))[0] is not None), (None, False))
        case mi.StructType(cls=cls):
            return cls, False
        case mi.TupleType(item_types=(mi.StructType(cls=cls), *_)) | mi.VarTupleType(item_type=mi.StructType(cls=cls)):
            return cls, True
    return None, False


def _bounds(kind: mi.IntType | mi.FloatType) -> str:
    if kind.ge is not None and kind.le is not None:
        return f", {kind.ge:g} to {kind.le:g}"
    signs = {">": kind.gt, "≥": kind.ge, "<": kind.lt, "≤": kind.le}
    return " and".join(f" {sign} {bound:g}" for sign, bound in signs.items() if bound is not None)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "\\<")


def main() -> int:
    """Write the file, or check it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if the file is not current")
    if parser.parse_args().check:
        if FILE.read_text(encoding="utf-8") != reference():
            print(f"{FILE} is not what the types say: run python tools/config_reference.py")
            return 1
        return 0
    FILE.write_text(reference(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
