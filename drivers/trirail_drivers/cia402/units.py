"""Units of velocity and acceleration of a drive, from the drive or its configuration, and their conversion to SI.

Positions are in the unit of object 6064h; there are `counts_per_metre` of this unit in a metre. A drive reports its
units of position, velocity and acceleration in 60A8h, 60A9h and 60AAh (CiA 402-2), each as a power of ten, a numerator
and a denominator (CiA 303-2). Alternatively, the velocity factor 6096h and the acceleration factor 6097h relate
velocity and acceleration to position: velocity = position units per second * numerator / divisor. The manual of
Kollmorgen's AKD2G states this for 6096h, and the defaults of Beckhoff's AX8000 agree: 600000 / 1048576 at 2^20 counts
per turn is 0.0001 rpm, and with this unit, 6097h = 360 / 600000 results in degrees per second squared. A drive that
uses the inverse factor contradicts a correct `velocity_unit`, and is refused.

If a drive reports neither units nor factors, `velocity_unit` and `acceleration_unit` are required. No unit is assumed,
since a velocity offset in the wrong unit would move the machine.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal

from trirail_drivers.config import Drive
from trirail_drivers.driver.scaling import INT32_MAX, UINT32_MAX, Scale
from trirail_drivers.errors import DriveError


class UnitBase(StrEnum):
    """Quantity of which a unit is a multiple or a fraction."""

    COUNTS = "counts"
    """Unit of 6064h."""
    TURNS = "revolutions"
    METRES = "metres"


@dataclass(frozen=True, slots=True)
class Unit:
    """Unit of position, velocity or acceleration: `size` counts, revolutions or metres, if need be per second or per
    second squared.
    """

    base: UnitBase
    size: float
    name: str

    def per_metre(self, counts_per_metre: float, revolutions_per_metre: float | None) -> float | None:
        """Return the number of units in a metre of slider travel; None if the revolutions per metre are needed for this
        but unknown.
        """
        per_metre = {UnitBase.COUNTS: counts_per_metre, UnitBase.TURNS: revolutions_per_metre, UnitBase.METRES: 1.0}
        whole = per_metre[self.base]
        return None if whole is None else whole / self.size

    def is_same(self, other: Unit) -> bool:
        """Whether two units are equal, even if their names differ."""
        return self.base is other.base and math.isclose(self.size, other.size, rel_tol=1e-9)


# The codes of SI units and other common units are from CiA 303-2, B4h and B5h from CiA 402. Manufacturers use ACh, C0h.
_NUMERATORS: Final = {
    0x01: (UnitBase.METRES, 1.0, "m"),
    0xC1: (UnitBase.METRES, 0.0254, "in"),
    0x10: (UnitBase.TURNS, 1.0 / math.tau, "rad"),
    0x40: (UnitBase.TURNS, 1.0 / 400.0, "gon"),
    0x41: (UnitBase.TURNS, 1.0 / 360.0, "deg"),
    0x42: (UnitBase.TURNS, 1.0 / 360.0 / 60.0, "arcmin"),
    0x43: (UnitBase.TURNS, 1.0 / 360.0 / 3600.0, "arcsec"),
    0xB4: (UnitBase.TURNS, 1.0, "rev"),
    0xB5: (UnitBase.COUNTS, 1.0, "counts"),
    0xAC: (UnitBase.COUNTS, 1.0, "counts"),
}
_RPM: Final = 0xC0
"""Numerator for revolutions per minute, which maxon uses for accelerations: 00C00300h is rpm/s."""
_TIMES: Final = {0x03: (1.0, "s"), 0x47: (60.0, "min"), 0x48: (3600.0, "h")}
_SECOND_SQUARED: Final = 0x57


def position_unit(code: int) -> Unit | None:
    """Return the position unit encoded in 60A8h; None if it is unknown."""
    return _decoded(code, 0)


def velocity_unit(code: int) -> Unit | None:
    """Return the velocity unit encoded in 60A9h; None if it is unknown."""
    return _decoded(code, 1)


def acceleration_unit(code: int) -> Unit | None:
    """Return the acceleration unit encoded in 60AAh; None if it is unknown.

    If the numerator is a unit of position, the denominator "seconds" means seconds squared.
    """
    return _decoded(code, 2)


def _decoded(code: int, power: int) -> Unit | None:
    prefix, numerator, denominator = code >> 24, code >> 16 & 0xFF, code >> 8 & 0xFF
    factor = 10.0 ** (prefix - 256 if prefix > 127 else prefix)
    if numerator == _RPM and power > 0:
        base, size, name = UnitBase.TURNS, 1.0 / 60.0, "rpm"
        power -= 1
    elif numerator in _NUMERATORS:
        base, size, name = _NUMERATORS[numerator]
    else:
        return None
    if power == 0:
        seconds, per = 1.0, ""
    elif power == 2 and denominator == _SECOND_SQUARED:
        seconds, per = 1.0, "/s2"
    elif denominator in _TIMES:
        time, symbol = _TIMES[denominator]
        seconds, per = time**power, f"/{symbol}{'2' if power == 2 else ''}"
    else:
        return None
    return Unit(base, factor * size / seconds, f"{'' if factor == 1.0 else f'{factor:g} '}{name}{per}")


_WORDS: Final = {
    "counts": (UnitBase.COUNTS, 1.0),
    "inc": (UnitBase.COUNTS, 1.0),
    "rev": (UnitBase.TURNS, 1.0),
    "rad": (UnitBase.TURNS, 1.0 / math.tau),
    "deg": (UnitBase.TURNS, 1.0 / 360.0),
    "m": (UnitBase.METRES, 1.0),
    "mm": (UnitBase.METRES, 1e-3),
    "um": (UnitBase.METRES, 1e-6),
    "µm": (UnitBase.METRES, 1e-6),
}
_WRITTEN: Final = re.compile(r"(?:(\d+(?:\.\d+)?(?:e-?\d+)?) +)?(rpm|[a-zµ]+/(?:s|min|h))((?:/(?:s|min|h))?|2)")
FACTORS: Final = 1e-9, 1e9
"""Bounds of the factor before a unit. All drives' factors are far within the bounds, and the bounds within floats."""
_SECONDS: Final = {symbol: seconds for seconds, symbol in _TIMES.values()}


def parse_unit(key: str, text: str, power: int) -> Unit:
    """Parse a configured unit of velocity (power 1) or acceleration (2). Raises DriveError with the key."""
    match = _WRITTEN.fullmatch(text.strip())
    if match is not None:
        number, rate, per = match.groups()
        word, time = ("rev", "min") if rate == "rpm" else rate.split("/")
        times = _SECONDS[time] * (1.0 if not per else _SECONDS[time] if per == "2" else _SECONDS[per[1:]])
        if word in _WORDS and bool(per) == (power == 2) and not (rate == "rpm" and per == "2"):
            base, size = _WORDS[word]
            factor = float(number) if number else 1.0
            if FACTORS[0] <= factor <= FACTORS[1]:
                return Unit(base, factor * size / times, text.strip())
    kind, shown = (
        ("velocities", '"counts/s", "0.1 counts/s", "rpm", "rev/s", "deg/s", "rad/s", "mm/s", "m/min"')
        if power == 1
        else ("accelerations", '"counts/s2", "rpm/s", "rev/s2", "deg/s2", "rad/s2", "mm/s2"')
    )
    raise DriveError(f'{key} = "{text}" is not a unit of {kind}; use a unit such as {shown}')


def check(name: str, drive: Drive, key: Literal["velocity_unit", "acceleration_unit"]) -> None:
    """Raise DriveError for an invalid unit in the configuration of the drive called `name`."""
    text: str | None = getattr(drive, key)
    if text is not None:
        parse_unit(f"drives.{name}.{key}", text, 1 if key == "velocity_unit" else 2)


@dataclass(frozen=True, slots=True)
class Units:
    """Conversion of one drive's quantities to and from SI."""

    scale: Scale
    """Scale of positions."""
    velocity_per_metre: float
    """Velocity units per m/s; negative if the counts decrease as the slider position increases, NaN if unknown."""
    acceleration_per_metre: float
    """Acceleration units per m/s², positive; NaN if unknown."""
    velocity_name: str = "counts/s"
    acceleration_name: str = "counts/s2"

    def check_velocity(self, name: str, fastest: float | None = None) -> None:
        """Raise DriveError if the unit of the velocity offset is unknown, or if `fastest` [m/s] does not fit it."""
        _check_known(name, "velocity", self.velocity_per_metre)
        if fastest is not None and (why := velocity_misfit(fastest, abs(self.velocity_per_metre))):
            raise DriveError(f"drive {name}: its unit of velocity (60A9, or 6096) is {self.velocity_name}: {why}")

    def length(self, name: str, key: str, value: float) -> int:
        """Convert a length [m], such as a following error, to UNSIGNED32; `key` is its configuration key."""
        return _unsigned(name, key, value, abs(self.scale.counts_per_metre), "counts")

    def speed(self, name: str, key: str, value: float) -> int:
        """Convert a speed [m/s] to UNSIGNED32; `key` is its configuration key."""
        _check_known(name, "velocity", self.velocity_per_metre)
        return _unsigned(name, key, value, abs(self.velocity_per_metre), self.velocity_name)

    def acceleration(self, name: str, key: str, value: float) -> int:
        """Convert an acceleration [m/s²] to UNSIGNED32; `key` is its configuration key."""
        _check_known(name, "acceleration", self.acceleration_per_metre)
        return _unsigned(name, key, value, self.acceleration_per_metre, self.acceleration_name)


def velocity_misfit(fastest: float, per_metre: float) -> str:
    """Return the reason why a unit, with `per_metre` units per m/s, does not fit a velocity limit [m/s], or ""."""
    limit = fastest * per_metre
    text = f"limits.slider.velocity = {fastest:g} is {limit:g} of it"
    if limit < 1.0:
        return f"{text}, below the smallest velocity of 1; use a finer unit"
    if 2.0 * limit >= INT32_MAX:  # a velocity may slightly exceed its limit
        return f"{text}, more than half of {INT32_MAX}; use a coarser unit"
    return ""


def _check_known(name: str, quantity: str, per_metre: float) -> None:
    if math.isnan(per_metre):
        index, example = ("60A9", "counts/s") if quantity == "velocity" else ("60AA", "counts/s2")
        raise DriveError(
            f"drive {name}: does not report its unit of {quantity} (object {index}); find it in the manual, and set "
            f'drives.{name}.{quantity}_unit, such as "{example}"'
        )


def _unsigned(name: str, key: str, value: float, per_si: float, unit: str) -> int:
    """Convert a quantity to UNSIGNED32. Raises DriveError for 0, which means no window or ramp, and for FFFFFFFFh,
    which means no supervision.
    """
    exact = per_si * value
    if not 0.5 < exact < UINT32_MAX - 0.5:
        raise DriveError(f"drive {name}: {key} {value:g} is {exact:g} {unit}; a drive accepts 1 to {UINT32_MAX - 1}")
    return round(exact)
