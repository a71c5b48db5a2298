"""A drive's units of velocity and acceleration, as it or its configuration tells them, and what they are in SI.

Positions are `counts_per_metre`: whatever unit 6064h counts in. A drive tells its units of position, velocity and
acceleration in 60A8h, 60A9h and 60AAh (CiA 402-2), each as a power of ten, a numerator and a denominator
(CiA 303-2), or what its velocity is of its position by 6096h and 6097h, the velocity and acceleration factor:
velocity = position units per second * numerator / divisor. So Kollmorgen's AKD2G has it in its manual (6096h), and
Beckhoff's AX8000 in its defaults: 600000 / 1048576 at 2^20 counts a turn is 0.0001 rpm, and 6097h = 360 / 600000 of
that makes degrees per second squared. A maker who means the inverse contradicts a `velocity_unit` that is right, and
is refused.

Where a drive tells neither, `velocity_unit` and `acceleration_unit` say it. Nothing is taken for granted: a velocity
offset in the wrong unit moves metal.
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


class Of(StrEnum):
    """What a unit is a measure of."""

    COUNTS = "counts"
    """Units of 6064h."""
    TURNS = "revolutions"
    METRES = "metres"


@dataclass(frozen=True, slots=True)
class Unit:
    """`size` counts, revolutions or metres, per second or per second squared."""

    of: Of
    size: float
    name: str

    def per_metre(self, counts_per_metre: float, revolutions_per_metre: float | None) -> float | None:
        """How many of it one metre of the slider is; None where nobody said how many revolutions that takes."""
        whole = {Of.COUNTS: counts_per_metre, Of.TURNS: revolutions_per_metre, Of.METRES: 1.0}[self.of]
        return None if whole is None else whole / self.size

    def same(self, other: Unit) -> bool:
        """Whether it is the same unit, however it is called."""
        return self.of is other.of and math.isclose(self.size, other.size, rel_tol=1e-9)


# CiA 303-2, SI units and those in use beside them; B4h and B5h by CiA 402, ACh and C0h as makers have them.
_NUMERATORS: Final = {
    0x01: (Of.METRES, 1.0, "m"),
    0xC1: (Of.METRES, 0.0254, "in"),
    0x10: (Of.TURNS, 1.0 / math.tau, "rad"),
    0x40: (Of.TURNS, 1.0 / 400.0, "gon"),
    0x41: (Of.TURNS, 1.0 / 360.0, "deg"),
    0x42: (Of.TURNS, 1.0 / 360.0 / 60.0, "arcmin"),
    0x43: (Of.TURNS, 1.0 / 360.0 / 3600.0, "arcsec"),
    0xB4: (Of.TURNS, 1.0, "rev"),
    0xB5: (Of.COUNTS, 1.0, "counts"),
    0xAC: (Of.COUNTS, 1.0, "counts"),
}
_RPM: Final = 0xC0
"""Maxon's numerator of accelerations: revolutions a minute, for its 00C00300h is rpm/s."""
_TIMES: Final = {0x03: (1.0, "s"), 0x47: (60.0, "min"), 0x48: (3600.0, "h")}
_SECOND_SQUARED: Final = 0x57


def position_unit(code: int) -> Unit | None:
    """The unit of positions that 60A8h tells; None where it tells none that is known here."""
    return _decoded(code, 0)


def velocity_unit(code: int) -> Unit | None:
    """The unit of velocities that 60A9h tells; None where it tells none that is known here."""
    return _decoded(code, 1)


def acceleration_unit(code: int) -> Unit | None:
    """The unit of accelerations that 60AAh tells; None where it tells none that is known here.

    A denominator of seconds stands for seconds squared where the numerator is one of position.
    """
    return _decoded(code, 2)


def _decoded(code: int, power: int) -> Unit | None:
    prefix, numerator, denominator = code >> 24, code >> 16 & 0xFF, code >> 8 & 0xFF
    factor = 10.0 ** (prefix - 256 if prefix > 127 else prefix)
    if numerator == _RPM and power > 0:
        of, size, name = Of.TURNS, 1.0 / 60.0, "rpm"
        power -= 1
    elif numerator in _NUMERATORS:
        of, size, name = _NUMERATORS[numerator]
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
    return Unit(of, factor * size / seconds, f"{'' if factor == 1.0 else f'{factor:g} '}{name}{per}")


_WORDS: Final = {
    "counts": (Of.COUNTS, 1.0),
    "inc": (Of.COUNTS, 1.0),
    "rev": (Of.TURNS, 1.0),
    "rad": (Of.TURNS, 1.0 / math.tau),
    "deg": (Of.TURNS, 1.0 / 360.0),
    "m": (Of.METRES, 1.0),
    "mm": (Of.METRES, 1e-3),
    "um": (Of.METRES, 1e-6),
    "µm": (Of.METRES, 1e-6),
}
_WRITTEN: Final = re.compile(r"(?:(\d+(?:\.\d+)?(?:e-?\d+)?) +)?(rpm|[a-zµ]+/(?:s|min|h))((?:/(?:s|min|h))?|2)")
FACTORS: Final = 1e-9, 1e9
"""What may stand in front of a unit: far beyond what drives have, far from where numbers lose their digits."""
_SECONDS: Final = {symbol: seconds for seconds, symbol in _TIMES.values()}


def written(key: str, text: str, power: int) -> Unit:
    """The unit of velocities (power 1) or accelerations (2) that a configuration names; DriveError with the key."""
    match = _WRITTEN.fullmatch(text.strip())
    if match is not None:
        number, rate, per = match.groups()
        word, time = ("rev", "min") if rate == "rpm" else rate.split("/")
        times = _SECONDS[time] * (1.0 if not per else _SECONDS[time] if per == "2" else _SECONDS[per[1:]])
        if word in _WORDS and bool(per) == (power == 2) and not (rate == "rpm" and per == "2"):
            of, size = _WORDS[word]
            factor = float(number) if number else 1.0
            if FACTORS[0] <= factor <= FACTORS[1]:
                return Unit(of, factor * size / times, text.strip())
    kind, shown = (
        ("velocities", '"counts/s", "0.1 counts/s", "rpm", "rev/s", "deg/s", "rad/s", "mm/s", "m/min"')
        if power == 1
        else ("accelerations", '"counts/s2", "rpm/s", "rev/s2", "deg/s2", "rad/s2", "mm/s2"')
    )
    raise DriveError(f'{key} = "{text}" is no unit of {kind}; wanted one as {shown}')


def check(name: str, drive: Drive, key: Literal["velocity_unit", "acceleration_unit"]) -> None:
    """Refuse with DriveError what the configuration of the drive called `name` says of a unit and is none."""
    text: str | None = getattr(drive, key)
    if text is not None:
        written(f"drives.{name}.{key}", text, 1 if key == "velocity_unit" else 2)


@dataclass(frozen=True, slots=True)
class Units:
    """What one drive's quantities are of metres and seconds."""

    scale: Scale
    """Of positions."""
    velocity_per_metre: float
    """Velocity units that 1 m/s is: negative where counts fall as the slider position rises; nan if not known."""
    acceleration_per_metre: float
    """Acceleration units that 1 m/s² is, positive; nan if not known."""
    velocity_name: str = "counts/s"
    acceleration_name: str = "counts/s2"

    def velocity(self, velocity: float) -> int:
        """A slider velocity [m/s]; ValueError or OverflowError if it is not finite."""
        return round(self.velocity_per_metre * velocity)

    def check_velocity(self, name: str, fastest: float | None = None) -> None:
        """DriveError where nobody said what the unit of velocities is, which the velocity offset is in.

        Likewise where it cannot say the sliders' limit of velocity, `fastest` [m/s].
        """
        _known(name, "velocity", self.velocity_per_metre)
        if fastest is not None and (why := unfit(fastest, abs(self.velocity_per_metre))):
            raise DriveError(f"drive {name}: its unit of velocity (60A9, or 6096) is {self.velocity_name}: {why}")

    def length(self, name: str, key: str, value: float) -> int:
        """A length [m] of configuration key `key` as UNSIGNED32, as of a following error."""
        return _unsigned(name, key, value, abs(self.scale.counts_per_metre), "counts")

    def speed(self, name: str, key: str, value: float) -> int:
        """A speed [m/s] of configuration key `key` as UNSIGNED32."""
        _known(name, "velocity", self.velocity_per_metre)
        return _unsigned(name, key, value, abs(self.velocity_per_metre), self.velocity_name)

    def acceleration(self, name: str, key: str, value: float) -> int:
        """An acceleration [m/s²] of configuration key `key` as UNSIGNED32."""
        _known(name, "acceleration", self.acceleration_per_metre)
        return _unsigned(name, key, value, self.acceleration_per_metre, self.acceleration_name)


def unfit(fastest: float, per_metre: float) -> str:
    """Why a unit of velocities, of which 1 m/s is so many, cannot say the sliders' limit [m/s]; "" where it can."""
    limit = fastest * per_metre
    said = f"limits.slider.velocity = {fastest:g} is {limit:g} of it"
    if limit < 1.0:
        return f"{said}, and a drive takes whole ones; wanted a finer unit"
    if 2.0 * limit >= INT32_MAX:  # a velocity may be a little beyond its limit
        return f"{said}, and twice that must be below {INT32_MAX}; wanted a coarser unit"
    return ""


def _known(name: str, quantity: str, per_metre: float) -> None:
    if math.isnan(per_metre):
        index, example = ("60A9", "counts/s") if quantity == "velocity" else ("60AA", "counts/s2")
        raise DriveError(
            f"drive {name}: does not tell its unit of {quantity} (object {index}); its manual does: say "
            f'drives.{name}.{quantity}_unit, as "{example}"'
        )


def _unsigned(name: str, key: str, value: float, per_si: float, unit: str) -> int:
    """0 and FFFFFFFFh are refused: to a drive the first is no window and no ramp, the second no supervision at all."""
    exact = per_si * value
    if not 0.5 < exact < UINT32_MAX - 0.5:
        raise DriveError(f"drive {name}: {key} {value:g} is {exact:g} {unit}, and a drive takes 1 to {UINT32_MAX - 1}")
    return round(exact)
