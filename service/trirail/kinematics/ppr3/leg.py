"""Leg of the 3-PPR mechanism: a rail, a cross slide of fixed direction on the carriage, and a pivot under the platform.

With u(a) = (cos a, sin a), the platform's centre G and the rotation R(phi) of the platform, the loop equation of the
leg is

    anchor + (home + lambda_10) u(rail_angle) + lambda_21 u(slide_angle) = G + R(phi) pivot

With n as the normal of the cross slide, n . u lambda_10 = n . (G + R(phi) pivot - anchor - home u) follows. This
equation is linear in G.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.joints import Joint, serial_leg
from trirail.kinematics.leg import PARALLEL, THETA_1, CrossSlide, check_finite, theta

__all__ = ["CrossLeg"]


@dataclass(frozen=True, slots=True)
class CrossLeg:
    """Leg with a slider on a rail of the base. The slider carries a cross slide, along which a platform pivot moves.

    `anchor` is a point of the rail and `rail_angle` is the direction of the rail. The slider reads zero at the distance
    `home` from the anchor. `pivot` is in the platform's frame. `slide_angle` is the direction of the cross slide in the
    base frame; if it is None, the cross slide is at right angles to the rail.
    """

    KIND: ClassVar[str] = "3-PPR"
    # A displacement of the anchor only changes `home` and the zero of lambda_21. The anchor is therefore not
    # calibrated. If the cross slide is at right angles to its rail, measured poses do not determine the angle of the
    # rail, and calibration reports it as undetermined.
    PARAMETERS: ClassVar[tuple[str, ...]] = ("rail_angle", "home", "pivot in x", "pivot in y", "slide_angle")
    DOUBT: ClassVar[tuple[float, ...]] = (0.05, 0.01, 0.01, 0.01, 0.05)
    CROSS: ClassVar[str] = "cross slide"

    anchor: tuple[float, float]
    rail_angle: float
    home: float
    pivot: tuple[float, float]
    slide_angle: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "slide_angle", self.cross_angle)

    @property
    def cross_angle(self) -> float:
        """Direction of the cross slide [rad]."""
        return self.rail_angle + math.pi / 2.0 if self.slide_angle is None else self.slide_angle

    @property
    def parallel_angle(self) -> None:
        """None, because the angle between cross slide and rail is constant."""
        return None

    @property
    def arm(self) -> float:
        """Distance from G to the pivot [m]."""
        return math.hypot(*self.pivot)

    @property
    def crossing(self) -> CrossSlide:
        """Position and direction of the cross slide on the carriage, for drawings."""
        return CrossSlide(self.pivot, self.cross_angle, False)

    def keys(self) -> dict[str, Any]:
        """Return the numbers of the leg [m, rad] under their keys in [[geometry.leg]]."""
        return asdict(self)

    def check(self, name: str) -> None:
        """Raise KinematicsError if a number is not finite, or the cross slide is parallel to its rail."""
        check_finite(self, name)
        if abs(math.sin(self.cross_angle - self.rail_angle)) <= PARALLEL:
            raise KinematicsError(
                f"leg {name}: slide_angle is parallel to rail_angle: the cross slide must lead across the rail",
                leg=name,
                value=self.cross_angle,
                limit=self.rail_angle,
            )

    def packed(self) -> Array:
        """Return the leg as joints for trirail.kinematics.recursion, with shape (4, 13)."""
        start = np.array([*self.anchor, 0.0]) + self.home * theta(self.rail_angle)[0]
        # The z axis of a prismatic joint is its direction of motion. THETA_1 maps x to z, and its transpose maps z to
        # x.
        return serial_leg(
            [
                Joint("prismatic", THETA_1 @ theta(self.rail_angle), start),
                Joint("prismatic", THETA_1 @ theta(self.cross_angle - self.rail_angle) @ THETA_1.T),
                Joint("revolute", theta(-self.cross_angle) @ THETA_1.T),
            ],
            tip=[-self.pivot[0], -self.pivot[1], 0.0],
        )

    def travels(self, x: Array, y: Array, phi: Array) -> tuple[Array, Array]:
        """Return lambda_10 and lambda_21 at poses, as arrays of one shape [m]."""
        cos, sin = np.cos(phi), np.sin(phi)
        way_x = x + cos * self.pivot[0] - sin * self.pivot[1] - self.anchor[0]
        way_y = y + sin * self.pivot[0] + cos * self.pivot[1] - self.anchor[1]
        rail_x, rail_y = math.cos(self.rail_angle), math.sin(self.rail_angle)
        cross_x, cross_y = math.cos(self.cross_angle), math.sin(self.cross_angle)
        delta = rail_x * cross_y - rail_y * cross_x
        slider = (way_x * cross_y - way_y * cross_x) / delta - self.home
        return slider, (rail_x * way_y - rail_y * way_x) / delta

    def row(self, pose: tuple[float, float, float]) -> tuple[float, Array]:
        """Return the diagonal element of J1 and the row (3,) of J2, (16), that belong to this leg."""
        x, y = math.cos(self.cross_angle), math.sin(self.cross_angle)
        lever = self.lever((pose[0], pose[1]), np.array([pose[2]]))
        return math.sin(self.cross_angle - self.rail_angle), np.array([y, -x, lever[0]])

    def lever(self, centre: tuple[float, float], phi: Array) -> Array:  # noqa: ARG002 - as of every leg
        """Return the last element of the row of J2 of this leg, u(cross_angle) . (-R(phi) pivot) [m], for any G."""
        angle = phi - self.cross_angle
        element: Array = -(self.pivot[0] * np.cos(angle) - self.pivot[1] * np.sin(angle))
        return element

    def corrected(self, corrections: Sequence[float]) -> CrossLeg:
        """Return a copy of the leg with corrections added to its PARAMETERS."""
        rail_angle, home, pivot_x, pivot_y, slide_angle = corrections
        return CrossLeg(
            anchor=self.anchor,
            rail_angle=self.rail_angle + rail_angle,
            home=self.home + home,
            pivot=(self.pivot[0] + pivot_x, self.pivot[1] + pivot_y),
            slide_angle=self.cross_angle + slide_angle,
        )

    def parameter_derivatives(self, first: CrossLeg, phi: Array, slider: Array, passive: Array) -> Array:  # noqa: ARG002
        """Return the derivatives of F with respect to corrections of the leg, (N, 5).

        With n = (sin, -cos)(cross_angle), F = n . (anchor + (home + lambda_10) u(rail_angle) - G - R pivot) = 0.
        """
        delta, angle = self.cross_angle - self.rail_angle, phi - self.cross_angle
        return np.stack(
            [
                -(self.home + slider) * math.cos(delta),
                np.full(len(phi), math.sin(delta)),
                np.sin(angle),
                np.cos(angle),
                -passive,
            ],
            axis=1,
        )
