"""Positions of the parts of a robot for drawings [m], computed from the geometry and the limits.

Fixed parts are in the base frame. Parts of the platform are in the platform's frame, with the origin at the centre G.
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
STOP_LENGTH_SHARE = 0.022
"""Length of the drawn mark for an end stop, as a fraction of the length of the longest rail."""
SLEEVE_HALF_LENGTH_SHARE = 0.035
"""Half the length of the drawn sleeve on an edge of the platform, as a fraction of the length of the longest rail."""
TABLE_OVERHANG_SHARE = 0.3
"""Difference between the sizes of a table and of the area of its supports, as a fraction of the latter."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotParts:
    """Positions of the parts of the robot. Each line is an array of points (N, 2)."""

    anchors: Points
    """Start points of the rails (3, 2)."""
    rails: list[Points]
    travel: list[Points]
    """Travel of each slider on its rail."""
    stops: list[Points]
    """Marks across the rails at both ends of the travel of each slider."""
    outline: list[Points]
    """Outline of the platform: the triangle formed by the edges or, if there is no triangle, a rectangular table."""
    edge_stops: list[Points]
    """Marks across the edges of the platform at both ends of the travel of each passive joint."""
    arms: list[Points]
    """Lines from the platform's centre to its supports."""
    names: Points
    """Positions of the sliders' labels, on the outer side of the middle of each rail (3, 2)."""
    cross_slides: Points
    """Start and end of the drawn part of each cross slide, as distances along the slide from the carriage (3, 2)
    [m]."""
    bounds: Points
    """Lowest and highest x and y of the rails and of the platform at the pose (0, 0, 0); shape (2, 2)."""

    @classmethod
    def from_geometry(cls, geometry: Geometry, limits: SliderLimits) -> RobotParts:
        """Compute the parts of a robot with the given geometry and limits."""
        legs, ends_of = geometry.each, limits.positions
        # a rail begins at the anchor, and is equally long beyond both ends of the slider's travel
        rails = [
            _rail_points(leg, -leg.home, high + (low + leg.home))
            for leg, (low, high) in zip(legs, ends_of, strict=True)
        ]
        longest = max(float(np.linalg.norm(rail[1] - rail[0])) for rail in rails)
        corners = _edge_intersections(legs)
        edges = [_edge_points(leg, *limits.passive) for leg in legs if leg.crossing.turns]
        outline = [*edges, _table_outline(legs)] if corners is None else [corners[[0, 1, 2, 0]]]
        ends = [np.array(leg.crossing.point) for leg in legs] if corners is None else list(corners)
        middles = np.array([rail.mean(axis=0) for rail in rails])
        away = [_outward_normal(leg, middle - middles.mean(axis=0)) for leg, middle in zip(legs, middles, strict=True)]
        everything = np.concatenate([*rails, *outline])
        half = SLEEVE_HALF_LENGTH_SHARE * longest
        return cls(
            anchors=np.array([leg.anchor for leg in legs]),
            rails=rails,
            travel=[_rail_points(leg, *own) for leg, own in zip(legs, ends_of, strict=True)],
            stops=[
                _stop_mark(_rail_points(leg, position), leg.rail_angle, STOP_LENGTH_SHARE * longest)
                for leg, own in zip(legs, ends_of, strict=True)
                for position in own
            ],
            outline=outline,
            edge_stops=[
                _stop_mark(_edge_points(leg, at), leg.crossing.angle, STOP_LENGTH_SHARE * longest)
                for leg in legs
                if leg.crossing.turns
                for at in limits.passive
            ],
            arms=[np.array([np.zeros(2), end]) for end in ends],
            names=middles + 0.07 * longest * np.array(away),
            cross_slides=np.array([(-half, half) if leg.crossing.turns else limits.passive for leg in legs]),
            bounds=np.array([everything.min(axis=0), everything.max(axis=0)]),
        )


def slider_points(geometry: Geometry, position: Points) -> Points:
    """Return the points of the carriages (N, 3, 2) in the base frame for positions lambda_10 of the sliders (N, 3)."""
    at = np.empty((*position.shape, 2))
    for k, leg in enumerate(geometry.each):
        at[:, k] = np.array(leg.anchor) + np.outer(leg.home + position[:, k], _unit_vector(leg.rail_angle))
    return at


def cross_slide_lines(geometry: Geometry, parts: RobotParts, carriages: Points, phi: Points) -> Points:
    """Return the cross slides as lines (N, 3, 2, 2), for points of the carriages (N, 3, 2) and platform angles (N,).

    The sleeve on an edge of the platform (3-PRP) turns with the platform. A cross slide on a carriage (3-PPR) does not
    turn.
    """
    crossings = [leg.crossing for leg in geometry.each]
    angles = np.outer(phi, [each.turns for each in crossings]) + [each.angle for each in crossings]
    along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    lines: Points = carriages[:, :, None] + parts.cross_slides[:, :, None] * along[:, :, None]
    return lines


def pivot_points(geometry: Geometry, carriages: Points, poses: Points) -> Points:
    """Return the positions of the pivots (N, 3, 2) in the base frame.

    In a 3-PRP robot, the pivots are at the points of the carriages (N, 3, 2). In a 3-PPR robot, the pivots are points
    of the platform, which is at `poses` (N, 3).
    """
    at = carriages.copy()
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    for k, leg in enumerate(geometry.each):
        if not leg.crossing.turns:
            u, v = leg.crossing.point
            at[:, k] = poses[:, :2] + np.stack([c * u - s * v, s * u + c * v], axis=1)
    return at


def transform_lines(lines: list[Points], pose: Sequence[float]) -> list[Points]:
    """Transform lines from the platform's frame to the base frame for a pose of the platform."""
    x, y, phi = pose
    c, s = math.cos(phi), math.sin(phi)
    return [line @ np.array([[c, s], [-s, c]]) + [x, y] for line in lines]


def _rail_points(leg: AnyLeg, *positions: float) -> Points:
    return np.array([np.array(leg.anchor) + (leg.home + at) * _unit_vector(leg.rail_angle) for at in positions])


def _edge_points(leg: AnyLeg, *positions: float) -> Points:
    point, angle, _ = leg.crossing
    return np.array([np.array(point) - at * _unit_vector(angle) for at in positions])


def _stop_mark(place: Points, angle: float, length: float) -> Points:
    """Return a mark at the point `place` (1, 2) across a line with the given angle [rad]."""
    across = length / 2.0 * _unit_vector(angle + math.pi / 2.0)
    return np.concatenate([place - across, place + across])


def _outward_normal(leg: AnyLeg, outward: Points) -> Points:
    """Return the unit vector perpendicular to the rail, on the side to which the vector `outward` points."""
    across = _unit_vector(leg.rail_angle + math.pi / 2.0)
    return across if across @ outward >= 0.0 else -across


def _edge_intersections(legs: Sequence[AnyLeg]) -> Points | None:
    """Return the intersections of the platform's edges (3, 2); None if edges are parallel or there are no edges."""
    corners = []
    for one, other in zip(legs, (*legs[1:], legs[0]), strict=True):
        (point, angle, turns), (beyond, other_angle, _) = one.crossing, other.crossing
        sine = math.sin(other_angle - angle)
        if not turns or abs(sine) <= PARALLEL:
            return None
        between = np.array(beyond) - np.array(point)
        along = (between[0] * math.sin(other_angle) - between[1] * math.cos(other_angle)) / sine
        corners.append(np.array(point) + along * _unit_vector(angle))
    return np.array(corners)


def _table_outline(legs: Sequence[AnyLeg]) -> Points:
    """Return the outline of a table as a closed rectangle (5, 2) that covers the centre and the supports."""
    held = np.array([(0.0, 0.0), *(leg.crossing.point for leg in legs)])
    low, high = held.min(axis=0), held.max(axis=0)
    beyond = TABLE_OVERHANG_SHARE * float((high - low).max()) / 2.0
    (left, bottom), (right, top) = low - beyond, high + beyond
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top], [left, bottom]])


def _unit_vector(angle: float) -> Points:
    return np.array([math.cos(angle), math.sin(angle)])
