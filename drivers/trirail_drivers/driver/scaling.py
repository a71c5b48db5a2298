"""Conversion between metres and drive counts."""

from __future__ import annotations

from dataclasses import dataclass

from trirail_drivers.config import Drive
from trirail_drivers.errors import DriveError

FLOAT32_MAX = (2.0 - 2.0**-23) * 2.0**127
"""Largest finite 32-bit float."""
INT32_MAX = 2**31 - 1
UINT32_MAX = 2**32 - 1


@dataclass(frozen=True, slots=True)
class Scale:
    """Position scale of one drive: `counts = counts_per_metre * (position - offset)`."""

    counts_per_metre: float
    """Resolution of the encoder; negative if the counts decrease as the slider position increases."""
    offset: float
    """Slider position at zero counts [m]."""

    def counts(self, position: float) -> int:
        """Convert a slider position [m] to counts. Raises ValueError or OverflowError if it is not finite."""
        return round(self.exact(position))

    def exact(self, position: float) -> float:
        """Convert a slider position [m] to counts without rounding (turns of an ODrive)."""
        return self.counts_per_metre * (position - self.offset)

    def metres(self, counts: float) -> float:
        """Convert a drive position to a slider position [m]."""
        return counts / self.counts_per_metre + self.offset


def scale_of(name: str, drive: Drive) -> Scale:
    """Return the scale of a drive. Raises DriveError if slider position 0 does not fit into a 32-bit drive position."""
    scale = Scale(drive.direction * drive.counts_per_metre, drive.offset)
    try:
        zero = scale.counts(0.0)
    except (ValueError, OverflowError):
        zero = INT32_MAX + 1
    if abs(zero) > INT32_MAX:
        raise DriveError(
            f"drive {name}: counts_per_metre {drive.counts_per_metre:g} and offset {drive.offset:g} m put "
            f"slider position 0 outside the range of 32-bit counts; set a smaller offset or fewer counts"
        )
    return scale
