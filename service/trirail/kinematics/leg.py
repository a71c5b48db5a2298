"""Interface of a leg, whatever its mechanism; prp3 and ppr3 keep their own symbols behind it.

A leg has a driven slider on a rail of the base, a cross slide that is not driven, and a pivot. Mechanisms differ in the
order of the last two. Lengths are in metres, angles in radians, a pose is x, y [m] and phi [rad].
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
PARALLEL = 1e-9  # |sin| of the angle between a cross slide and its rail up to which the leg counts as singular
THETA_1 = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # (3)


class CrossSlide(NamedTuple):
    """Position and direction of a leg's cross slide, for drawings."""

    point: tuple[float, float]
    """The point that the cross slide's travel is counted from: on the platform, in its frame, or on the carriage."""
    angle: float
    """Its direction, in the frame of the part that it is fixed to."""
    turns: bool
    """Whether it is fixed to the platform, and turns with it; else it is fixed to the carriage."""


class AnyLeg(Protocol):
    """One leg of a mechanism; anchor, rail_angle and home are the rail's, whatever rides on it."""

    KIND: ClassVar[str]
    """The mechanism, as [geometry] kind names it."""
    PARAMETERS: ClassVar[tuple[str, ...]]
    """Names of the five parameters that calibration determines [m, rad]."""
    DOUBT: ClassVar[tuple[float, ...]]
    """Standard deviation of each beyond which drawings tell as much [m, rad]."""
    CROSS: ClassVar[str]
    """Name of the cross slide's guide, for messages."""

    @property
    def anchor(self) -> tuple[float, float]:
        """A point of the rail in the base frame [m]."""
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
        """A phi at which cross slide and rail are parallel, others are pi apart; None where there is none [rad]."""
        ...

    @property
    def arm(self) -> float:
        """Distance from G to the leg [m]."""
        ...

    @property
    def crossing(self) -> CrossSlide:
        """How to draw the cross slide."""
        ...

    def keys(self) -> dict[str, Any]:
        """Return its numbers by the keys of [[geometry.leg]] [m, rad]."""
        ...

    def check(self, name: str) -> None:
        """Refuse what is not finite, or singular at the pose (0, 0, 0). Raises KinematicsError."""
        ...

    def packed(self) -> Array:
        """Return the leg as joints for trirail.kinematics.recursion: shape (4, 13)."""
        ...

    def travels(self, x: Array, y: Array, phi: Array) -> tuple[Array, Array]:
        """Return where slider and cross slide are at poses, arrays of one shape [m]."""
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
        """Return how F, J1 by the slider and -J2 by the pose, changes with corrections to `first`: (N, 5)."""
        ...


def check_finite(leg: Any, name: str) -> None:
    """Refuse a leg, a dataclass, with a number that is not finite. Raises KinematicsError."""
    for key, value in zip(leg.__slots__, astuple(leg), strict=True):
        if not np.all(np.isfinite(value)):
            raise KinematicsError(f"leg {name}: {key} is {value}: it must be finite", leg=name)


def theta(angle: float) -> Array:
    """Return theta_alpha of (3)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def wrapped(angle: float) -> float:
    """Return the same angle in (-pi, pi]."""
    within = math.remainder(angle, 2.0 * math.pi)
    return within if within > -math.pi else math.pi


def across(point: tuple[float, float], angle: float, distance: float) -> tuple[float, float]:
    """Return the point at a distance to the left of a line at this angle."""
    return point[0] - distance * math.sin(angle), point[1] + distance * math.cos(angle)
