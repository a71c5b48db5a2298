"""Braking ramp."""

from __future__ import annotations

import math


def brake(position: float, velocity: float, deceleration: float, step: float) -> tuple[float, float]:
    """Return position and velocity after braking for `step` seconds with `deceleration`, or until standstill."""
    moving = min(step, abs(velocity) / deceleration)
    lost = math.copysign(deceleration * moving, velocity)
    position += (velocity - 0.5 * lost) * moving
    return position, velocity - lost if moving == step else 0.0
