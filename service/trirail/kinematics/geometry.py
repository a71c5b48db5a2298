"""The three legs of a 3-PRP robot, symmetric or as built, and the platform angles at which they are singular.

Lengths are in metres, angles in radians. With u(a) = (cos a, sin a), the platform's centre G and its rotation
R(phi), each leg closes the loop (9), (11):

    anchor + (home + lambda_10) u(rail_angle) + lambda_32 u(phi + edge_angle) = G + R(phi) edge_point
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.correction import Correction
from trirail.kinematics.joints import Joint, serial_leg

__all__ = ["LEGS", "PARALLEL", "Geometry", "Leg", "Room", "det_j2", "gains", "singular_angles", "travels"]

LEGS = ("A", "B", "C")
PARALLEL = 1e-9  # |sin| of the angle between an edge and its rail up to which the leg counts as singular
THETA_1 = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # (3)


@dataclass(frozen=True, slots=True)
class Leg:
    """One leg: a slider on a rail of the base carries a pin, along which an edge of the platform slides.

    `anchor` is a point of the rail, `rail_angle` its direction, and the slider reads zero at `home` from the
    anchor. `edge_point` is the point of the platform that is at the pin when lambda_32 is zero, `edge_angle`
    the direction of the edge; both are in the platform's frame.
    """

    anchor: tuple[float, float]
    rail_angle: float
    home: float
    edge_point: tuple[float, float]
    edge_angle: float

    def packed(self) -> Array:
        """Return the leg as joints for trirail.kinematics.recursion: shape (4, 13)."""
        start = np.array([*self.anchor, 0.0]) + self.home * _theta(self.rail_angle)[0]
        to_centre = _theta(self.edge_angle) @ [-self.edge_point[0], -self.edge_point[1], 0.0]
        return serial_leg(
            [  # (2), with theta_2 for the angle between this leg's rail and edge
                Joint("prismatic", THETA_1 @ _theta(self.rail_angle), start),
                Joint("revolute", THETA_1.T),
                Joint("prismatic", THETA_1 @ _theta(self.edge_angle - self.rail_angle)),
            ],
            tip=THETA_1 @ to_centre,
        )


@dataclass(frozen=True, slots=True)
class Geometry:
    """Three legs A, B, C, and what the robot differs from them by, if that is known.

    KinematicsError if a number is not finite or the pose (0, 0, 0) is singular.
    """

    legs: tuple[Leg, Leg, Leg]
    correction: Correction | None = None
    _packed: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _check(self)
        packed = np.stack([leg.packed() for leg in self.legs])
        if self.correction is not None:
            packed = np.concatenate([packed, self.correction.packed().reshape(-1, *packed.shape[1:])])
        packed.setflags(write=False)
        object.__setattr__(self, "_packed", packed)

    @classmethod
    def symmetric(cls, l0: float = 0.3) -> Geometry:
        """Return the paper's robot, (1) and (10): its anchors at l0 [m] from the centre."""
        if not (math.isfinite(l0) and l0 > 0.0):
            raise KinematicsError(f"l0 is {l0} m: it must be finite and positive", value=l0, limit=0.0)
        alphas = (math.pi / 3, math.pi, -math.pi / 3)
        anchors = ((0.0, -l0), (math.sqrt(3) / 2 * l0, l0 / 2), (-math.sqrt(3) / 2 * l0, l0 / 2))
        home = l0 / math.sqrt(3)
        legs = [
            Leg(
                anchor=(x, y),
                rail_angle=alpha,
                home=home,
                # in the central configuration every slider reads zero and the edge point lies at the pin
                edge_point=(x + home * math.cos(alpha), y + home * math.sin(alpha)),
                edge_angle=alpha - math.pi / 3,
            )
            for alpha, (x, y) in zip(alphas, anchors, strict=True)
        ]
        return cls(legs=(legs[0], legs[1], legs[2]))

    def packed(self) -> Array:
        """Return the three legs as compiled code takes them: float64, shape (3, 4, 13), read-only.

        Axes: leg; its three joints and the platform's centre; the columns described in trirail.kinematics.recursion.
        Where there is a correction it follows, in as many more rows of the first axis as it takes: one array, since
        each further one would cost every call a microsecond.
        """
        return self._packed


def singular_angles(geometry: Geometry, centre: tuple[float, float] = (0.0, 0.0)) -> tuple[float, ...]:
    """Return every phi [rad] in (-pi, pi], ascending, at which J1 or J2 is singular with G at `centre` [m].

    The nearest on either side of zero bound the usable range: on the symmetric robot -2 pi/3 and pi/3,
    wherever G is. On a robot as built the angles that J1 excludes, where an edge is parallel to its rail,
    still depend on nothing else; those that J2 excludes move with G, and can lie degrees inside.
    """
    of_j1 = _singular_angles_of_j1(geometry)
    found = [*of_j1]
    for low, high in zip(of_j1, [*of_j1[1:], of_j1[0] + 2.0 * math.pi], strict=True):
        # det J2 is smooth between two singular angles of J1. Zeros crowd at the ends, so the samples do too.
        phi = (low + high) / 2.0 - (high - low) / 2.0 * np.cos(np.linspace(0.0, math.pi, 257)[1:-1])
        negative = det_j2(geometry, centre, phi) < 0.0
        changes = np.flatnonzero(negative[1:] != negative[:-1]).tolist()
        found.extend(_bisect(geometry, centre, float(phi[k]), float(phi[k + 1])) for k in changes)
    return tuple(sorted(_wrapped(phi) for phi in found))


class Room(NamedTuple):
    """Where a robot may be: the least and the greatest of x, y [m] and phi [rad], of lambda_10 and of lambda_32 [m]."""

    low: Sequence[float]
    high: Sequence[float]
    position: tuple[float, float]
    passive: tuple[float, float]

    def holds(self, travelled: Array, spare: float = 0.0) -> NDArray[np.bool]:
        """Whether sliders and passive joints (2, ..., 3) are within their travel, or `spare` beyond it [m]: (...)."""
        low, high = np.array([self.position, self.passive]).T.reshape(2, 2, *[1] * (travelled.ndim - 1))
        within: NDArray[np.bool] = ((travelled >= low - spare) & (travelled <= high + spare)).all(axis=(0, -1))
        return within


def travels(geometry: Geometry, poses: ArrayLike) -> Array:
    """Return lambda_10 and lambda_32 of the legs at poses (..., 3) of x, y [m], phi [rad]: (2, ..., 3) [m], by (11).

    For who looks at a few poses and has no use for the compiled trirail.kinematics.robot.inverse. Not finite where an
    edge is parallel to its rail.
    """
    told = np.array(poses, dtype=np.float64)
    if geometry.correction is not None:
        told += geometry.correction.at(told.reshape(-1, 3)).reshape(told.shape)
    x, y, phi = np.moveaxis(told, -1, 0)
    cos, sin = np.cos(phi), np.sin(phi)
    found = np.empty((2, *told.shape))
    for i, leg in enumerate(geometry.legs):
        (u, v), (anchor_x, anchor_y) = leg.edge_point, leg.anchor
        way_x, way_y = x + cos * u - sin * v - anchor_x, y + sin * u + cos * v - anchor_y
        edge_x, edge_y = np.cos(phi + leg.edge_angle), np.sin(phi + leg.edge_angle)
        rail_x, rail_y = math.cos(leg.rail_angle), math.sin(leg.rail_angle)
        with np.errstate(divide="ignore", invalid="ignore"):
            pin = (edge_x * way_y - edge_y * way_x) / (edge_x * rail_y - edge_y * rail_x)
            found[0, ..., i] = pin - leg.home
            found[1, ..., i] = edge_x * (way_x - pin * rail_x) + edge_y * (way_y - pin * rail_y)
    return found


def gains(geometry: Geometry, pose: tuple[float, float, float]) -> Array:
    """Return by how much x, y [m] and phi [rad] change for a metre of each slider: (3, 3), J2^-1 J1 at a pose.

    From (11) without lambda_32: the sine between the edge and the way from the slider's pin to G + R(phi) edge_point
    stays zero. LinAlgError where J2 is singular.
    """
    x, y, phi = pose
    j1, j2 = np.zeros((3, 3)), np.zeros((3, 3))
    for i, leg in enumerate(geometry.legs):
        edge = _theta(phi + leg.edge_angle)[:2, :2]  # along the edge, and across it
        rail, turn = _theta(leg.rail_angle)[0, :2], _theta(phi)[:2, :2].T
        j1[i, i] = edge[1] @ rail
        way = np.array([x, y]) + turn @ leg.edge_point - leg.anchor
        pin = (edge[1] @ way) / j1[i, i] * rail
        across = edge[1] @ turn @ np.array([-leg.edge_point[1], leg.edge_point[0]])
        j2[i] = *edge[1], across - edge[0] @ (way - pin)
    changes: Array = np.asarray(np.linalg.solve(j2, j1), dtype=np.float64)
    return changes


def _singular_angles_of_j1(geometry: Geometry) -> list[float]:
    """Return each phi in (-pi, pi] at which the edge of some leg is parallel to its rail, ascending."""
    parallel = (leg.rail_angle - leg.edge_angle + turn for leg in geometry.legs for turn in (0.0, math.pi))
    angles = sorted(_wrapped(phi) for phi in parallel)
    return [phi for k, phi in enumerate(angles) if k == 0 or phi - angles[k - 1] > PARALLEL]


def det_j2(geometry: Geometry, centre: tuple[float, float], phi: Array) -> Array:
    """Return det J2 [m] for poses with G at `centre` and any angles `phi`.

    Only the third column of J2 depends on G, and its cofactors w, the sines between the edges, are constant:
    det J2 = sum w_i beta_3^i. In beta_3^i the slider position is replaced by its solution of (11).
    """
    a, b, c = (leg.edge_angle for leg in geometry.legs)
    cofactors = math.sin(c - b), math.sin(a - c), math.sin(b - a)
    det = np.zeros_like(phi)
    for w, leg in zip(cofactors, geometry.legs, strict=True):
        rail, edge = leg.rail_angle, leg.edge_angle
        x, y = leg.anchor[0] - centre[0], leg.anchor[1] - centre[1]
        to_rail = y * math.cos(rail) - x * math.sin(rail)
        to_edge = leg.edge_point[0] * math.sin(edge) - leg.edge_point[1] * math.cos(edge)
        delta = phi + edge - rail
        det -= w * (to_rail + to_edge * np.cos(delta)) / np.sin(delta)
    return det


def _bisect(geometry: Geometry, centre: tuple[float, float], low: float, high: float) -> float:
    """Return the phi between `low` and `high`, where det J2 differs in sign, at which it is zero."""
    negative = det_j2(geometry, centre, np.array([low]))[0] < 0.0
    while low < (middle := (low + high) / 2.0) < high:
        if (det_j2(geometry, centre, np.array([middle]))[0] < 0.0) == negative:
            low = middle
        else:
            high = middle
    return middle


def _check(geometry: Geometry) -> None:
    """Refuse what is not finite, or singular at the pose (0, 0, 0), by which forward tells branches apart."""
    for name, leg in zip(LEGS, geometry.legs, strict=True):
        for key, value in zip(Leg.__slots__, astuple(leg), strict=True):
            if not np.all(np.isfinite(value)):
                raise KinematicsError(f"leg {name}: {key} is {value}: it must be finite", leg=name)
        delta = leg.edge_angle - leg.rail_angle
        if abs(math.sin(delta)) <= PARALLEL:
            raise KinematicsError(
                f"leg {name}: edge_angle is parallel to rail_angle: singular at the pose (0, 0, 0)",
                leg=name,
                value=leg.edge_angle,
                limit=leg.rail_angle,
            )
    determinant = float(det_j2(geometry, (0.0, 0.0), np.zeros(1))[0])
    size = max(math.hypot(*leg.anchor) + abs(leg.home) + math.hypot(*leg.edge_point) for leg in geometry.legs)
    if abs(determinant) <= PARALLEL * size:
        raise KinematicsError(
            f"the legs cannot hold the platform at the pose (0, 0, 0): det J2 is {determinant:.3g} m there",
            value=determinant,
            limit=PARALLEL * size,
        )


def _theta(angle: float) -> Array:
    """Return theta_alpha of (3)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _wrapped(angle: float) -> float:
    """Return the same angle in (-pi, pi]."""
    wrapped = math.remainder(angle, 2.0 * math.pi)
    return wrapped if wrapped > -math.pi else math.pi
