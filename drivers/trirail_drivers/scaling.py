"""Metres on this side, drive counts on the other."""

from __future__ import annotations

from dataclasses import dataclass

from trirail_drivers.config import Drive
from trirail_drivers.errors import DriveError

INT32_MAX = 2**31 - 1
UINT32_MAX = 2**32 - 1


@dataclass(frozen=True, slots=True)
class Scale:
    """One drive's scale: `counts = counts_per_metre * (position - offset)`.

    Velocities and accelerations take the same factor: a drive's units are counts, counts/s, counts/s².
    """

    counts_per_metre: float
    """Negative where counts fall as the slider position rises."""
    offset: float
    """Slider position at zero counts [m]."""

    def counts(self, position: float) -> int:
        """Slider position [m] in counts; ValueError or OverflowError if it is not finite."""
        return round(self.exact(position))

    def exact(self, position: float) -> float:
        """Slider position [m] in counts that need not be whole: turns."""
        return self.counts_per_metre * (position - self.offset)

    def counts_per_second(self, velocity: float) -> int:
        """Slider velocity [m/s] in counts/s; ValueError or OverflowError if it is not finite."""
        return round(self.counts_per_metre * velocity)

    def metres(self, counts: float) -> float:
        """Slider position [m] of a drive position."""
        return counts / self.counts_per_metre + self.offset


def scale_of(name: str, drive: Drive) -> Scale:
    """Scale of the drive called `name`; DriveError if slider position 0 is beyond a 32-bit drive position."""
    scale = Scale(drive.direction * drive.counts_per_metre, drive.offset)
    try:
        zero = scale.counts(0.0)
    except (ValueError, OverflowError):
        zero = INT32_MAX + 1
    if abs(zero) > INT32_MAX:
        raise DriveError(
            f"drive {name}: counts_per_metre {drive.counts_per_metre:g} and offset {drive.offset:g} m put "
            f"slider position 0 beyond a drive's 32-bit counts; set a smaller offset or fewer counts"
        )
    return scale


def unsigned(name: str, scale: Scale, key: str, value: float) -> int:
    """`value` [m or m/s²] of configuration key `key` as a drive's UNSIGNED32 in counts.

    0 and FFFFFFFFh are refused: to a drive the first is no window and no ramp, the second no supervision at
    all (CiA 402-2, object 6065h).
    """
    counts = abs(scale.counts_per_metre) * value
    if not 0.5 < counts < UINT32_MAX - 0.5:
        raise DriveError(f"drive {name}: {key} {value:g} is {counts:g} counts, and a drive takes 1 to {UINT32_MAX - 1}")
    return round(counts)
