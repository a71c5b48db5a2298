"""Workspace: the exact polygon of the possible centres G at an angle phi, and the extent and volume over all phi.

At a fixed phi, the positions of the joints and det J2 are linear in x and y. Each limit therefore defines a half-plane,
and the intersection of all half-planes is a convex polygon, as described in trirail.kinematics.slices.
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
from trirail.kinematics.slices import EMPTY_POLYGON, clip, joint_rows
from trirail.workspace.aspect import det_j2_rows, phi_range

__all__ = ["Extent", "measure_extent", "permitted_slice", "polygon_area", "reachable_slice"]

MARGIN_SAMPLES = np.linspace(-1.0, 1.0, 129)  # angles at which det J2 is sampled, in multiples of the margin
WALL_CLEARANCE_RAD = 1e-4  # closer to a wall, the sign of det J2 is not reliable because of rounding
PHI_SLICES = 721  # number of slices for the integral over phi
GOLDEN_RATIO = (math.sqrt(5.0) - 1.0) / 2.0


class Extent(NamedTuple):
    """Workspace over all phi: ranges [m, rad], volume [m² rad], largest slice, and area as a function of phi."""

    x: Range
    y: Range
    phi: Range
    volume: float
    best_phi: float
    best_area: float
    angles: Array  # (N,), from the lowest phi to the highest [rad]
    areas: Array  # (N,), areas of the slices at these angles [m²]


def reachable_slice(geometry: Geometry, limits: Limits, phi: float) -> Array:
    """Return the polygon (V, 2) [m] of all centres G that the robot can reach at an angle phi.

    The polygon is bounded by the travel of the sliders (limits.slider.position), the travel of the cross slides
    (limits.slider.passive), and the singularity margin. The latter requires that the platform can rotate by the margin
    in both directions without leaving the aspect of (0, 0, 0). The vertices are exact except for rounding, with one
    exception: if det J2 is not monotonic within the margin, as for robots that are far from symmetric, the true
    boundary is a curve. The polygon then circumscribes the curve, with an error of at most a 64th of the margin.

    With as-built errors, the true boundary is a curve as well. The polygon then uses the affine function that fits the
    errors best on the boundary, and is wrong by at most the difference from that function.
    """
    phi = math.remainder(phi, 2.0 * math.pi)
    low, high = phi_range(geometry)
    margin = limits.singularity_margin
    if not low + margin <= phi <= high - margin:
        return EMPTY_POLYGON
    polygon = _within_travels(joint_rows(geometry, phi), limits)
    if geometry.correction is not None and len(polygon):
        polygon = _within_travels(_corrected_rows(geometry, phi, polygon), limits)
    # if det J2 were always monotonic, the two ends of the margin would be sufficient
    turned = np.clip(phi + margin * MARGIN_SAMPLES, low + WALL_CLEARANCE_RAD, high - WALL_CLEARANCE_RAD)
    sign = np.sign(det_j2_rows(geometry, np.zeros(1))[0, 0])
    return clip(polygon, sign * det_j2_rows(geometry, turned))


def permitted_slice(geometry: Geometry, limits: Limits, phi: float) -> Array:
    """Return the part of the reachable polygon within limits.platform, which the service also enforces."""
    window = limits.platform
    if not window.phi[0] <= phi <= window.phi[1]:
        return EMPTY_POLYGON
    (left, right), (bottom, top) = window.x, window.y
    sides = np.array([[-left, 1.0, 0.0], [right, -1.0, 0.0], [-bottom, 0.0, 1.0], [top, 0.0, -1.0]])
    return clip(reachable_slice(geometry, limits, phi), sides)


def polygon_area(polygon: Array) -> float:
    """Return the area of a polygon [m²]."""
    if len(polygon) == 0:
        return 0.0
    (x, y) = (polygon - polygon[0]).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0


def measure_extent(geometry: Geometry, limits: Limits, section: Callable[[Geometry, Limits, float], Array]) -> Extent:
    """Return the extent of the workspace over all phi. `section` is `reachable_slice` or `permitted_slice`.

    The ranges and the largest slice are accurate to 1e-9. The volume is integrated by the trapezoidal rule and has a
    relative error of about 1e-6. Raises KinematicsError if no pose is within the limits.
    """

    def slice_at(phi: float) -> Array:
        return section(geometry, limits, phi)

    low, high = phi_range(geometry)
    # The limits of the platform may be closer together than the samples between the walls. If it is the sliders that
    # allow only a narrow range, this usually contains phi = 0.
    window = np.clip([*np.linspace(*limits.platform.phi, 33), 0.0], low, high)
    scan = np.unique(np.concatenate([np.linspace(low, high, 257), window]))
    filled = np.flatnonzero([len(slice_at(phi)) > 0 for phi in scan])
    if len(filled) == 0:
        raise KinematicsError("no pose is within the limits: widen limits.slider, limits.platform or the margin")
    first, last = filled[0], filled[-1]  # never an end of the scan, because both ends are singular
    angles = np.linspace(
        _last_nonempty_phi(slice_at, scan[first], scan[first - 1]),
        _last_nonempty_phi(slice_at, scan[last], scan[last + 1]),
        PHI_SLICES,
    )
    polygons = [slice_at(phi) for phi in angles]

    def greatest(measure: Callable[[Array], float]) -> tuple[float, float]:
        k = int(np.argmax([measure(polygon) for polygon in polygons]))
        return _golden_section_maximum(
            lambda phi: measure(slice_at(phi)), float(angles[max(k - 1, 0)]), float(angles[min(k + 1, PHI_SLICES - 1)])
        )

    def reach_towards(x: float, y: float) -> float:
        return greatest(lambda polygon: float(np.max(polygon @ [x, y], initial=-math.inf)))[1]

    areas = np.array([polygon_area(polygon) for polygon in polygons])
    best_phi, best_area = greatest(polygon_area)
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


def _corrected_rows(geometry: Geometry, phi: float, polygon: Array) -> Array:
    """Return the rows of `joint_rows` with as-built errors: the best fit along the edges of a polygon (V, 2) [m]."""
    centres = np.concatenate([polygon, (polygon + np.roll(polygon, -1, axis=0)) / 2.0])
    positions = travels(geometry, np.column_stack([centres, np.full(len(centres), phi)])).swapaxes(0, 1)
    known = np.column_stack([np.ones(len(centres)), centres])
    rows, *_ = np.linalg.lstsq(known, positions.reshape(-1, 6))
    return np.asarray(rows.T, dtype=np.float64)


def _within_travels(joints: Array, limits: Limits) -> Array:
    """Return the polygon in which all joints, with rows (6, 3), are within their travels."""
    positions, passive = limits.slider.positions, limits.slider.passive
    least, most = np.array([*positions, passive, passive, passive]).T
    polygon = _parallelogram(joints[[0, 3]], positions[0], passive)
    unit = np.array([1.0, 0.0, 0.0])
    polygon = clip(polygon, joints - np.outer(least, unit))
    return clip(polygon, np.outer(most, unit) - joints)


def _parallelogram(joints: Array, position: Range, passive: Range) -> Array:
    """Return the polygon that one leg alone can reach. `joints` (2, 3) are the rows of its slider and cross slide."""
    (low, high), (inner, outer) = position, passive
    ends = np.array([[low, inner], [high, inner], [high, outer], [low, outer]])
    corners = np.asarray(np.linalg.solve(joints[:, 1:], (ends - joints[:, 0]).T).T, dtype=np.float64)
    return corners if np.linalg.det(joints[:, 1:]) > 0.0 else corners[::-1]


def _last_nonempty_phi(slice_at: Callable[[float], Array], nonempty: float, empty: float) -> float:
    """Return the phi closest to `empty` at which the slice is not empty, found by bisection."""
    while abs(empty - nonempty) > 1e-12:
        middle = (nonempty + empty) / 2.0
        nonempty, empty = (middle, empty) if len(slice_at(middle)) else (nonempty, middle)
    return float(nonempty)


def _golden_section_maximum(function: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """Return argument and value of the maximum of a unimodal function in an interval, by golden-section search."""
    inner = high - GOLDEN_RATIO * (high - low), low + GOLDEN_RATIO * (high - low)
    values = function(inner[0]), function(inner[1])
    while high - low > 1e-10:
        if values[0] > values[1]:
            high, inner = inner[1], (inner[1] - GOLDEN_RATIO * (inner[1] - low), inner[0])
            values = function(inner[0]), values[0]
        else:
            low, inner = inner[0], (inner[1], inner[0] + GOLDEN_RATIO * (high - inner[0]))
            values = values[1], function(inner[1])
    return max(zip(inner, values, strict=True), key=lambda pair: pair[1])
