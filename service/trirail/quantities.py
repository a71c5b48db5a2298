"""Formatting of quantities in millimetres and degrees for people; programs receive SI units."""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import Final

DISPLAY_UNITS: Final = {"m": (" mm", 1e3), "rad": ("°", 180.0 / math.pi)}
"""Display unit for each SI unit, and the factor that converts to it."""
_SMALLER: Final = {"m": ((" µm", 1e6), (" nm", 1e9)), "rad": ((" mrad", 1e3), (" µrad", 1e6), (" nrad", 1e9))}
_DIGITS: Final = 6
FAMILIAR_UNITS: Final = {"m": (1e-3, 1.0), "rad": (math.pi / 180.0, 2.0)}
"""Size of a millimetre and a degree in SI units, and the smallest number that suggests that they were intended."""
_ZERO: Final = 1e-12
"""Magnitude below which a number of millimetres or degrees is displayed as 0."""


def worded(value: float, unit: str) -> str:
    """Format a length, an angle or a rate of change of either with six significant digits."""
    return apart(value, value, unit)[0]


def apart(value: float, other: float, unit: str) -> tuple[str, str]:
    """Format two values with six significant digits, or with as many more as are needed to tell them apart."""
    base, per, rate = unit.partition("/")
    shown, size = DISPLAY_UNITS.get(base, (f" {base}" if base else "", 1.0))
    digits = _DIGITS
    while digits < 17 and value != other and _same(value * size, other * size, digits):
        digits += 1
    return f"{_number(value * size, digits)}{shown}{per}{rate}", f"{_number(other * size, digits)}{shown}{per}{rate}"


def beyond(name: str, value: float, limit: float, unit: str) -> str:
    """Describe a value beyond its limit; state the difference if six digits are too few to show it."""
    base, per, rate = unit.partition("/")
    size = DISPLAY_UNITS.get(base, ("", 1.0))[1]
    if math.isfinite(value) and _same(value * size, limit * size, _DIGITS):
        smaller = _SMALLER.get(base, ((f" {base}" if base else "", 1.0),))
        unit_name, factor = next((each for each in smaller if abs(value - limit) * each[1] >= 1.0), smaller[-1])
        return (
            f"{name} is {abs(value - limit) * factor:.3g}{unit_name}{per}{rate} beyond the limit of "
            f"{worded(limit, unit)}"
        )
    return f"{name} {worded(value, unit)} is beyond the limit of {worded(limit, unit)}"


def apart_from_limit(value: float, limit: float, unit: str) -> tuple[str, str]:
    """Format a value of either sign and the limit of its magnitude, as `apart` does."""
    shown, most = apart(value, math.copysign(limit, value), unit)
    return shown, most.removeprefix("-")


def rounded_inwards(bound: float, digits: int, *, low: bool) -> float:
    """Round a lower bound up, if `low`, or an upper bound down, so that the rounded number is also within the bound."""
    rounding = ROUND_CEILING if low else ROUND_FLOOR
    return float(Context(prec=digits, rounding=rounding).create_decimal(Decimal(repr(bound))))


_WHOLE_TOLERANCE: Final = 1e-6
"""Maximum rounding error of an angle that was converted from degrees [0.01°]."""


def as_familiar_unit(value: float, limit: float, unit: str) -> float | None:
    """Reinterpret a bare number that exceeds its SI limit as millimetres or degrees.

    Returns the value in SI units, or None if this interpretation is implausible. An angle that is a whole number of
    hundredths of a degree is assumed to have been converted from degrees already.
    """
    size, minimum = FAMILIAR_UNITS[unit.removesuffix("/s")]
    hundredths = 100.0 * math.degrees(value)
    if unit.startswith("rad") and math.isfinite(hundredths) and abs(hundredths - round(hundredths)) < _WHOLE_TOLERANCE:
        return None
    return value * size if abs(value) >= minimum and abs(value) * size <= abs(limit) else None


def _same(value: float, other: float, digits: int) -> bool:
    return _number(value, digits) == _number(other, digits)


def _number(value: float, digits: int) -> str:
    return f"{0.0 if abs(value) < _ZERO else value:.{digits}g}"  # display -0 as 0
