"""Marks: one that has no place, or contradicts itself, is refused with its output and what is missing."""

from __future__ import annotations

import math
from typing import Any

import pytest
from trirail.wire.marks import Mark, marks_of


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, "a mark of 'valve' has none: exactly one of after_start, .*, start is needed"),
        ({"after_start": 1.0, "start": 1.0}, "has after_start and start: exactly one of"),
        ({"after_start": 1.0, "end": 2.0}, "has an end or increment without a start"),
        ({"start": 0.0, "increment": 1.0}, "has an increment, and needs a pulse_width too"),
        ({"start": 0.0, "pulse_width": 1.0}, "has a start and a pulse_width, and needs an increment too"),
        ({"start": 1.0, "end": 1.0}, "a repetition of 'valve' ends at 1 m: its end must be after its start"),
        ({"at": {}}, "at accepts exactly one coordinate: x, y or phi"),
        ({"at": {"x": 0.0, "phi": 0.0}}, "at accepts exactly one coordinate: x, y or phi"),
    ],
)
def test_a_mark_that_contradicts_itself_is_told_with_its_output(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        marks_of([{"output": "valve", **fields}])


@pytest.mark.parametrize("name", ["after_start", "at_path_fraction", "pulse_width"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_mark_of_a_program_has_finite_numbers(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is {value}: it must be a finite number"):
        Mark("valve", **{name: value})  # type: ignore[arg-type]
