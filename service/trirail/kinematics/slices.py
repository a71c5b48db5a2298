"""Slices of the workspace at one angle phi, at which the positions of the joints are linear in x and y.

Each limit of a joint therefore defines a half-plane, and the centres G within all limits form a convex polygon. A
half-plane is described by a row r with r @ (1, x, y) >= 0. A polygon is an array of vertices (V, 2) [m] in
anticlockwise order; an empty polygon has the shape (0, 2).
"""

from __future__ import annotations

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry

__all__ = ["EMPTY_POLYGON", "clip", "joint_rows"]

EMPTY_POLYGON = np.empty((0, 2))
EDGE_TOLERANCE_M = 1e-13  # a vertex that is closer to the edge of a half-plane counts as on the edge


def joint_rows(geometry: Geometry, phi: float) -> Array:
    """Return rows (6, 3) with position = row @ (1, x, y) [m] for the sliders A, B, C, then for the cross slides.

    As-built errors are left out.
    """
    x, y, angles = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.full(3, phi)
    at_zero, *beside = np.stack([leg.travels(x, y, angles) for leg in geometry.each], axis=-1).swapaxes(0, 1)
    return np.stack([at_zero, *(there - at_zero for there in beside)], axis=-1).reshape(6, 3)


def clip(polygon: Array, half_planes: Array) -> Array:
    """Return the part of a convex polygon that is inside all half-planes (K, 3)."""
    values = half_planes[:, 0] + polygon @ half_planes[:, 1:].T
    for offset, *slope in half_planes[(values < -EDGE_TOLERANCE_M).any(axis=0)]:  # most half-planes have no effect
        inside = offset + polygon @ slope
        inside[np.abs(inside) < EDGE_TOLERANCE_M] = 0.0
        if not (inside > 0.0).any():
            return EMPTY_POLYGON
        vertices = []
        following = np.arange(1, len(polygon) + 1) % len(polygon)
        for p, q, of_p, of_q in zip(polygon, polygon[following], inside, inside[following], strict=True):
            if of_p >= 0.0:
                vertices.append(p)
            if of_p * of_q < 0.0:
                vertices.append(p + of_p / (of_p - of_q) * (q - p))
        polygon = np.array(vertices)
    return polygon
