"""Quantities as people read them: millimetres and degrees, two that differ told apart."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from trirail.quantities import apart, apart_from_limit, beyond, rounded_inwards, worded

UNITS = {unit + per: size for unit, size in (("m", 1e3), ("rad", 180.0 / math.pi)) for per in ("", "/s", "/s²", "/s³")}
values = st.floats(-1e3, 1e3)


@pytest.mark.parametrize(
    ("value", "unit", "said"),
    [
        (0.005, "m", "5 mm"),
        (math.radians(80.0), "rad", "80°"),
        (-2.0, "m/s", "-2000 mm/s"),
        (math.radians(-15.0), "rad/s²", "-15°/s²"),
        (1.0, "m/s³", "1000 mm/s³"),
        (-0.0, "m", "0 mm"),
        (2.5, "s", "2.5 s"),
        (math.nan, "m", "nan mm"),
    ],
)
def test_a_value_is_said_in_millimetres_or_degrees(value: float, unit: str, said: str) -> None:
    assert worded(value, unit) == said


def read(said: str, unit: str) -> float:
    """Return in SI what a quantity in words says."""
    return float(said.split(" ", maxsplit=1)[0].split("°", maxsplit=1)[0]) / UNITS[unit]


def seen(value: float, unit: str) -> float:
    """Return what is to be told apart: below 1e-12 mm or ° all is 0."""
    return value * UNITS[unit] if abs(value * UNITS[unit]) >= 1e-12 else 0.0


@example(-0.0, 0.0, "m")
@given(values, st.floats(-1e-3, 1e-3), st.sampled_from(sorted(UNITS)))
def test_two_values_are_told_apart_by_as_many_digits_as_that_takes(limit: float, more: float, unit: str) -> None:
    one, other = apart(limit + more, limit, unit)
    assert (one != other) is (abs(more) > 0.0 and seen(limit + more, unit) != seen(limit, unit))
    assert read(other, unit) == pytest.approx(limit, rel=1e-5, abs=1e-12)
    assert read(one, unit) == pytest.approx(limit + more, rel=1e-5, abs=1e-12)


@given(values, st.floats(1e-8, 1e-2), st.sampled_from(sorted(UNITS)))
def test_what_is_beyond_a_limit_says_so_without_a_row_of_digits(limit: float, more: float, unit: str) -> None:
    said = beyond("x", limit + more, limit, unit)
    assert said.startswith("x ")
    assert " beyond the limit of " in said
    numbers = re.findall(r"-?[0-9][0-9.]*(?:e[-+][0-9]+)?", said)
    assert all(len(number.lstrip("-").split("e")[0].replace(".", "").lstrip("0")) <= 6 for number in numbers)
    assert numbers[0] != numbers[-1] or "is " in said.split(" beyond")[0]


@pytest.mark.parametrize(
    ("value", "limit", "unit", "said"),
    [
        (-0.17000001, -0.17, "m", "p is 10 nm beyond the limit of -170 mm"),
        (0.8500001, 0.85, "rad", "p is 100 nrad beyond the limit of 48.7014°"),
        (0.17001, 0.17, "m", "p 170.01 mm is beyond the limit of 170 mm"),
        (0.50000005, 0.5, "m/s", "p is 50 nm/s beyond the limit of 500 mm/s"),
    ],
)
def test_what_is_hardly_beyond_says_by_how_much(value: float, limit: float, unit: str, said: str) -> None:
    assert beyond("p", value, limit, unit) == said


@example(2.30066e-6, 2e-3, -1.0)
@given(st.floats(1e-6, 1.0), st.floats(1e-9, 10.0), st.sampled_from((-1.0, 1.0)))
def test_a_value_is_seen_to_exceed_its_limit(limit: float, excess: float, sign: float) -> None:
    shown = apart_from_limit(sign * limit * (1.0 + excess), limit, "m")
    error, most = (float(each.removesuffix(" mm")) for each in shown)
    assert sign * error > most > 0.0


@example(2.0 * math.pi, 6)
@given(st.floats(-1e12, 1e12), st.integers(3, 10))
def test_a_rounded_bound_is_within_the_bound(bound: float, digits: int) -> None:
    for low in (False, True):
        rounded = float(f"{rounded_inwards(bound, digits, low=low):.{digits}g}")
        assert rounded >= bound if low else rounded <= bound
        assert rounded == pytest.approx(bound, rel=10.0 ** (1 - digits))
