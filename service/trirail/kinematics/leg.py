"""Interface of a leg of any mechanism. prp3 and ppr3 implement it with their own symbols.

A leg has a driven slider on a rail of the base, a cross slide that is not driven, and a pivot. The mechanisms differ in
the order of the last two. Lengths are in metres, angles in radians; a pose is x, y [m] and phi [rad].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array

__all__ = ["LEGS", "PARALLEL", "THETA_1", "AnyLeg", "CrossSlide", "across", "check_finite", "theta", "wrapped"]

LEGS = ("A", "B", "C")
PARALLEL = 1e-9  # |sin| of the angle between a cross slide and its rail below which the leg is singular
THETA_1 = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # (3)


class CrossSlide(NamedTuple):
    """Position and direction of a leg's cross slide, for drawings."""

    point: tuple[float, float]
    """Point from which the travel of the cross slide is counted, in the frame of the platform or of the carriage."""
    angle: float
    """Direction of the cross slide, in the frame of the part to which it is fixed."""
    turns: bool
    """Whether the cross slide is fixed to the platform and turns with it. Otherwise, it is fixed to the carriage."""


class AnyLeg(Protocol):
    """Leg of any mechanism. `anchor`, `rail_angle` and `home` describe the rail."""

    KIND: ClassVar[str]
    """Mechanism as named by [geometry] kind."""
    PARAMETERS: ClassVar[tuple[str, ...]]
    """Names of the five parameters that calibration determines [m, rad]."""
    DOUBT: ClassVar[tuple[float, ...]]
    """Standard deviation of each parameter above which drawings are more accurate [m, rad]."""
    CROSS: ClassVar[str]
    """Name of the cross slide's guide, for messages."""

    @property
    def anchor(self) -> tuple[float, float]:
        """Point of the rail in the base frame [m]."""
        ...

    @property
    def rail_angle(self) -> float:
        """Direction of the rail in the base frame [rad]."""
        ...

    @property
    def home(self) -> float:
        """Distance from the anchor to the slider's zero, along the rail [m]."""
        ...

    @property
    def cross_angle(self) -> float:
        """Direction of the cross slide in the base frame at phi = 0 [rad]."""
        ...

    @property
    def parallel_angle(self) -> float | None:
        """Angle phi at which cross slide and rail are parallel, as they are every pi; None if they never are [rad]."""
        ...

    @property
    def arm(self) -> float:
        """Distance from G to the leg [m]."""
        ...

    @property
    def crossing(self) -> CrossSlide:
        """Position and direction of the cross slide, for drawings."""
        ...

    def keys(self) -> dict[str, Any]:
        """Return the numbers of the leg, by their keys in [[geometry.leg]] [m, rad]."""
        ...

    def check(self, name: str) -> None:
        """Raise KinematicsError if a number is not finite, or the leg is singular at the pose (0, 0, 0)."""
        ...

    def packed(self) -> Array:
        """Return the leg as joints for trirail.kinematics.recursion, with shape (4, 13)."""
        ...

    def travels(self, x: Array, y: Array, phi: Array) -> tuple[Array, Array]:
        """Return the positions of slider and cross slide at poses, as arrays of one shape [m]."""
        ...

    def row(self, pose: tuple[float, float, float]) -> tuple[float, Array]:
        """Return the leg's diagonal element of J1 and its row (3,) of J2, (16), up to a common sign."""
        ...

    def lever(self, centre: tuple[float, float], phi: Array) -> Array:
        """Return the last element of the leg's row of J2 [m], for G at `centre` and any angles."""
        ...

    def corrected(self, corrections: Sequence[float]) -> Any:
        """Return the leg with corrections to its PARAMETERS."""
        ...

    def parameter_derivatives(self, first: Any, phi: Array, slider: Array, passive: Array) -> Array:
        """Return the derivatives of F by corrections to `first`: (N, 5). F has the derivatives J1 and -J2."""
        ...


def check_finite(leg: Any, name: str) -> None:
    """Raise KinematicsError if a number of a leg, which is a dataclass, is not finite."""
    for key, value in zip(leg.__slots__, astuple(leg), strict=True):
        if not np.all(np.isfinite(value)):
            raise KinematicsError(f"leg {name}: {key} is {value}: it must be finite", leg=name)


def theta(angle: float) -> Array:
    """Return theta_alpha of (3)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def wrapped(angle: float) -> float:
    """Return an angle, reduced to the range (-pi, pi]."""
    within = math.remainder(angle, 2.0 * math.pi)
    return within if within > -math.pi else math.pi


def across(point: tuple[float, float], angle: float, distance: float) -> tuple[float, float]:
    """Return the point at a distance to the left of a line through `point` with the given angle."""
    return point[0] - distance * math.sin(angle), point[1] + distance * math.cos(angle)
