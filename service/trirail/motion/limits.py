"""What may never be exceeded: bounds for paths before they start and for every setpoint before it is sent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from trirail.config import Limits
from trirail.kinematics.geometry import LEGS
from trirail.motion.paths import ROUNDING

COORDINATES = ("x", "y", "phi")
UNITS = ("m", "m", "rad")

EDGE = 1e-6
"""By so much may a setpoint be beyond a limit of position that its path was checked against [m, rad]."""
EXCESS = 1e-3
"""By that share may a setpoint exceed a limit of velocity, acceleration or jerk that its path was checked against."""
PLATFORM_EXCESS = (0.01, 0.05, 0.1)
"""Likewise the platform's velocity, acceleration and jerk: plans make use of all of it (checks.PLATFORM_LAWS)."""


Rows = Sequence[Sequence[float]]


class Violation(NamedTuple):
    """A bound that is exceeded."""

    what: str
    """The slider (A, B, C) or the platform's coordinate (x, y, phi)."""
    quantity: str
    value: float
    limit: float
    unit: str

    def __str__(self) -> str:
        return beyond(f"{self.subject}: {self.quantity}", self.value, self.limit, self.unit)

    @property
    def subject(self) -> str:
        """What is beyond its bound, in words."""
        return f"slider {self.what}" if self.what in LEGS else f"platform {self.what}"

    @property
    def bound(self) -> str:
        """The bound alone, in words."""
        return f"{self.subject} ({self.quantity} {self.limit:.6g} {self.unit})"


def beyond(what: str, value: float, limit: float, unit: str) -> str:
    """Say that a value is beyond its limit, with as many digits as it takes to tell the two apart."""
    shown, bound = told_apart(value, limit)
    return f"{what} {shown} {unit} is beyond its limit {bound} {unit}"


def told_apart(value: float, other: float) -> tuple[str, str]:
    """Return two numbers with six significant digits, or as many more as it takes to tell them apart."""
    for digits in range(6, 18):
        shown = f"{value:.{digits}g}", f"{other:.{digits}g}"
        if shown[0] != shown[1]:
            break
    return shown


class Bounds:
    """The limits of a robot, as bounds on the rows of a solved motion and on the pose.

    `edge` [m, rad] is by how much a position may be beyond its limit.
    """

    def __init__(self, limits: Limits, period: float, edge: float = ROUNDING) -> None:
        slider, platform = limits.slider, limits.platform
        velocity, acceleration = slider.velocity, slider.acceleration
        self._rows = (
            ("position", "m", *slider.position, edge),
            ("velocity", "m/s", -velocity, velocity, velocity * EXCESS),
            ("acceleration", "m/s²", -acceleration, acceleration, acceleration * EXCESS),
            ("passive position", "m", *slider.passive, edge),
        )
        self._pose = tuple(zip(COORDINATES, UNITS, (platform.x, platform.y, platform.phi), strict=True))
        self._edge = edge
        self._step = velocity * (1.0 + EXCESS) * period
        self._period = period
        self._slider_jerk = slider.jerk
        self._platform = tuple(zip(platform.velocity, platform.acceleration, platform.jerk, strict=True))

    def pose(self, pose: Sequence[float]) -> Violation | None:
        """Check a pose x, y [m], phi [rad] alone."""
        edge = self._edge
        for value, (name, unit, (low, high)) in zip(pose, self._pose, strict=True):
            if not low - edge <= value <= high + edge:
                return Violation(name, "position", value, low if value < low else high, unit)
        return None

    def setpoint(self, rows: Rows) -> Violation | None:
        """Check solved sliders: rows lambda_10, v_10, gamma_10, lambda_32 [m, s].

        A value that is not a number is beyond every limit.
        """
        for values, (quantity, unit, low, high, slack) in zip(rows, self._rows, strict=False):
            for leg, value in zip(LEGS, values, strict=True):
                if not low - slack <= value <= high + slack:
                    return Violation(leg, quantity, value, low if value < low else high, unit)
        return None

    def step(self, rows: Rows, before: Rows) -> Violation | None:
        """Check solved sliders against those of the cycle before: how far they go, and with which jerk."""
        for leg, value, last in zip(LEGS, rows[0], before[0], strict=True):
            if not abs(value - last) <= self._step:
                return Violation(leg, "step in one cycle", value - last, self._step, "m")
        limit = self._slider_jerk
        for n, leg in enumerate(LEGS):
            jerk = self._jerk(rows, before, n)
            if not jerk <= limit * (1.0 + EXCESS):
                return Violation(leg, "jerk", jerk, limit, "m/s³")
        return None

    def platform(self, motion: Rows, before: Rows) -> Violation | None:
        """Check the platform's velocity and acceleration, and the jerk since the cycle before."""
        more = PLATFORM_EXCESS
        for n, (velocity, acceleration, most) in enumerate(self._platform):
            name, unit = COORDINATES[n], UNITS[n]
            if not abs(motion[1][n]) <= velocity * (1.0 + more[0]):
                return Violation(name, "velocity", motion[1][n], math.copysign(velocity, motion[1][n]), f"{unit}/s")
            if not abs(motion[2][n]) <= acceleration * (1.0 + more[1]):
                bound = math.copysign(acceleration, motion[2][n])
                return Violation(name, "acceleration", motion[2][n], bound, f"{unit}/s²")
            jerk = self._jerk(motion, before, n)
            if not jerk <= most * (1.0 + more[2]):
                return Violation(name, "jerk", jerk, most, f"{unit}/s³")
        return None

    def _jerk(self, now: Rows, before: Rows, n: int) -> float:
        """Return the least jerk that explains rows (position, velocity, acceleration) one cycle after others.

        A jerk j that may change at any moment, an acceleration that may begin or end anywhere in the cycle as large
        as j makes it in a cycle T: between the two the acceleration changes by j T at most, the velocity differs by
        j T² / 2 from what the mean acceleration gives, and the position by j T³ / 4 from what the mean velocity does.
        """
        period, half = self._period, self._period / 2.0
        (p, v, a), (p0, v0, a0) = (now[0][n], now[1][n], now[2][n]), (before[0][n], before[1][n], before[2][n])
        return max(
            abs(a - a0) / period,
            abs(v - v0 - half * (a + a0)) / (half * period),
            4.0 * (abs(p - p0 - half * (v + v0)) - ROUNDING) / period**3,
        )
