"""What the present pose leaves open: where the centre may go at this φ, and how far φ is from a singularity.

Both are looked up for poses rounded a little and kept, so that a recorder can afford them at any rate.
"""

from __future__ import annotations

import itertools
import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from trirail.config import Limits
from trirail.kinematics.geometry import Geometry, singular_angles
from trirail.workspace.part_positions import Points
from trirail.workspace.workspace import permitted

ANGLE = math.radians(0.5)
"""Workspace outlines are those of multiples of this φ [rad]."""
PLACE = 2e-3
"""Singular angles are those with the centre at multiples of this, in x and y [m]."""
_KEPT = 4096


class Reach:
    """A robot's workspace and singularities."""

    def __init__(self, geometry: Geometry, limits: Limits) -> None:
        self.outline = lru_cache(_KEPT)(lambda step: _outline(geometry, limits, int(step)))
        """The line around the permitted centres at φ = `step` ANGLE: (V + 1, 2) [m], closed; empty for none."""
        self._singular = lru_cache(_KEPT)(
            lambda x, y: np.array(singular_angles(geometry, (x * PLACE, y * PLACE)))[:, np.newaxis]
        )
        # On the symmetric robot the singular angles are the same everywhere, and need to be found only once.
        self._everywhere = all(
            singular_angles(geometry, corner) == singular_angles(geometry)
            for corner in itertools.product(limits.platform.x, limits.platform.y)
        )

    def steps(self, phi: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return which outlines belong to angles [rad]."""
        return np.rint(phi / ANGLE).astype(np.int64)

    def distance(self, poses: Points) -> NDArray[np.float64]:
        """Return by what angle [rad] φ differs from the nearest singular one, (N,), for poses (N, 3)."""
        if self._everywhere:
            return _least(poses[:, 2], self._singular(0, 0))
        found = np.empty(len(poses))
        places = np.rint(poses[:, :2] / PLACE).astype(int)
        for k, (x, y) in enumerate(places.tolist()):
            found[k : k + 1] = _least(poses[k : k + 1, 2], self._singular(x, y))
        return found


def _least(phi: NDArray[np.float64], singular: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the least angle between phi, (N,), and any of the singular angles, (K, 1)."""
    between = phi - singular
    least: NDArray[np.float64] = np.abs(between - math.tau * np.rint(between / math.tau)).min(axis=0)
    return least


def _outline(geometry: Geometry, limits: Limits, step: int) -> Points:
    polygon = permitted(geometry, limits, step * ANGLE)
    return np.concatenate([polygon, polygon[:1]])
