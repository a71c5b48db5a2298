"""What the present pose leaves open: where the centre may go at this φ, and how far φ is from a singularity.

Both are looked up for poses rounded a little and kept, so that a recorder can afford them at any rate.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from service.config import Limits
from service.geometry import Geometry, singular_angles
from service.mechanism import Points
from service.workspace import permitted

ANGLE = math.radians(0.5)
"""Workspace outlines are those of multiples of this φ [rad]."""
PLACE = 2e-3
"""Singular angles are those with the centre at multiples of this, in x and y [m]."""
EVERY = 10
"""Distances are to the singular angles of every tenth pose: these angles hardly move."""
_KEPT = 4096


class Outlook:
    """A robot's workspace and singularities."""

    def __init__(self, geometry: Geometry, limits: Limits) -> None:
        self.outline = lru_cache(_KEPT)(lambda step: _outline(geometry, limits, int(step)))
        """The line around the permitted centres at φ = `step` ANGLE: (V + 1, 2) [m], closed; empty for none."""
        self._singular = lru_cache(_KEPT)(
            lambda x, y: np.array(singular_angles(geometry, (x * PLACE, y * PLACE)))[:, np.newaxis]
        )

    def steps(self, phi: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return which outlines belong to angles [rad]."""
        return np.rint(phi / ANGLE).astype(np.int64)

    def distance(self, poses: Points) -> NDArray[np.float64]:
        """Return by what angle [rad] φ differs from the nearest singular one, (N,), for poses (N, 3)."""
        found = np.empty(len(poses))
        for start in range(0, len(poses), EVERY):
            some = slice(start, start + EVERY)
            x, y = np.rint(poses[start, :2] / PLACE).astype(int).tolist()
            between = np.abs(poses[some, 2] - self._singular(x, y))
            found[some] = np.abs(between - math.tau * np.rint(between / math.tau)).min(axis=0)
        return found


def _outline(geometry: Geometry, limits: Limits, step: int) -> Points:
    polygon = permitted(geometry, limits, step * ANGLE)
    return np.concatenate([polygon, polygon[:1]])
