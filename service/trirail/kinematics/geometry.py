"""Geometry of a robot, symmetric or as built, and the platform angles at which the robot is singular.

Lengths are in metres, angles in radians. The functions of this module work for every mechanism, because they use only
the interface in trirail.kinematics.leg. This interface is implemented in prp3.leg and ppr3.leg.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.correction import Correction
from trirail.kinematics.leg import LEGS, PARALLEL, AnyLeg, wrapped
from trirail.kinematics.ppr3.leg import CrossLeg
from trirail.kinematics.prp3.leg import Leg
from trirail.naming import Labels

__all__ = [
    "LEGS",
    "PARALLEL",
    "CrossLeg",
    "Geometry",
    "Leg",
    "Room",
    "det_j2",
    "gains",
    "other_kind",
    "singular_angles",
    "travels",
]


@dataclass(frozen=True, slots=True)
class Geometry:
    """Geometry of a robot: three legs A, B, C, and an optional correction for as-built errors.

    Raises KinematicsError if a number is not finite, if the legs belong to different mechanisms or do not match `kind`,
    or if the pose (0, 0, 0) is singular.
    """

    legs: tuple[Any, Any, Any]
    """Three legs of the same class, prp3.leg.Leg or ppr3.leg.CrossLeg. Code for any mechanism should use `each`."""
    correction: Correction | None = None
    labels: Labels = field(default=LEGS, compare=False)
    """Display names of the sliders."""
    kind: str = ""
    """Name of the mechanism, 3-PRP or 3-PPR, as in the key kind of [geometry]. The default is the mechanism of the
    legs."""
    _packed: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _check(self)
        kind = self.each[0].KIND
        if self.kind not in ("", kind):
            raise KinematicsError(f"kind is {self.kind!r}, but the legs are those of a {kind} robot")
        object.__setattr__(self, "kind", kind)
        packed = np.stack([leg.packed() for leg in self.legs])
        if self.correction is not None:
            packed = np.concatenate([packed, self.correction.packed().reshape(-1, *packed.shape[1:])])
        packed.setflags(write=False)
        object.__setattr__(self, "_packed", packed)

    @classmethod
    def symmetric(cls, l0: float = 0.3) -> Geometry:
        """Return the symmetric robot of the paper, (1) and (10), with the anchors l0 [m] from the centre."""
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
                # at the pose (0, 0, 0), every slider reads zero, and the edge point is at the pin
                edge_point=(x + home * math.cos(alpha), y + home * math.sin(alpha)),
                edge_angle=alpha - math.pi / 3,
            )
            for alpha, (x, y) in zip(alphas, anchors, strict=True)
        ]
        return cls(legs=(legs[0], legs[1], legs[2]))

    def packed(self) -> Array:
        """Return the geometry as a read-only array for compiled code, float64 with shape (3, 4, 13).

        The axes are the leg; the three joints of the leg and the platform's centre; and the columns described in
        trirail.kinematics.recursion. A correction is stored in additional rows of the first axis. A single array is
        used because each additional argument would make every call one microsecond slower.
        """
        return self._packed

    @property
    def each(self) -> tuple[AnyLeg, AnyLeg, AnyLeg]:
        """Legs A, B, C, with the interface that all mechanisms share."""
        return self.legs

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters of each leg that calibration determines [m, rad]."""
        return self.each[0].PARAMETERS

    @property
    def arm(self) -> float:
        """Greatest distance from the platform's centre to a leg [m], which is the travel per radian of rotation."""
        return max(leg.arm for leg in self.each)


def singular_angles(geometry: Geometry, centre: tuple[float, float] = (0.0, 0.0)) -> tuple[float, ...]:
    """Return every phi [rad] in (-pi, pi], in ascending order, at which J1 or J2 is singular with G at `centre` [m].

    The nearest angles below and above zero bound the usable range. For the symmetric robot, they are -2 pi/3 and pi/3,
    independent of G. For a robot as built, the angles at which J1 is singular (an edge is parallel to its rail) are
    also independent of G. The angles at which J2 is singular depend on G, and can be several degrees closer to zero. A
    3-PPR robot has two angles, at a distance of pi, at which J2 is singular for any G.
    """
    of_j1 = _singular_angles_of_j1(geometry)
    if not of_j1:  # in this case, det J2 = A sin phi - B cos phi
        B, A = det_j2(geometry, centre, np.array([math.pi, math.pi / 2.0])).tolist()
        angle = math.atan2(B, A)
        return tuple(sorted((wrapped(angle), wrapped(angle + math.pi))))
    angles = [*of_j1]
    for low, high in zip(of_j1, [*of_j1[1:], of_j1[0] + 2.0 * math.pi], strict=True):
        # det J2 is smooth between two singular angles of J1. Zeros are most likely near the ends of this interval, and
        # the samples are therefore denser there.
        phi = (low + high) / 2.0 - (high - low) / 2.0 * np.cos(np.linspace(0.0, math.pi, 257)[1:-1])
        negative = det_j2(geometry, centre, phi) < 0.0
        changes = np.flatnonzero(negative[1:] != negative[:-1]).tolist()
        angles.extend(_bisect(geometry, centre, float(phi[k]), float(phi[k + 1])) for k in changes)
    return tuple(sorted(wrapped(phi) for phi in angles))


class Room(NamedTuple):
    """Permitted ranges of x, y [m] and phi [rad], and of the positions of sliders and cross slides [m]."""

    low: Sequence[float]
    high: Sequence[float]
    position: tuple[float, float] | tuple[tuple[float, float], ...]
    """Ends of the travel of the sliders: one pair for all sliders, or one pair per slider."""
    passive: tuple[float, float]

    def holds(self, travelled: Array, spare: float = 0.0) -> NDArray[np.bool]:
        """Return whether sliders and cross slides (2, ..., 3) are at most `spare` [m] outside their travel."""
        both = np.stack([np.broadcast_to(ends, (3, 2)) for ends in (self.position, self.passive)])
        low, high = np.moveaxis(both, -1, 0).reshape(2, 2, *[1] * (travelled.ndim - 2), 3)
        within: NDArray[np.bool] = ((travelled >= low - spare) & (travelled <= high + spare)).all(axis=(0, -1))
        return within


def travels(geometry: Geometry, poses: ArrayLike) -> Array:
    """Return the positions of sliders and cross slides, (2, ..., 3) [m], at poses x, y [m], phi [rad], (..., 3).

    The positions follow from (11). This function is meant for a small number of poses, and does not need compiled code,
    in contrast to trirail.kinematics.robot.inverse. If a cross slide is parallel to its rail, the result is not finite.
    """
    solved = np.array(poses, dtype=np.float64)
    if geometry.correction is not None:
        solved += geometry.correction.at(solved.reshape(-1, 3)).reshape(solved.shape)
    x, y, phi = np.moveaxis(solved, -1, 0)
    return np.stack([leg.travels(x, y, phi) for leg in geometry.each], axis=-1)


def other_kind(geometry: Geometry) -> Geometry:
    """Return a robot of the other mechanism, with the same rails and cross slides at the pose (0, 0, 0).

    This is the robot that a user would configure who confuses the two mechanisms. Raises KinematicsError if this robot
    is singular at the pose (0, 0, 0).
    """
    sliders = travels(geometry, (0.0, 0.0, 0.0))[0].tolist()
    legs = []
    for leg, slider in zip(geometry.each, sliders, strict=True):
        x, y = leg.anchor
        along = leg.home + slider
        carriage = x + along * math.cos(leg.rail_angle), y + along * math.sin(leg.rail_angle)
        kind = CrossLeg if isinstance(leg, Leg) else Leg
        legs.append(kind(leg.anchor, leg.rail_angle, leg.home, carriage, leg.cross_angle))
    return Geometry(legs=(legs[0], legs[1], legs[2]), labels=geometry.labels)


def gains(geometry: Geometry, pose: tuple[float, float, float]) -> Array:
    """Return J2^-1 J1 (3, 3) at a pose: the change of x, y [m] and phi [rad] per metre of travel of each slider.

    Raises LinAlgError if J2 is singular.
    """
    rows = [leg.row(pose) for leg in geometry.each]
    changes: Array = np.linalg.solve(np.array([row for _, row in rows]), np.diag([delta for delta, _ in rows]))
    return changes


def _singular_angles_of_j1(geometry: Geometry) -> list[float]:
    """Return each phi in (-pi, pi], in ascending order, at which the cross slide of a leg is parallel to its rail."""
    parallel = [leg.parallel_angle for leg in geometry.each]
    angles = sorted(wrapped(phi + turn) for phi in parallel if phi is not None for turn in (0.0, math.pi))
    return [phi for k, phi in enumerate(angles) if k == 0 or phi - angles[k - 1] > PARALLEL]


def det_j2(geometry: Geometry, centre: tuple[float, float], phi: Array) -> Array:
    """Return det J2 [m] for poses with G at `centre` and with angles `phi`.

    The cofactors w_i of the third column of J2 are the sines of the angles between cross slides, which are constant.
    Therefore det J2 = sum w_i beta_3^i.
    """
    a, b, c = (leg.cross_angle for leg in geometry.each)
    cofactors = math.sin(c - b), math.sin(a - c), math.sin(b - a)
    det = np.zeros_like(phi)
    for w, leg in zip(cofactors, geometry.each, strict=True):
        det += w * leg.lever(centre, phi)
    return det


def _bisect(geometry: Geometry, centre: tuple[float, float], low: float, high: float) -> float:
    """Return the zero of det J2 between two angles at which det J2 has different signs."""
    negative = det_j2(geometry, centre, np.array([low]))[0] < 0.0
    while low < (middle := (low + high) / 2.0) < high:
        if (det_j2(geometry, centre, np.array([middle]))[0] < 0.0) == negative:
            low = middle
        else:
            high = middle
    return middle


def _check(geometry: Geometry) -> None:
    """Raise KinematicsError if the legs have different mechanisms, are not finite, or are singular at (0, 0, 0).

    The function `forward` selects its branch by the pose (0, 0, 0), which must therefore be regular.
    """
    if len({leg.KIND for leg in geometry.each}) > 1:
        kinds = ", ".join(leg.KIND for leg in geometry.each)
        raise KinematicsError(f"the legs are of different mechanisms: {kinds}")
    for name, leg in zip(LEGS, geometry.each, strict=True):
        leg.check(name)
    determinant = float(det_j2(geometry, (0.0, 0.0), np.zeros(1))[0])
    size = max(math.hypot(*leg.anchor) + abs(leg.home) + leg.arm for leg in geometry.each)
    if abs(determinant) <= PARALLEL * size:
        raise KinematicsError(
            f"the legs cannot hold the platform at the pose (0, 0, 0): det J2 is {determinant:.3g} m there",
            value=determinant,
            limit=PARALLEL * size,
        )
