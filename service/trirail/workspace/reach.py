"""Reach at a pose: outline of the permitted centres at the φ of the pose, and distance of φ from a singularity.

Both results are cached for rounded poses. A recorder can therefore request them at a high rate.
"""

from __future__ import annotations

import itertools
import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trirail.config import Limits
from trirail.kinematics.geometry import Geometry, singular_angles
from trirail.workspace.part_positions import Points
from trirail.workspace.workspace import permitted_slice

ANGLE_STEP_RAD = math.radians(0.5)
"""Step to which φ is rounded for cached outlines of the workspace [rad]."""
CENTRE_STEP_M = 2e-3
"""Step to which x and y of the centre are rounded for cached singular angles [m]."""
_CACHE_SIZE = 4096


class Reach:
    """Cache of workspace outlines and singular angles of one robot."""

    def __init__(self, geometry: Geometry, limits: Limits) -> None:
        self._phi, self._tolerance = limits.platform.phi, limits.in_position.pose[2]
        self._first, self._last = map(_step, self._phi)
        self.outline = lru_cache(_CACHE_SIZE)(lambda step: _closed_outline(geometry, limits, self._angle(int(step))))
        """Closed outline of the permitted centres at a step of φ, from `outline_indices`, shape (V + 1, 2) [m]. It is
        empty if no centre is permitted."""
        self._singular = lru_cache(_CACHE_SIZE)(
            lambda x, y: np.array(singular_angles(geometry, (x * CENTRE_STEP_M, y * CENTRE_STEP_M)))[:, np.newaxis]
        )
        # The singular angles of a symmetric robot do not depend on the centre, so one computation is enough.
        self._constant_angles = all(
            singular_angles(geometry, corner) == singular_angles(geometry)
            for corner in itertools.product(limits.platform.x, limits.platform.y)
        )

    def outline_indices(self, phi: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the argument `step` of `outline` for each of the given angles [rad].

        An angle beyond its limit by more than the in-position window never has a step that contains the limit.
        """
        low, high = self._phi
        steps = _step(phi)
        steps = np.where(phi < low - self._tolerance, np.minimum(steps, self._first - 1), steps)
        return np.where(phi > high + self._tolerance, np.maximum(steps, self._last + 1), steps)

    def _angle(self, step: int) -> float:
        """Return the permitted angle nearest to the middle of a step [rad], or the middle if none is permitted."""
        low, high = self._phi
        middle = step * ANGLE_STEP_RAD
        return min(max(middle, low), high) if self._first <= step <= self._last else middle

    def singularity_distance(self, poses: Points) -> NDArray[np.float64]:
        """Return the distance of φ from the nearest singular angle [rad], (N,), for poses (N, 3)."""
        if self._constant_angles:
            return _least_angle(poses[:, 2], self._singular(0, 0))
        distances = np.empty(len(poses))
        centres = np.rint(poses[:, :2] / CENTRE_STEP_M).astype(int)
        for k, (x, y) in enumerate(centres.tolist()):
            distances[k : k + 1] = _least_angle(poses[k : k + 1, 2], self._singular(x, y))
        return distances


def _least_angle(phi: NDArray[np.float64], singular: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest angle between each phi (N,) and any of the singular angles (K, 1)."""
    between = phi - singular
    least: NDArray[np.float64] = np.abs(between - math.tau * np.rint(between / math.tau)).min(axis=0)
    return least


def _step(phi: ArrayLike) -> NDArray[np.int64]:
    return np.rint(np.asarray(phi) / ANGLE_STEP_RAD).astype(np.int64)


def _closed_outline(geometry: Geometry, limits: Limits, phi: float) -> Points:
    polygon = permitted_slice(geometry, limits, phi)
    return np.concatenate([polygon, polygon[:1]])
