"""Part of the sliders' limits that is reserved for backlash compensation.

When a slider reverses, its motor must also cross the backlash. This extra motion, the take-up, is a quintic from rest
to rest. The duration of the take-up depends only on the widest backlash.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from trirail.config import Limits, SliderLimits

SHARE = 0.1
"""Fraction of the sliders' velocity, acceleration and jerk limits that is reserved for the take-up."""
PEAKS = (15.0 / 8.0, 10.0 / math.sqrt(3.0), 60.0)
"""Peak velocity, acceleration and jerk of a quintic that covers unit distance in unit time."""


class TakeUp(NamedTuple):
    """Motion with which the motors cross the backlash after a reversal."""

    widths: Sequence[float]
    """Backlash of the sliders A, B, C [m]."""
    duration: float
    """Duration of the take-up [s]; zero if no slider has backlash."""
    velocity: float
    """Peak velocity of the take-up for the widest backlash [m/s]."""
    acceleration: float
    """Peak acceleration of the take-up for the widest backlash [m/s²]."""
    jerk: float
    """Peak jerk of the take-up for the widest backlash [m/s³]."""


NO_BACKLASH = TakeUp((0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0)


def reserve_for_backlash(widths: Sequence[float], slider: SliderLimits) -> TakeUp:
    """Return the fastest take-up for backlash of the given widths [m] within the reserved part of the limits."""
    widest = max(widths)
    limits = min(slider.velocities), min(slider.accelerations), min(slider.jerks)
    powers = (1, 2, 3)
    duration = max(
        (peak * widest / (SHARE * limit)) ** (1.0 / power)
        for peak, limit, power in zip(PEAKS, limits, powers, strict=True)
    )
    if duration == 0.0:
        return NO_BACKLASH
    v, a, j = (peak * widest / duration**power for peak, power in zip(PEAKS, powers, strict=True))
    return TakeUp(widths, duration, v, a, j)


def planned_limits(limits: Limits, widths: Sequence[float]) -> Limits:
    """Return the limits for planning, which are the robot's limits minus the part reserved for backlash.

    The in-position windows of the sliders are enlarged by the backlash, because the position of a slider is uncertain
    by this amount.
    """
    if not any(widths):
        return limits
    slider, take_up, half = limits.slider, reserve_for_backlash(widths, limits.slider), max(widths) / 2.0
    less = msgspec.structs.replace(
        slider,
        position=tuple((low + half, high - half) for low, high in slider.positions),
        velocity=tuple(each - take_up.velocity for each in slider.velocities),
        acceleration=tuple(each - take_up.acceleration for each in slider.accelerations),
        jerk=tuple(each - take_up.jerk for each in slider.jerks),
    )
    windows = limits.in_position
    wider = tuple(window + width for window, width in zip(windows.sliders, widths, strict=True))
    return msgspec.structs.replace(limits, slider=less, in_position=msgspec.structs.replace(windows, sliders=wider))
