"""What may never be exceeded: bounds for paths before they start and for every setpoint before it is sent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.config import Limits

LEGS = ("A", "B", "C")
COORDINATES = ("x", "y", "phi")

ROUNDING = 1.001
"""By so much may a setpoint exceed a limit of velocity or acceleration that its plan was checked against."""


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
        return (
            f"{subject}: {self.quantity} {self.value:.6g} {self.unit} is beyond its limit {self.limit:.6g} {self.unit}"
        )


class Bounds:
    """The limits of a robot, as bounds on the rows of a solved motion and on the pose."""

    def __init__(self, limits: Limits, period: float) -> None:
        slider, platform = limits.slider, limits.platform
        self.velocity, self.acceleration = slider.velocity, slider.acceleration
        self._rows = (
            ("position", "m", *slider.position),
            ("velocity", "m/s", -slider.velocity * ROUNDING, slider.velocity * ROUNDING),
            ("acceleration", "m/s²", -slider.acceleration * ROUNDING, slider.acceleration * ROUNDING),
            ("passive position", "m", *slider.passive),
        )
        self._pose = tuple(zip(COORDINATES, ("m", "m", "rad"), (platform.x, platform.y, platform.phi), strict=True))
        self._step = slider.velocity * ROUNDING * period
        self._low = np.array([platform.x[0], platform.y[0], platform.phi[0]])
        self._high = np.array([platform.x[1], platform.y[1], platform.phi[1]])
        self._position = np.array(slider.position)
        self._passive = np.array(slider.passive)

    def pose(self, pose: Sequence[float]) -> Violation | None:
        """Check a pose x, y [m], phi [rad] alone."""
        for value, (name, unit, (low, high)) in zip(pose, self._pose, strict=True):
            if not low <= value <= high:
                return Violation(name, "position", value, low if value < low else high, unit)
        return None

    def setpoint(self, rows: Sequence[Sequence[float]], before: Sequence[float]) -> Violation | None:
        """Check solved sliders: rows lambda_10, v_10, gamma_10, lambda_32 [m, s], and the step from `before` [m].

        A value that is not a number is beyond every limit.
        """
        for values, (quantity, unit, low, high) in zip(rows, self._rows, strict=False):
            for leg, value in zip(LEGS, values, strict=True):
                if not low <= value <= high:
                    return Violation(leg, quantity, value, low if value < low else high, unit)
        for leg, value, last in zip(LEGS, rows[0], before, strict=True):
            if not abs(value - last) <= self._step:
                return Violation(leg, "step in one cycle", value - last, self._step, "m")
        return None

    def path(
        self, pose: NDArray[np.float64], position: NDArray[np.float64], passive: NDArray[np.float64]
    ) -> tuple[int, Violation] | None:
        """Check samples along a path, each (N, 3); return the first row out of reach and why."""
        reached = (pose >= self._low) & (pose <= self._high)
        reached &= (position >= self._position[0]) & (position <= self._position[1])
        reached &= (passive >= self._passive[0]) & (passive <= self._passive[1])
        rows = reached.all(axis=1)
        if rows.all():
            return None
        row = int(np.argmin(rows))
        still = position[row].tolist(), (0.0,) * 3, (0.0,) * 3, passive[row].tolist()
        violation = self.pose(pose[row].tolist()) or self.setpoint(still, still[0])
        return (row, violation) if violation else None
