"""Where the robot's parts lie: points to draw it by, in metres, from its geometry and limits.

Fixed parts are in the base frame. Those of the platform are in its own frame, with the centre G at the origin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trirail.config import SliderLimits
from trirail.kinematics.geometry import PARALLEL, Geometry
from trirail.kinematics.leg import AnyLeg

Points = NDArray[np.float64]
STOP = 0.022
"""Length of an end stop's mark, as a share of the longest rail."""
SLEEVE = 0.035
"""Half the length of the sleeve in which an edge of the platform slides, likewise."""
TABLE = 0.3
"""By what share of its size a stage's table reaches beyond the points by which it is held."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotParts:
    """The robot's parts; a line is an array of points, (N, 2)."""

    anchors: Points
    """(3, 2): where the rails begin."""
    rails: list[Points]
    travel: list[Points]
    """Where on its rail each slider may be."""
    stops: list[Points]
    """Marks across both ends of each travel."""
    outline: list[Points]
    """The platform: the triangle of its edges, or a table over those that form none and over pivots."""
    edge_stops: list[Points]
    """Marks across both ends of the passive joints' travel along the platform's edges."""
    arms: list[Points]
    """From the platform's centre to where it is held."""
    names: Points
    """(3, 2): beside the middle of each rail, outside."""
    cross_slides: Points
    """(3, 2): where each cross slide's drawn part begins and ends, along it from the carriage [m]."""
    bounds: Points
    """(2, 2): lowest and highest x and y of everything at the pose (0, 0, 0)."""

    @classmethod
    def of(cls, geometry: Geometry, limits: SliderLimits) -> RobotParts:
        """Lay out a robot's parts."""
        legs, ends_of = geometry.each, limits.positions
        # a rail reaches as far beyond its slider's travel as it begins before it
        rails = [
            _on_rail(leg, -leg.home, high + (low + leg.home)) for leg, (low, high) in zip(legs, ends_of, strict=True)
        ]
        longest = max(float(np.linalg.norm(rail[1] - rail[0])) for rail in rails)
        corners = _corners(legs)
        edges = [_on_edge(leg, *limits.passive) for leg in legs if leg.crossing.turns]
        outline = [*edges, _table(legs)] if corners is None else [corners[[0, 1, 2, 0]]]
        ends = [np.array(leg.crossing.point) for leg in legs] if corners is None else list(corners)
        middles = np.array([rail.mean(axis=0) for rail in rails])
        away = [_away(leg, middle - middles.mean(axis=0)) for leg, middle in zip(legs, middles, strict=True)]
        everything = np.concatenate([*rails, *outline])
        half = SLEEVE * longest
        return cls(
            anchors=np.array([leg.anchor for leg in legs]),
            rails=rails,
            travel=[_on_rail(leg, *own) for leg, own in zip(legs, ends_of, strict=True)],
            stops=[
                _across(_on_rail(leg, position), leg.rail_angle, STOP * longest)
                for leg, own in zip(legs, ends_of, strict=True)
                for position in own
            ],
            outline=outline,
            edge_stops=[
                _across(_on_edge(leg, at), leg.crossing.angle, STOP * longest)
                for leg in legs
                if leg.crossing.turns
                for at in limits.passive
            ],
            arms=[np.array([np.zeros(2), end]) for end in ends],
            names=middles + 0.07 * longest * np.array(away),
            cross_slides=np.array([(-half, half) if leg.crossing.turns else limits.passive for leg in legs]),
            bounds=np.array([everything.min(axis=0), everything.max(axis=0)]),
        )


def sliders(geometry: Geometry, position: Points) -> Points:
    """Return where the sliders are, (N, 3, 2), for positions lambda_10, (N, 3)."""
    at = np.empty((*position.shape, 2))
    for k, leg in enumerate(geometry.each):
        at[:, k] = np.array(leg.anchor) + np.outer(leg.home + position[:, k], _u(leg.rail_angle))
    return at


def cross_slides(geometry: Geometry, parts: RobotParts, carriages: Points, phi: Points) -> Points:
    """Return the cross slides as lines, (N, 3, 2, 2), on carriages (N, 3, 2) for angles (N,).

    The sleeve of an edge turns with the platform; a cross slide that is fixed to its carriage does not.
    """
    crossings = [leg.crossing for leg in geometry.each]
    angles = np.outer(phi, [each.turns for each in crossings]) + [each.angle for each in crossings]
    along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    lines: Points = carriages[:, :, None] + parts.cross_slides[:, :, None] * along[:, :, None]
    return lines


def pivots(geometry: Geometry, carriages: Points, poses: Points) -> Points:
    """Return what the platform turns on, (N, 3, 2): carriages (N, 3, 2), or points of the platform at poses (N, 3)."""
    at = carriages.copy()
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    for k, leg in enumerate(geometry.each):
        if not leg.crossing.turns:
            u, v = leg.crossing.point
            at[:, k] = poses[:, :2] + np.stack([c * u - s * v, s * u + c * v], axis=1)
    return at


def placed(lines: list[Points], pose: Sequence[float]) -> list[Points]:
    """Return lines of the platform's frame in the base frame, for the platform at a pose."""
    x, y, phi = pose
    c, s = math.cos(phi), math.sin(phi)
    return [line @ np.array([[c, s], [-s, c]]) + [x, y] for line in lines]


def _on_rail(leg: AnyLeg, *positions: float) -> Points:
    return np.array([np.array(leg.anchor) + (leg.home + at) * _u(leg.rail_angle) for at in positions])


def _on_edge(leg: AnyLeg, *positions: float) -> Points:
    point, angle, _ = leg.crossing
    return np.array([np.array(point) - at * _u(angle) for at in positions])


def _across(place: Points, angle: float, length: float) -> Points:
    """Return a mark across a line of an angle [rad], at a place, (1, 2)."""
    across = length / 2.0 * _u(angle + math.pi / 2.0)
    return np.concatenate([place - across, place + across])


def _away(leg: AnyLeg, outward: Points) -> Points:
    """Return the unit vector across the rail on the side of `outward`."""
    across = _u(leg.rail_angle + math.pi / 2.0)
    return across if across @ outward >= 0.0 else -across


def _corners(legs: Sequence[AnyLeg]) -> Points | None:
    """Return where each edge of the platform meets the next, (3, 2), or None where two never do, or it has none."""
    corners = []
    for one, other in zip(legs, (*legs[1:], legs[0]), strict=True):
        (point, angle, turns), (beyond, other_angle, _) = one.crossing, other.crossing
        sine = math.sin(other_angle - angle)
        if not turns or abs(sine) <= PARALLEL:
            return None
        between = np.array(beyond) - np.array(point)
        along = (between[0] * math.sin(other_angle) - between[1] * math.cos(other_angle)) / sine
        corners.append(np.array(point) + along * _u(angle))
    return np.array(corners)


def _table(legs: Sequence[AnyLeg]) -> Points:
    """Return a closed rectangle over the points by which a stage's table is held, and the centre, (5, 2)."""
    held = np.array([(0.0, 0.0), *(leg.crossing.point for leg in legs)])
    low, high = held.min(axis=0), held.max(axis=0)
    beyond = TABLE * float((high - low).max()) / 2.0
    (left, bottom), (right, top) = low - beyond, high + beyond
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top], [left, bottom]])


def _u(angle: float) -> Points:
    return np.array([math.cos(angle), math.sin(angle)])
