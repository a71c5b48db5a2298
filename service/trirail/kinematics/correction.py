"""Smooth map of as-built errors, from the real pose of the platform to the pose for which the legs are solved.

To bring the platform to the real pose p, the configured legs must be solved for q = p + c(p). The correction c is a
tensor product of uniform cubic B-splines in x, y and phi. The splines are twice differentiable, so that accelerations
remain continuous. Bounds on the slope of c follow from the coefficients. Outside its box, the outermost nodes are
repeated: c remains twice differentiable, keeps its bounds, and is constant from DEGREE cells outside the box.

trirail.kinematics.corrected has compiled functions that apply a correction to motions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array

__all__ = ["DEGREE", "HEADER_LENGTH", "LEG", "LEGS", "STEEPEST", "Correction", "splines"]

DEGREE = 3
"""Degree of the splines. Along each axis, the number of nodes is the number of cells plus the degree."""
STEEPEST = 0.05
"""Greatest velocity that a correction may add, as a fraction of the velocity of the motion. With this limit,
real_motion gains more than one digit per iteration."""
LEGS, LEG = 3, 4 * 13
"""Number of packed legs before a packed correction, and number of values per leg."""
HEADER_LENGTH = 9
"""Number of values before the nodes in a packed correction: the starts of the first cells along x, y and phi, the cells
per metre or radian, and the numbers of nodes."""


def splines(
    poses: Array, low: Sequence[float], high: Sequence[float], cells: Sequence[int]
) -> tuple[Array, NDArray[np.int64]]:
    """Return the values of all splines at poses (N, 3) as (N, nodes), and the indices of the nearest cells, (N, 3).

    This function uses numpy and is not for use in the cycle, which uses the compiled trirail.kinematics.corrected.
    """
    rows, at = np.ones((len(poses), 1)), np.zeros((len(poses), 3), dtype=np.int64)
    for axis, (begin, end, number) in enumerate(zip(low, high, cells, strict=True)):
        place = np.clip((poses[:, axis] - begin) / (end - begin) * number, -DEGREE, number + DEGREE)
        first = np.floor(place).astype(np.int64)
        at[:, axis] = np.clip(first, 0, number - 1)
        t = place - first
        s = 1.0 - t
        values = np.stack([s**3, 4.0 - 6.0 * t**2 + 3.0 * t**3, 4.0 - 6.0 * s**2 + 3.0 * s**3, t**3], axis=1) / 6.0
        along = np.zeros((len(poses), number + DEGREE))
        nodes = np.clip(first[:, None] + np.arange(DEGREE + 1), 0, number + DEGREE - 1)
        np.add.at(along, (np.arange(len(poses))[:, None], nodes), values)
        rows = (rows[:, :, None] * along[:, None, :]).reshape(len(poses), -1)
    return rows, at


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Correction map for as-built errors.

    `low` and `high` are the limits of the box in x, y [m] and phi [rad]. `nodes` are the coefficients of the splines
    [m, m, rad], with shape (l + 3, m + 3, n + 3, 3) for l, m and n cells of equal size along x, y and phi. Raises
    KinematicsError if there is no cell, if a number is not finite, or if the box is empty.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    nodes: Array

    def __post_init__(self) -> None:
        nodes = np.array(self.nodes, dtype=np.float64)
        if nodes.ndim != 4 or nodes.shape[3] != 3 or min(nodes.shape[:3]) <= DEGREE:
            raise KinematicsError(f"a correction has nodes of shape {nodes.shape}: expected (l + 3, m + 3, n + 3, 3)")
        if not (np.isfinite(nodes).all() and all(map(math.isfinite, (*self.low, *self.high)))):
            raise KinematicsError("a correction contains a number that is not finite")
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise KinematicsError("the box of a correction is empty")
        nodes.setflags(write=False)
        object.__setattr__(self, "nodes", nodes)

    def packed(self) -> Array:
        """Return the correction as an array for compiled code, padded to the size of a whole number of packed legs."""
        numbers = np.concatenate([self.low, 1.0 / self.size, self.nodes.shape[:3], self.nodes.ravel()])
        return np.concatenate([numbers, np.zeros(-len(numbers) % LEG)])

    def at(self, poses: Array) -> Array:
        """Return the corrections c at poses; the arrays are (N, 3) [m, m, rad]."""
        return splines(poses, self.low, self.high, self.cells)[0] @ self.nodes.reshape(-1, 3)

    @property
    def cells(self) -> tuple[int, int, int]:
        """Number of cells along x, y and phi."""
        l, m, n, _ = self.nodes.shape  # noqa: E741 - as above
        return l - DEGREE, m - DEGREE, n - DEGREE

    @property
    def size(self) -> Array:
        """Size of a cell, (3,) [m, m, rad]."""
        return np.subtract(self.high, self.low) / self.cells

    @property
    def bound(self) -> Array:
        """Upper bound of the absolute correction in x, y and phi at any pose, (3,) [m, m, rad]."""
        bound: Array = np.abs(self.nodes).max(axis=(0, 1, 2))
        return bound

    @property
    def greatest(self) -> Array:
        """Greatest absolute correction in x, y and phi at the corners of the cells, (3,) [m, m, rad]."""
        at = self.nodes
        for axis in range(3):
            before, here, after = (np.take(at, range(k, at.shape[axis] - 2 + k), axis) for k in range(3))
            at = (before + 4.0 * here + after) / 6.0
        greatest: Array = np.abs(at).max(axis=(0, 1, 2))
        return greatest

    def adds(self, velocity: Sequence[float]) -> Array:
        """Return upper bounds of the velocity that the correction adds in each cell, (l, m, n, 3).

        `velocity` is the greatest velocity in x, y and phi. The derivative of a spline is again a spline. Its
        coefficients are proportional to the differences of successive nodes. In a cell, the derivative never exceeds
        the greatest of the coefficients that affect the cell.
        """
        total = np.zeros((*self.cells, 3))
        for axis, most in enumerate(velocity):
            window = [DEGREE + 1] * 3
            window[axis] -= 1
            slopes = np.abs(np.diff(self.nodes, axis=axis)) / self.size[axis]
            total += most * sliding_window_view(slopes, window, axis=(0, 1, 2)).max(axis=(-3, -2, -1))
        return total
