"""What may never be exceeded: bounds for paths before they start and for every setpoint before it is sent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from service.config import Limits
from service.paths import ROUNDING

LEGS = ("A", "B", "C")
COORDINATES = ("x", "y", "phi")

EDGE = 1e-6
"""By so much may a setpoint be beyond a limit of position that its path was checked against [m, rad]."""
EXCESS = 1e-3
"""By that share may a setpoint exceed a limit of velocity or acceleration that its path was checked against."""


class Violation(NamedTuple):
    """A bound that is exceeded."""

    what: str
    """The slider (A, B, C) or the platform's coordinate (x, y, phi)."""
    quantity: str
    value: float
    limit: float
    unit: str

    def __str__(self) -> str:
        subject = f"slider {self.what}" if self.what in LEGS else f"platform {self.what}"
        return beyond(f"{subject}: {self.quantity}", self.value, self.limit, self.unit)


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
        self._pose = tuple(zip(COORDINATES, ("m", "m", "rad"), (platform.x, platform.y, platform.phi), strict=True))
        self._edge = edge
        self._step = velocity * (1.0 + EXCESS) * period

    def pose(self, pose: Sequence[float]) -> Violation | None:
        """Check a pose x, y [m], phi [rad] alone."""
        edge = self._edge
        for value, (name, unit, (low, high)) in zip(pose, self._pose, strict=True):
            if not low - edge <= value <= high + edge:
                return Violation(name, "position", value, low if value < low else high, unit)
        return None

    def setpoint(self, rows: Sequence[Sequence[float]], before: Sequence[float]) -> Violation | None:
        """Check solved sliders: rows lambda_10, v_10, gamma_10, lambda_32 [m, s], and the step from `before` [m].

        A value that is not a number is beyond every limit.
        """
        for values, (quantity, unit, low, high, slack) in zip(rows, self._rows, strict=False):
            for leg, value in zip(LEGS, values, strict=True):
                if not low - slack <= value <= high + slack:
                    return Violation(leg, quantity, value, low if value < low else high, unit)
        for leg, value, last in zip(LEGS, rows[0], before, strict=True):
            if not abs(value - last) <= self._step:
                return Violation(leg, "step in one cycle", value - last, self._step, "m")
        return None
