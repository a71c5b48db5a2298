"""Units of a drive's objects, as its own dictionary defines them (CiA 402-2, factor group), in counts and seconds.

A count is the drive's unit of position at power-on. The objects 60A8h, 60A9h and 60AAh define the units as in CiA 303-2
(power of ten, numerator, denominator). If they do not, the unit of velocity is one position unit per second divided by
6096h, and the unit of acceleration is one velocity unit per second divided by 6097h. The unit of position depends on
608Fh, 6091h and 6092h. The manufacturer defines any unit that no object defines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trirail_drivers.simulated.dictionary import Dictionary, ObjectEntry

_METRES: Final = {0x01: 1.0, 0xC1: 0.0254, 0xC2: 0.3048}
_PER_REVOLUTION: Final = {0x10: math.tau, 0x40: 400.0, 0x41: 360.0, 0x42: 21_600.0, 0x43: 1_296_000.0, 0xB4: 1.0}
_COUNTS: Final = (0xB5, 0xAC)
_RPM: Final = 0xC0
"""Numerator for revolutions per minute, which the EPOS4 uses for accelerations: 00C00300h is rpm/s."""
_SECONDS: Final = {0x03: 1.0, 0x47: 60.0, 0x48: 3600.0}
_SECOND_SQUARED: Final = 0x57


@dataclass(frozen=True, slots=True)
class Mechanics:
    """Properties of a drive that no object reports: its axis, and the units that the manufacturer has defined."""

    counts_per_metre: float = math.nan
    counts_per_revolution: float = math.nan
    """Encoder counts per revolution of the motor."""
    velocity: float = 1.0
    """Fixed unit of velocity [counts/s]."""
    acceleration: float = 1.0
    """Fixed unit of acceleration [counts/s²]."""
    untold: tuple[int, ...] = ()
    """Those of the objects 60A9h and 60AAh that are 0, whatever the EDS contains, so that the units above apply."""


class FactorGroup:
    """Present units of the drive, as its objects define them."""

    def __init__(self, objects: Dictionary, mechanics: Mechanics) -> None:
        self.position = 1.0
        """Unit of 607Ah, 6064h and other positions [counts]."""
        self.velocity = 1.0
        """Unit of 60B1h, 606Ch, 6099h [counts/s]."""
        self.acceleration = 1.0
        """Unit of 6084h, 6085h, 609Ah [counts/s²]."""
        self._mechanics = mechanics
        self._codes = [objects.internal(index, 0) for index in (0x60A8, 0x60A9, 0x60AA)]
        for index in mechanics.untold:
            entry = objects.internal(index, 0)
            entry.value = entry.default = 0
        ratios = [(objects.internal(index, 1), objects.internal(index, 2)) for index in _RATIOS]
        self._ratios = dict(zip(_RATIOS, ratios, strict=True))
        self._at_power_on = self._counts_per_unit()
        self._code_at_power_on = self._codes[0].default
        for index in (0x60A8, 0x60A9, 0x60AA, *_RATIOS):
            objects.on_write(index, self._written)
        self.refresh()

    def refresh(self) -> None:
        """Update the units from the objects."""
        self.position = self._position()
        _, velocity, acceleration = (entry.value for entry in self._codes)
        by_factor, of_factor = self._ratio(0x6096), self._ratio(0x6097)
        unit = self._unit(velocity, 1) or (self.position / by_factor if by_factor else None)
        self.velocity = unit or self._mechanics.velocity
        unit = self._unit(acceleration, 2) or (self.velocity / of_factor if of_factor else None)
        self.acceleration = unit or self._mechanics.acceleration

    def _written(self, _entry: ObjectEntry, _old: int) -> None:
        self.refresh()

    def _position(self) -> float:
        code = self._codes[0].value
        if code != self._code_at_power_on and (size := self._unit(code, 0)):
            return size
        return self._counts_per_unit() / self._at_power_on

    def _counts_per_unit(self) -> float:
        """Return encoder increments per unit of position: encoder resolution * gear ratio / feed constant."""
        resolution, gear, feed = (self._ratio(index) or 1.0 for index in (0x608F, 0x6091, 0x6092))
        return resolution * gear / feed

    def _ratio(self, index: int) -> float | None:
        """Return sub-index 1 divided by sub-index 2; None if the drive lacks these objects or has not set them."""
        numerator, divisor = (entry.value for entry in self._ratios[index])
        return numerator / divisor if numerator > 0 and divisor > 0 else None

    def _unit(self, code: int, power: int) -> float | None:
        """Return the size of a unit coded as in CiA 303-2 [counts/s^power]; None if the code is unknown."""
        size = self._decoded(code, power)
        return size if size is not None and math.isfinite(size) else None

    def _decoded(self, code: int, power: int) -> float | None:
        prefix, numerator, denominator = code >> 24 & 0xFF, code >> 16 & 0xFF, code >> 8 & 0xFF
        factor = 10.0 ** (prefix - 256 if prefix > 127 else prefix)
        if numerator == _RPM and power:
            rpm = factor * self._mechanics.counts_per_revolution / 60.0
            return rpm if power == 1 else rpm / _SECONDS.get(denominator, math.nan)
        if numerator in _METRES:
            size = _METRES[numerator] * self._mechanics.counts_per_metre
        elif numerator in _PER_REVOLUTION:
            size = self._mechanics.counts_per_revolution / _PER_REVOLUTION[numerator]
        elif numerator in _COUNTS:
            size = 1.0
        else:
            return None
        if power == 0 or (power == 2 and denominator == _SECOND_SQUARED):
            return factor * size
        return factor * size / _SECONDS[denominator] ** power if denominator in _SECONDS else None


_RATIOS: Final = (0x608F, 0x6091, 0x6092, 0x6096, 0x6097)
"""Encoder resolution, gear ratio, feed constant, velocity and acceleration factor: sub-index 1 divided by sub-index 2.
"""
