"""EDS files written from facts: rows of index, sub-index, CiA 301 data type, access, default, PDO-mappable.

The rows of tests/data/drives were read from what makers publish of their drives; their EDS files carry no licence and
are not here. A row's default is of node id 1: identifiers that follow the node id are written as `$NODEID+…` again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from itertools import groupby
from pathlib import Path
from typing import Final

DRIVES: Final = Path(__file__).parent / "data/drives"
MAKES: Final = tuple(sorted(path.stem for path in DRIVES.glob("*.json")))

Row = tuple[int, int, int, str, int | float | str | None, bool]

_HEAD = """[FileInfo]
FileName=made.eds
EDSVersion=4.0

[DeviceInfo]
VendorName=made from facts
BaudRate_1000=1
Granularity=8
"""
_BY_NODE: Final = (0x80, 0x180, 0x200, 0x280, 0x300, 0x380, 0x400, 0x480, 0x500, 0x580, 0x600)
"""Bases of the pre-defined connection set (CiA 301): the node id is added."""


def rows(make: str) -> list[Row]:
    """The facts of one drive."""
    read = json.loads((DRIVES / f"{make}.json").read_text())
    return [(int(index, 16), *rest) for index, *rest in read]


def eds(facts: Iterable[Row], values: Mapping[tuple[int, int], int] | None = None, lacks: Iterable[int] = ()) -> str:
    """The EDS of a drive; `values` takes the place of defaults, and it has none of the indices that it `lacks`."""
    given, missing = values or {}, set(lacks)
    text = [_HEAD]
    for index, group in groupby(sorted(facts, key=lambda row: row[:2]), key=lambda row: row[0]):
        if index in missing:
            continue
        members = list(group)
        if [row[1] for row in members] == [0]:
            text.append(_section(f"{index:04X}", members[0], given))
            continue
        text.append(f"[{index:04X}]\nParameterName=Object {index:04X}\nObjectType=0x9\nSubNumber={len(members)}\n")
        text += [_section(f"{index:04X}sub{row[1]:X}", row, given) for row in members]
    return "\n".join(text)


def make_eds(folder: Path, make: str, values: Mapping[tuple[int, int], int] | None = None) -> Path:
    """Write the EDS of a drive into a folder."""
    path = folder / f"{make}.eds"
    path.write_text(eds(rows(make), values))
    return path


def _section(name: str, row: Row, values: Mapping[tuple[int, int], int]) -> str:
    index, subindex, kind, access, default, mappable = row
    default = values.get((index, subindex), default)
    lines = [f"[{name}]", f"ParameterName=Object {name}", "ObjectType=0x7", f"DataType=0x{kind:04X}",
             f"AccessType={access}", f"PDOMapping={mappable:d}"]  # fmt: skip
    if default is not None:
        lines.append(f"DefaultValue={_default(index, subindex, default)}")
    return "\n".join(lines) + "\n"


def _default(index: int, subindex: int, value: int | float | str) -> str:
    """An identifier that follows the node id, or a plain value."""
    identifier = (index, subindex) == (0x1014, 0) or (
        subindex in (1, 2) and (0x1200 <= index < 0x1280 or (subindex == 1 and index & 0xFE00 in (0x1400, 0x1800)))
    )
    if identifier and isinstance(value, int) and (value & 0x7FF) - 1 in _BY_NODE:
        return f"$NODEID+0x{value - 1:X}"
    return str(value)
