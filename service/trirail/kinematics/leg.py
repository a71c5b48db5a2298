"""Interface of a leg, which the mechanisms prp3 and ppr3 implement.

A leg has a driven slider on a rail of the base, a cross slide without a drive, and a pivot. The mechanisms differ in
the order of cross slide and pivot. Lengths are in metres, angles in radians; a pose is x, y [m] and phi [rad].
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
PARALLEL = 1e-9  # a leg is singular if |sin| of the angle between its cross slide and its rail is below this value
THETA_1 = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # (3)


class CrossSlide(NamedTuple):
    """Position and direction of a leg's cross slide, for drawings."""

    point: tuple[float, float]
    """Edge point of a cross slide on the platform, or pivot of a leg with the cross slide on the carriage, in the
    platform's frame [m]."""
    angle: float
    """Direction of the cross slide, in the platform's frame or, if it does not turn, in the base frame [rad]."""
    turns: bool
    """Whether the cross slide is fixed to the platform and turns with it. Otherwise, it is fixed to the carriage."""


class AnyLeg(Protocol):
    """Leg of any mechanism. `anchor`, `rail_angle` and `home` describe the rail."""

    KIND: ClassVar[str]
    """Name of the mechanism, as in the key kind of [geometry]."""
    PARAMETERS: ClassVar[tuple[str, ...]]
    """Names of the five parameters that calibration determines [m, rad]."""
    DOUBT: ClassVar[tuple[float, ...]]
    """Standard deviation of each parameter above which calibration is less accurate than drawings [m, rad]."""
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
        """Distance along the rail from the anchor to the point at which the slider reads zero [m]."""
        ...

    @property
    def cross_angle(self) -> float:
        """Direction of the cross slide in the base frame at phi = 0 [rad]."""
        ...

    @property
    def parallel_angle(self) -> float | None:
        """Angle phi at which cross slide and rail are parallel, modulo pi [rad]; None if they are never parallel."""
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
        """Return the numbers of the leg [m, rad] under their keys in [[geometry.leg]]."""
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
        """Return the diagonal element of J1 and the row (3,) of J2, (16), of this leg, up to a common sign."""
        ...

    def lever(self, centre: tuple[float, float], phi: Array) -> Array:
        """Return the last element of the row of J2 that belongs to this leg [m], for G at `centre` and angles `phi`."""
        ...

    def corrected(self, corrections: Sequence[float]) -> Any:
        """Return a copy of the leg with corrections added to its PARAMETERS."""
        ...

    def parameter_derivatives(self, first: Any, phi: Array, slider: Array, passive: Array) -> Array:
        """Return the derivatives of F with respect to corrections of `first`, (N, 5).

        F = 0 is the loop equation of the leg. The derivatives of F are J1 with respect to the slider, and -J2 with
        respect to the pose.
        """
        ...


def check_finite(leg: Any, name: str) -> None:
    """Raise KinematicsError if a number of a leg is not finite. The leg must be a dataclass."""
    for key, value in zip(leg.__slots__, astuple(leg), strict=True):
        if not np.all(np.isfinite(value)):
            raise KinematicsError(f"leg {name}: {key} is {value}: it must be finite", leg=name)


def theta(angle: float) -> Array:
    """Return theta_alpha of (3), the matrix of a rotation by an angle [rad] about the z axis."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def wrapped(angle: float) -> float:
    """Return an angle reduced to the range (-pi, pi]."""
    within = math.remainder(angle, 2.0 * math.pi)
    return within if within > -math.pi else math.pi


def across(point: tuple[float, float], angle: float, distance: float) -> tuple[float, float]:
    """Return `point`, moved to the left by a distance [m], as seen in the direction of the given angle [rad]."""
    return point[0] - distance * math.sin(angle), point[1] + distance * math.cos(angle)
