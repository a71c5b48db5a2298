"""Parsing of quantities such as 5mm, -0.2in, 350um, 1.5deg, 5arcsec and 20mm/s. Numbers without a unit are in SI units.

The values of the units are decimal numbers, so that 5mm is exactly the same float as 0.005.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from decimal import Decimal
from typing import Final, NamedTuple

from trirail.wire.text import NUMBER, comma_hint, quoted

_DEGREE: Final = Decimal("0.0174532925199432957692369076848861271344")
"""π / 180 with more digits than a float."""
_WRITTEN: Final = re.compile(rf"\s*({NUMBER})\s*(.*?)\s*")


class Dimension(NamedTuple):
    """Physical dimension of a quantity."""

    name: str
    """Name with its article, for error messages."""
    units: Mapping[str, Decimal]
    """Values of the units in SI, by symbol. A number without a unit has the first unit."""
    examples: str


def _per(units: Mapping[str, Decimal], *times: str) -> dict[str, Decimal]:
    return {unit + time: size for unit, size in units.items() for time in times}


_METRES: Final = {
    "m": Decimal(1),
    "cm": Decimal("0.01"),
    "mm": Decimal("0.001"),
    "µm": Decimal("1e-6"),  # the micro sign of keyboards
    "μm": Decimal("1e-6"),  # the Greek letter
    "um": Decimal("1e-6"),
    "nm": Decimal("1e-9"),
    "in": Decimal("0.0254"),
}
_RADIANS: Final = {
    "rad": Decimal(1),
    "mrad": Decimal("0.001"),
    "µrad": Decimal("1e-6"),
    "μrad": Decimal("1e-6"),
    "urad": Decimal("1e-6"),
    "deg": _DEGREE,
    "°": _DEGREE,
    "arcmin": _DEGREE / 60,
    "arcsec": _DEGREE / 3600,
}
_SECONDS: Final = {
    "s": Decimal(1),
    "ms": Decimal("0.001"),
    "µs": Decimal("1e-6"),
    "μs": Decimal("1e-6"),
    "us": Decimal("1e-6"),
    "min": Decimal(60),
}

LENGTH: Final = Dimension("a length", _METRES, "5mm, 0.5um, -0.2in, 0.005")
ANGLE: Final = Dimension("an angle", _RADIANS, "1.5deg, 5arcsec, 10mrad, 0.01")
VELOCITY: Final = Dimension("a velocity", _per(_METRES, "/s"), "5mm/s, -0.2in/s, 0.005")
ANGULAR_VELOCITY: Final = Dimension("an angular velocity", _per(_RADIANS, "/s"), "1.5deg/s, 10mrad/s, 0.01")
ACCELERATION: Final = Dimension("an acceleration", _per(_METRES, "/s²", "/s2", "/s^2"), "50mm/s², 0.05")
ANGULAR_ACCELERATION: Final = Dimension(
    "an angular acceleration", _per(_RADIANS, "/s²", "/s2", "/s^2"), "15deg/s², 0.1"
)
TIME: Final = Dimension("a time", _SECONDS, "2s, 500ms, 0.5")
PERCENTAGE: Final = Dimension("a percentage", {"%": Decimal(1)}, "50%, 50")
DIMENSIONS: Final = (
    LENGTH,
    ANGLE,
    VELOCITY,
    ANGULAR_VELOCITY,
    ACCELERATION,
    ANGULAR_ACCELERATION,
    TIME,
    PERCENTAGE,
)
SIZES: Final = {unit: size for dimension in DIMENSIONS for unit, size in dimension.units.items()}
"""Values of all units in SI, by symbol."""


def quantity(text: str, dimension: Dimension, bare: str | None = None) -> float:
    """Convert a text to a quantity in SI units, or to a percentage in %.

    A number without a unit has the unit `bare`; the default is the SI unit. The result is rounded only once, so that
    5mm is the float 0.005. Raises ValueError with the expected form if the text is invalid.
    """
    match = _WRITTEN.fullmatch(text)
    unit = (match[2] or bare or next(iter(dimension.units))) if match else ""
    size = dimension.units.get(unit)
    if match is None or size is None or not math.isfinite(float(match[1])):
        alone = bare or next(iter(dimension.units))
        units = ", ".join(name for name in dimension.units if "μ" not in name and "^" not in name)
        hint = "; write no space before the unit" if text.strip() in dimension.units else comma_hint(text)
        raise ValueError(
            f"{quoted(text.strip())!r} is not {dimension.name} such as {dimension.examples}; "
            f"units are {units}; a bare number is in {alone}{hint}"
        )
    return float(Decimal(match[1]) * size)
