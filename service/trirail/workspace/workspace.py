"""The poses within reach: for one phi the exact polygon of the centre G, over phi its extent and volume.

At fixed phi the travel of every joint is linear in x and y, and so is det J2: each limit is a half-plane, and
what they leave is a convex polygon. A half-plane is a row r with r @ (1, x, y) >= 0. A polygon is an array of
vertices (V, 2) [m], anticlockwise; (0, 2) if nothing is left.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from trirail.config import Limits, Range
from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry, travels
from trirail.workspace.aspect import det_j2_rows, range_of_phi

__all__ = ["Extent", "area", "extent", "permitted", "reachable"]

NOTHING = np.empty((0, 2))
TOUCHING = 1e-13  # a vertex nearer than this to the edge of a half-plane is on it [m]
TURNS = np.linspace(-1.0, 1.0, 129)  # where between the two ends of the singularity margin det J2 is looked at
NEAR = 1e-4  # nearer than this to a wall, rounding begins to hide the sign of det J2 [rad]
SMALL = 1e-4  # steps of the centre over which as-built errors count as linear [m]
SLICES = 721  # for the integral over phi
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


class Extent(NamedTuple):
    """A workspace over all phi: extents [m, rad], volume [m² rad], greatest slice, and the area along phi."""

    x: Range
    y: Range
    phi: Range
    volume: float
    best_phi: float
    best_area: float
    angles: Array  # (N,), from one end of phi to the other
    areas: Array  # (N,), of the slices at these angles [m²]


def reachable(geometry: Geometry, limits: Limits, phi: float) -> Array:
    """Return the polygon (V, 2) [m] of all G that the robot itself reaches at this phi.

    Bounds are the travel of the sliders, limits.slider.position, that of the cross slides,
    limits.slider.passive, and the singularity margin: as far as that, the platform can turn
    either way and stay in the aspect of (0, 0, 0). Vertices are exact to rounding, with one exception: where
    det J2 is not monotonic within the margin, as on robots far from symmetric, the true limit is a curve, and
    the polygon circumscribes it, short of the margin by a 64th of it at most.
    """
    phi = math.remainder(phi, 2.0 * math.pi)
    low, high = range_of_phi(geometry)
    margin = limits.singularity_margin
    if not low + margin <= phi <= high - margin:
        return NOTHING
    joints = _joints(geometry, phi)
    positions, passive = limits.slider.positions, limits.slider.passive
    least, most = np.array([*positions, passive, passive, passive]).T
    polygon = _parallelogram(joints[[0, 3]], positions[0], passive)
    unit = np.array([1.0, 0.0, 0.0])
    polygon = _clip(polygon, joints - np.outer(least, unit))
    polygon = _clip(polygon, np.outer(most, unit) - joints)
    # if det J2 is monotonic the two ends decide
    turned = np.clip(phi + margin * TURNS, low + NEAR, high - NEAR)
    sign = np.sign(det_j2_rows(geometry, np.zeros(1))[0, 0])
    return _clip(polygon, sign * det_j2_rows(geometry, turned))


def permitted(geometry: Geometry, limits: Limits, phi: float) -> Array:
    """Return the part of the reachable polygon within limits.platform, the window that the service keeps to."""
    window = limits.platform
    if not window.phi[0] <= phi <= window.phi[1]:
        return NOTHING
    (left, right), (bottom, top) = window.x, window.y
    sides = np.array([[-left, 1.0, 0.0], [right, -1.0, 0.0], [-bottom, 0.0, 1.0], [top, 0.0, -1.0]])
    return _clip(reachable(geometry, limits, phi), sides)


def area(polygon: Array) -> float:
    """Return the area of a polygon [m²]."""
    if len(polygon) == 0:
        return 0.0
    (x, y) = (polygon - polygon[0]).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0


def extent(geometry: Geometry, limits: Limits, section: Callable[[Geometry, Limits, float], Array]) -> Extent:
    """Measure `reachable` or `permitted` over all phi.

    Extents and the greatest slice are found to 1e-9; the volume is an integral by the trapezoidal rule, with
    an error of some 1e-6 of it. KinematicsError if the limits leave no pose.
    """

    def at(phi: float) -> Array:
        return section(geometry, limits, phi)

    scan = np.linspace(*range_of_phi(geometry), 257)
    filled = np.flatnonzero([len(at(phi)) > 0 for phi in scan])
    if len(filled) == 0:
        raise KinematicsError("no pose is within the limits: widen limits.slider, limits.platform or the margin")
    first, last = filled[0], filled[-1]  # never the ends of the scan: they are singular
    angles = np.linspace(
        _last_filled(at, scan[first], scan[first - 1]), _last_filled(at, scan[last], scan[last + 1]), SLICES
    )
    polygons = [at(phi) for phi in angles]

    def greatest(measure: Callable[[Array], float]) -> tuple[float, float]:
        k = int(np.argmax([measure(polygon) for polygon in polygons]))
        return _peak(lambda phi: measure(at(phi)), float(angles[max(k - 1, 0)]), float(angles[min(k + 1, SLICES - 1)]))

    def reach_towards(x: float, y: float) -> float:
        return greatest(lambda polygon: float(np.max(polygon @ [x, y], initial=-math.inf)))[1]

    areas = np.array([area(polygon) for polygon in polygons])
    best_phi, best_area = greatest(area)
    return Extent(
        x=(-reach_towards(-1.0, 0.0), reach_towards(1.0, 0.0)),
        y=(-reach_towards(0.0, -1.0), reach_towards(0.0, 1.0)),
        phi=(float(angles[0]), float(angles[-1])),
        volume=float(np.trapezoid(areas, angles)),
        best_phi=best_phi,
        best_area=best_area,
        angles=angles,
        areas=areas,
    )


def _joints(geometry: Geometry, phi: float) -> Array:
    """Return rows, (6, 3): sliders of legs A, B, C, then their cross slides, each as row @ (1, x, y) [m]."""
    step = 1.0 if geometry.correction is None else SMALL
    at_zero, *beside = travels(geometry, [[0.0, 0.0, phi], [step, 0.0, phi], [0.0, step, phi]]).swapaxes(0, 1)
    slopes = [(there - at_zero) / step for there in beside]
    return np.stack([at_zero, *slopes], axis=-1).reshape(6, 3)


def _parallelogram(joints: Array, position: Range, passive: Range) -> Array:
    """Return what one leg alone reaches, from its rows for slider and cross slide, (2, 3)."""
    (low, high), (inner, outer) = position, passive
    ends = np.array([[low, inner], [high, inner], [high, outer], [low, outer]])
    corners = np.asarray(np.linalg.solve(joints[:, 1:], (ends - joints[:, 0]).T).T, dtype=np.float64)
    return corners if np.linalg.det(joints[:, 1:]) > 0.0 else corners[::-1]


def _clip(polygon: Array, half_planes: Array) -> Array:
    """Return the part of a convex polygon that lies in all half-planes, (K, 3)."""
    values = half_planes[:, 0] + polygon @ half_planes[:, 1:].T
    for offset, *slope in half_planes[(values < -TOUCHING).any(axis=0)]:  # most cut nothing off
        inside = offset + polygon @ slope
        inside[np.abs(inside) < TOUCHING] = 0.0
        if not (inside > 0.0).any():
            return NOTHING
        kept = []
        following = np.arange(1, len(polygon) + 1) % len(polygon)
        for p, q, of_p, of_q in zip(polygon, polygon[following], inside, inside[following], strict=True):
            if of_p >= 0.0:
                kept.append(p)
            if of_p * of_q < 0.0:
                kept.append(p + of_p / (of_p - of_q) * (q - p))
        polygon = np.array(kept)
    return polygon


def _last_filled(at: Callable[[float], Array], filled: float, empty: float) -> float:
    """Return the phi nearest to `empty` at which the slice is not empty, by bisection."""
    while abs(empty - filled) > 1e-12:
        middle = (filled + empty) / 2.0
        filled, empty = (middle, empty) if len(at(middle)) else (filled, middle)
    return float(filled)


def _peak(function: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """Return where a function has its only maximum between two arguments, and its value, by golden section."""
    inner = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    values = function(inner[0]), function(inner[1])
    while high - low > 1e-10:
        if values[0] > values[1]:
            high, inner = inner[1], (inner[1] - GOLDEN * (inner[1] - low), inner[0])
            values = function(inner[0]), values[0]
        else:
            low, inner = inner[0], (inner[1], inner[0] + GOLDEN * (high - inner[0]))
            values = values[1], function(inner[1])
    return max(zip(inner, values, strict=True), key=lambda pair: pair[1])
