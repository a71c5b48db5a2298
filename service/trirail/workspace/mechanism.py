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
from trirail.kinematics.geometry import PARALLEL, Geometry, Leg

Points = NDArray[np.float64]
STOP = 0.022
"""Length of an end stop's mark, as a share of the longest rail."""
SLEEVE = 0.035
"""Half the length of the sleeve in which an edge of the platform slides, likewise."""


@dataclass(frozen=True, slots=True, eq=False)
class Mechanism:
    """The robot's parts; a line is an array of points, (N, 2)."""

    anchors: Points
    """(3, 2): where the rails begin."""
    rails: list[Points]
    travel: list[Points]
    """Where on its rail each slider may be."""
    stops: list[Points]
    """Marks across both ends of each travel."""
    outline: list[Points]
    """The platform's edges: one closed triangle, or three separate edges if two of them are parallel."""
    edge_stops: list[Points]
    """Marks across both ends of the passive joints' travel along the edges."""
    arms: list[Points]
    """From the platform's centre to its corners."""
    names: Points
    """(3, 2): beside the middle of each rail, outside."""
    sleeve: float
    """Half the length of a passive joint's sleeve [m]."""
    bounds: Points
    """(2, 2): lowest and highest x and y of everything at the pose (0, 0, 0)."""

    @classmethod
    def of(cls, geometry: Geometry, limits: SliderLimits) -> Mechanism:
        """Lay out a robot's parts."""
        low, high = limits.position
        legs = geometry.legs
        # a rail reaches as far beyond its slider's travel as it begins before it
        rails = [_on_rail(leg, -leg.home, high + (low + leg.home)) for leg in legs]
        longest = max(float(np.linalg.norm(rail[1] - rail[0])) for rail in rails)
        corners = _corners(legs)
        outline = [_on_edge(leg, *limits.passive) for leg in legs] if corners is None else [corners[[0, 1, 2, 0]]]
        ends = [edge[0] for edge in outline] if corners is None else list(corners)
        middles = np.array([rail.mean(axis=0) for rail in rails])
        away = [_away(leg, middle - middles.mean(axis=0)) for leg, middle in zip(legs, middles, strict=True)]
        everything = np.concatenate([*rails, *outline])
        return cls(
            anchors=np.array([leg.anchor for leg in legs]),
            rails=rails,
            travel=[_on_rail(leg, low, high) for leg in legs],
            stops=[_across(leg, position, STOP * longest) for leg in legs for position in (low, high)],
            outline=outline,
            edge_stops=[_across_edge(leg, at, STOP * longest) for leg in legs for at in limits.passive],
            arms=[np.array([np.zeros(2), end]) for end in ends],
            names=middles + 0.07 * longest * np.array(away),
            sleeve=SLEEVE * longest,
            bounds=np.array([everything.min(axis=0), everything.max(axis=0)]),
        )


def sliders(geometry: Geometry, position: Points) -> Points:
    """Return where the sliders are, (N, 3, 2), for positions lambda_10, (N, 3)."""
    at = np.empty((*position.shape, 2))
    for k, leg in enumerate(geometry.legs):
        at[:, k] = np.array(leg.anchor) + np.outer(leg.home + position[:, k], _u(leg.rail_angle))
    return at


def sleeves(geometry: Geometry, centres: Points, phi: Points, half: float) -> Points:
    """Return the sleeves of the passive joints as lines, (N, 3, 2, 2), around sliders (N, 3, 2) for angles (N,)."""
    angles = phi[:, None] + [leg.edge_angle for leg in geometry.legs]
    along = half * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.stack([centres - along, centres + along], axis=2)


def placed(lines: list[Points], pose: Sequence[float]) -> list[Points]:
    """Return lines of the platform's frame in the base frame, for the platform at a pose."""
    x, y, phi = pose
    c, s = math.cos(phi), math.sin(phi)
    return [line @ np.array([[c, s], [-s, c]]) + [x, y] for line in lines]


def _on_rail(leg: Leg, *positions: float) -> Points:
    return np.array([np.array(leg.anchor) + (leg.home + at) * _u(leg.rail_angle) for at in positions])


def _on_edge(leg: Leg, *positions: float) -> Points:
    return np.array([np.array(leg.edge_point) - at * _u(leg.edge_angle) for at in positions])


def _across(leg: Leg, position: float, length: float) -> Points:
    across = length / 2.0 * _u(leg.rail_angle + math.pi / 2.0)
    (middle,) = _on_rail(leg, position)
    return np.array([middle - across, middle + across])


def _across_edge(leg: Leg, position: float, length: float) -> Points:
    across = length / 2.0 * _u(leg.edge_angle + math.pi / 2.0)
    (middle,) = _on_edge(leg, position)
    return np.array([middle - across, middle + across])


def _away(leg: Leg, outward: Points) -> Points:
    """Return the unit vector across the rail on the side of `outward`."""
    across = _u(leg.rail_angle + math.pi / 2.0)
    return across if across @ outward >= 0.0 else -across


def _corners(legs: tuple[Leg, Leg, Leg]) -> Points | None:
    """Return where each edge meets the next, (3, 2), or None where two never do."""
    corners = []
    for leg, other in zip(legs, (*legs[1:], legs[0]), strict=True):
        sine = math.sin(other.edge_angle - leg.edge_angle)
        if abs(sine) <= PARALLEL:
            return None
        between = np.array(other.edge_point) - np.array(leg.edge_point)
        along = (between[0] * math.sin(other.edge_angle) - between[1] * math.cos(other.edge_angle)) / sine
        corners.append(np.array(leg.edge_point) + along * _u(leg.edge_angle))
    return np.array(corners)


def _u(angle: float) -> Points:
    return np.array([math.cos(angle), math.sin(angle)])
