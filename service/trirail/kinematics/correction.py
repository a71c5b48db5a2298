"""Smooth map of as-built errors, from the real pose of the platform to the pose that the legs are solved for.

At the pose p the legs as configured have to be solved for q = p + c(p). The correction c is a tensor product of uniform
cubic B-splines in x, y and phi: twice differentiable, so that a motion whose acceleration is continuous keeps that, and
with a bound on its slope that its coefficients give. Beyond its box c stays what it is at the border.

trirail.kinematics.corrected has the same compiled, for motions.
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
"""Degree of the splines: along each axis they have this many nodes more than cells."""
STEEPEST = 0.05
"""Share of a motion's velocity that a correction may add: real_motion then gains more than a digit per iteration."""
LEGS, LEG = 3, 4 * 13
"""The legs in front of a packed correction, and the numbers of each."""
HEADER_LENGTH = 9
"""Numbers in front of the nodes: where the first cell begins, cells per metre or radian, and how many nodes there are,
along each axis."""


def splines(
    poses: Array, low: Sequence[float], high: Sequence[float], cells: Sequence[int]
) -> tuple[Array, NDArray[np.int64]]:
    """Return the value of every spline at poses (N, 3), (N, nodes), and the poses' cells, (N, 3).

    For a few poses, or for many at a time; the cycle uses the compiled trirail.kinematics.corrected.
    """
    rows, at = np.ones((len(poses), 1)), np.zeros((len(poses), 3), dtype=np.int64)
    for axis, (begin, end, number) in enumerate(zip(low, high, cells, strict=True)):
        place = np.clip((poses[:, axis] - begin) / (end - begin) * number, 0.0, number)
        at[:, axis] = np.minimum(place.astype(np.int64), number - 1)
        t = place - at[:, axis]
        s = 1.0 - t
        values = np.stack([s**3, 4.0 - 6.0 * t**2 + 3.0 * t**3, 4.0 - 6.0 * s**2 + 3.0 * s**3, t**3], axis=1) / 6.0
        along = np.zeros((len(poses), number + DEGREE))
        np.put_along_axis(along, at[:, axis, None] + np.arange(DEGREE + 1), values, axis=1)
        rows = (rows[:, :, None] * along[:, None, :]).reshape(len(poses), -1)
    return rows, at


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The map: its box, x, y [m] and phi [rad], and the coefficients of its splines [m, m, rad].

    `nodes` has shape (l + 3, m + 3, n + 3, 3) for l, m and n cells of equal size along x, y and phi. KinematicsError if
    there is no cell, if a number is not finite, or if the box has no inside.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    nodes: Array

    def __post_init__(self) -> None:
        nodes = np.array(self.nodes, dtype=np.float64)
        if nodes.ndim != 4 or nodes.shape[3] != 3 or min(nodes.shape[:3]) <= DEGREE:
            raise KinematicsError(f"a correction has nodes of shape {nodes.shape}: expected (l + 3, m + 3, n + 3, 3)")
        if not (np.isfinite(nodes).all() and all(map(math.isfinite, (*self.low, *self.high)))):
            raise KinematicsError("a correction has a number that is not finite")
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise KinematicsError("a correction's box has no inside")
        nodes.setflags(write=False)
        object.__setattr__(self, "nodes", nodes)

    def packed(self) -> Array:
        """Return it as compiled code takes it, behind the legs: as many numbers as some legs have."""
        numbers = np.concatenate([self.low, 1.0 / self.size, self.nodes.shape[:3], self.nodes.ravel()])
        return np.concatenate([numbers, np.zeros(-len(numbers) % LEG)])

    def at(self, poses: Array) -> Array:
        """Return c at poses, both (N, 3) [m, m, rad]."""
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
        """Upper bound of the correction in x, y and phi, (3,) [m, m, rad]."""
        bound: Array = np.abs(self.nodes).max(axis=(0, 1, 2))
        return bound

    @property
    def greatest(self) -> Array:
        """The greatest correction in x, y and phi at the corners of the cells, (3,) [m, m, rad]."""
        at = self.nodes
        for axis in range(3):
            before, here, after = (np.take(at, range(k, at.shape[axis] - 2 + k), axis) for k in range(3))
            at = (before + 4.0 * here + after) / 6.0
        greatest: Array = np.abs(at).max(axis=(0, 1, 2))
        return greatest

    def adds(self, velocity: Sequence[float]) -> Array:
        """Return bounds on what it adds to a pose's velocity in each cell, (l, m, n, 3), where that is at most given.

        A spline's derivative is a spline whose coefficients are differences of these, and is nowhere beyond the
        greatest of those that count in a cell.
        """
        total = np.zeros((*self.cells, 3))
        for axis, most in enumerate(velocity):
            window = [DEGREE + 1] * 3
            window[axis] -= 1
            slopes = np.abs(np.diff(self.nodes, axis=axis)) / self.size[axis]
            total += most * sliding_window_view(slopes, window, axis=(0, 1, 2)).max(axis=(-3, -2, -1))
        return total
