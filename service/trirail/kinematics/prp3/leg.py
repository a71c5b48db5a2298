"""Leg of the 3-PRP mechanism: a rail, a pivot on the carriage, and a cross slide along an edge of the platform.

With u(a) = (cos a, sin a), the platform's centre G and the rotation R(phi) of the platform, the loop equation of the
leg, (9) and (11), is

    anchor + (home + lambda_10) u(rail_angle) + lambda_32 u(phi + edge_angle) = G + R(phi) edge_point
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
from trirail.kinematics.leg import PARALLEL, THETA_1, CrossSlide, across, check_finite, theta

__all__ = ["Leg"]


@dataclass(frozen=True, slots=True)
class Leg:
    """Leg with a slider on a rail of the base. The slider carries a pin, along which an edge of the platform slides.

    `anchor` is a point of the rail and `rail_angle` is the direction of the rail. The slider reads zero at the distance
    `home` from the anchor. `edge_point` is the point of the platform that is at the pin when lambda_32 is zero, and
    `edge_angle` is the direction of the edge. Both are in the platform's frame.
    """

    KIND: ClassVar[str] = "3-PRP"
    # A displacement of the anchor along the rail only changes `home`. A displacement of the edge point along the edge
    # only changes the zero of lambda_32. These displacements are therefore not calibrated.
    PARAMETERS: ClassVar[tuple[str, ...]] = (
        "anchor across the rail",
        "rail_angle",
        "home",
        "edge_point across the edge",
        "edge_angle",
    )
    DOUBT: ClassVar[tuple[float, ...]] = (0.01, 0.05, 0.01, 0.01, 0.05)
    CROSS: ClassVar[str] = "edge"

    anchor: tuple[float, float]
    rail_angle: float
    home: float
    edge_point: tuple[float, float]
    edge_angle: float

    @property
    def cross_angle(self) -> float:
        """Direction of the edge in the base frame at phi = 0 [rad]."""
        return self.edge_angle

    @property
    def parallel_angle(self) -> float:
        """Angle phi at which the edge is parallel to the rail, modulo pi [rad]."""
        return self.rail_angle - self.edge_angle

    @property
    def arm(self) -> float:
        """Distance from G to the edge point [m]."""
        return math.hypot(*self.edge_point)

    @property
    def crossing(self) -> CrossSlide:
        """Position and direction of the edge on the platform, for drawings."""
        return CrossSlide(self.edge_point, self.edge_angle, True)

    def keys(self) -> dict[str, Any]:
        """Return the numbers of the leg [m, rad] under their keys in [[geometry.leg]]."""
        return asdict(self)

    def check(self, name: str) -> None:
        """Raise KinematicsError if a number is not finite, or the leg is singular at the pose (0, 0, 0)."""
        check_finite(self, name)
        if abs(math.sin(self.edge_angle - self.rail_angle)) <= PARALLEL:
            raise KinematicsError(
                f"leg {name}: edge_angle is parallel to rail_angle: singular at the pose (0, 0, 0)",
                leg=name,
                value=self.edge_angle,
                limit=self.rail_angle,
            )

    def packed(self) -> Array:
        """Return the leg as joints for trirail.kinematics.recursion, with shape (4, 13)."""
        start = np.array([*self.anchor, 0.0]) + self.home * theta(self.rail_angle)[0]
        to_centre = theta(self.edge_angle) @ [-self.edge_point[0], -self.edge_point[1], 0.0]
        return serial_leg(
            [  # (2), with theta_2 as the rotation by the angle between rail and edge of this leg
                Joint("prismatic", THETA_1 @ theta(self.rail_angle), start),
                Joint("revolute", THETA_1.T),
                Joint("prismatic", THETA_1 @ theta(self.edge_angle - self.rail_angle)),
            ],
            tip=THETA_1 @ to_centre,
        )

    def travels(self, x: Array, y: Array, phi: Array) -> tuple[Array, Array]:
        """Return lambda_10 and lambda_32 at poses, as arrays of one shape [m], by (11)."""
        cos, sin = np.cos(phi), np.sin(phi)
        (u, v), (anchor_x, anchor_y) = self.edge_point, self.anchor
        way_x, way_y = x + cos * u - sin * v - anchor_x, y + sin * u + cos * v - anchor_y
        edge_x, edge_y = np.cos(phi + self.edge_angle), np.sin(phi + self.edge_angle)
        rail_x, rail_y = math.cos(self.rail_angle), math.sin(self.rail_angle)
        with np.errstate(divide="ignore", invalid="ignore"):
            pin = (edge_x * way_y - edge_y * way_x) / (edge_x * rail_y - edge_y * rail_x)
            return pin - self.home, edge_x * (way_x - pin * rail_x) + edge_y * (way_y - pin * rail_y)

    def row(self, pose: tuple[float, float, float]) -> tuple[float, Array]:
        """Return the diagonal element of J1 and the row (3,) of J2, (16), that belong to this leg, up to a common sign.

        They follow from (11) by eliminating lambda_32: the edge always passes through the pin of the slider, and the
        velocity of the edge relative to the pin has no component across the edge.
        """
        x, y, phi = pose
        edge = theta(phi + self.edge_angle)[:2, :2]  # along the edge, and across it
        rail, turn = theta(self.rail_angle)[0, :2], theta(phi)[:2, :2].T
        delta = float(edge[1] @ rail)
        way = np.array([x, y]) + turn @ self.edge_point - self.anchor
        pin = (edge[1] @ way) / delta * rail
        sideways = edge[1] @ turn @ np.array([-self.edge_point[1], self.edge_point[0]])
        return delta, np.array([*edge[1], sideways - edge[0] @ (way - pin)])

    def lever(self, centre: tuple[float, float], phi: Array) -> Array:
        """Return beta_3 of (18) [m]. The position of the slider is eliminated by (11)."""
        rail, edge = self.rail_angle, self.edge_angle
        x, y = self.anchor[0] - centre[0], self.anchor[1] - centre[1]
        to_rail = y * math.cos(rail) - x * math.sin(rail)
        to_edge = self.edge_point[0] * math.sin(edge) - self.edge_point[1] * math.cos(edge)
        delta = phi + edge - rail
        element: Array = -(to_rail + to_edge * np.cos(delta)) / np.sin(delta)
        return element

    def corrected(self, corrections: Sequence[float]) -> Leg:
        """Return a copy of the leg with corrections added to its PARAMETERS."""
        anchor, rail_angle, home, edge_point, edge_angle = corrections
        return Leg(
            anchor=across(self.anchor, self.rail_angle, anchor),
            rail_angle=self.rail_angle + rail_angle,
            home=self.home + home,
            edge_point=across(self.edge_point, self.edge_angle, edge_point),
            edge_angle=self.edge_angle + edge_angle,
        )

    def parameter_derivatives(self, first: Leg, phi: Array, slider: Array, passive: Array) -> Array:
        """Return the derivatives of F with respect to corrections of `first`, (N, 5).

        With n as the normal of the edge, F = n . (anchor + (home + lambda_10) u(rail_angle) - G - R edge_point) = 0.
        """
        psi = phi + self.edge_angle
        return np.stack(
            [
                -np.cos(psi - first.rail_angle),
                -(self.home + slider) * np.cos(psi - self.rail_angle),
                np.sin(psi - self.rail_angle),
                np.full(len(phi), math.cos(self.edge_angle - first.edge_angle)),
                -passive,
            ],
            axis=1,
        )
