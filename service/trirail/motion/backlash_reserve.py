"""How a slider's backlash is taken up: a setpoint's share of its own, within what the limits keep for it.

Where a slider turns back, its motor goes the way of the backlash as well, by the quintic from rest to rest, in a time
that depends on the widest backlash alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from trirail.config import Limits, SliderLimits

SHARE = 0.1
"""Of the sliders' limits of velocity, acceleration and jerk, that taking up backlash may make use of."""
PEAKS = (15.0 / 8.0, 10.0 / math.sqrt(3.0), 60.0)
"""Greatest derivatives of the quintic over one way in one unit of time: velocity, acceleration, jerk."""


class TakeUp(NamedTuple):
    """What the sliders' backlash takes."""

    widths: Sequence[float]
    """Of the sliders A, B, C [m]."""
    duration: float
    """Of taking it up [s]; zero where there is none."""
    velocity: float
    """The greatest, of any slider [m/s]."""
    acceleration: float
    """[m/s²]."""
    jerk: float
    """[m/s³]."""


NO_BACKLASH = TakeUp((0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0)


def reserve_for_backlash(widths: Sequence[float], slider: SliderLimits) -> TakeUp:
    """Return how backlash of such widths [m] is taken up as fast as its share of the limits allows."""
    most = max(widths)
    limits = min(slider.velocities), min(slider.accelerations), min(slider.jerks)
    powers = (1, 2, 3)
    duration = max(
        (peak * most / (SHARE * limit)) ** (1.0 / power)
        for peak, limit, power in zip(PEAKS, limits, powers, strict=True)
    )
    if duration == 0.0:
        return NO_BACKLASH
    v, a, j = (peak * most / duration**power for peak, power in zip(PEAKS, powers, strict=True))
    return TakeUp(widths, duration, v, a, j)


def planned_limits(limits: Limits, widths: Sequence[float]) -> Limits:
    """Return the limits with what taking up backlash may add left out: those for which motions are planned."""
    if not any(widths):
        return limits
    slider, taken, half = limits.slider, reserve_for_backlash(widths, limits.slider), max(widths) / 2.0
    less = msgspec.structs.replace(
        slider,
        position=tuple((low + half, high - half) for low, high in slider.positions),
        velocity=tuple(each - taken.velocity for each in slider.velocities),
        acceleration=tuple(each - taken.acceleration for each in slider.accelerations),
        jerk=tuple(each - taken.jerk for each in slider.jerks),
    )
    return msgspec.structs.replace(limits, slider=less)
