"""A quantity in words for people: millimetres and degrees. What programs get is in SI units."""

from __future__ import annotations

import math
from typing import Final

SHOWN: Final = {"m": (" mm", 1e3), "rad": ("°", 180.0 / math.pi)}
"""What people read in place of a unit, and how many of it that is."""
_SMALLER: Final = {"m": ((" µm", 1e6), (" nm", 1e9)), "rad": ((" mrad", 1e3), (" µrad", 1e6), (" nrad", 1e9))}
_DIGITS: Final = 6
_NOTHING: Final = 1e-12
"""Less of mm or ° is 0."""


def worded(value: float, unit: str) -> str:
    """Write a value in SI, of m or rad or any rate of these, with six significant digits."""
    return apart(value, value, unit)[0]


def apart(value: float, other: float, unit: str) -> tuple[str, str]:
    """Write two values with six significant digits, or as many more as it takes to tell them apart."""
    base, per, rate = unit.partition("/")
    name, size = SHOWN.get(base, (f" {base}" if base else "", 1.0))
    digits = _DIGITS
    while digits < 17 and value != other and _same(value * size, other * size, digits):
        digits += 1
    return f"{_number(value * size, digits)}{name}{per}{rate}", f"{_number(other * size, digits)}{name}{per}{rate}"


def beyond(what: str, value: float, limit: float, unit: str) -> str:
    """Say that a value is beyond its limit; by how much, where six digits do not show that."""
    base, per, rate = unit.partition("/")
    size = SHOWN.get(base, ("", 1.0))[1]
    if math.isfinite(value) and _same(value * size, limit * size, _DIGITS):
        smaller = _SMALLER.get(base, ((f" {base}" if base else "", 1.0),))
        name, more = next((each for each in smaller if abs(value - limit) * each[1] >= 1.0), smaller[-1])
        return f"{what} is {abs(value - limit) * more:.3g}{name}{per}{rate} beyond its limit {worded(limit, unit)}"
    return f"{what} {worded(value, unit)} is beyond its limit {worded(limit, unit)}"


def _same(value: float, other: float, digits: int) -> bool:
    return _number(value, digits) == _number(other, digits)


def _number(value: float, digits: int) -> str:
    return f"{0.0 if abs(value) < _NOTHING else value:.{digits}g}"  # 0 and -0 are one number
