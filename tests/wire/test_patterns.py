"""Patterns of names: a name does not end with a line break, which "$" of Python's patterns would accept."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from msgspec import inspect as mi
from trirail.config import Config
from trirail.config.as_built import AsBuilt
from trirail.wire.goals import Goal
from trirail_drivers.config import NO_LINE_BREAK

ACCEPTED = ("a", "01234567", "6007", "Valve_1")
"""Texts of which each pattern accepts one at least."""


def patterns(kind: Any, seen: set[Any]) -> Iterator[str]:
    """Patterns of the texts within a type."""
    if isinstance(kind, mi.StrType) and kind.pattern:
        yield kind.pattern
    if isinstance(kind, mi.StructType):
        if kind.cls in seen:
            return
        seen.add(kind.cls)
        for field in kind.fields:
            yield from patterns(field.type, seen)
    elif isinstance(kind, msgspec.Struct):
        for name in kind.__struct_fields__:
            inner = getattr(kind, name)
            for each in inner if isinstance(inner, tuple) else (inner,):
                if isinstance(each, mi.Type):
                    yield from patterns(each, seen)


@pytest.mark.parametrize("kind", [Config, AsBuilt, Goal])
def test_no_name_ends_with_a_line_break(kind: Any) -> None:
    found = set(patterns(mi.type_info(kind), set()))
    assert found
    for pattern in found:
        accepted = [text for text in ACCEPTED if re.search(pattern, text)]
        assert accepted, pattern
        assert not any(re.search(pattern, f"{text}\n") for text in accepted), pattern
        assert "\\Z" not in pattern, "which other languages do not know"
        assert pattern.endswith(NO_LINE_BREAK)
