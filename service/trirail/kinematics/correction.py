"""As-built errors: a smooth map from where the platform is to the pose that the legs must be told for that.

At the pose p the legs as configured have to be solved for q = p + c(p). The correction c is a tensor product of uniform
cubic B-splines in x, y and phi: twice differentiable, so that a motion whose acceleration is continuous keeps that, and
with a bound on its slope that its coefficients give. Beyond its box c stays what it is at the border.

Compiled, with motions as rows pose, velocity, acceleration. `legs` is Geometry.packed().
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from trirail.errors import KinematicsError
from trirail.kinematics.algebra import Array, Matrix, Vector, add, scale, subtract
from trirail.kinematics.compiled import compiled

__all__ = ["DEGREE", "STEEPEST", "Correction", "corrected_motion", "is_corrected", "real_motion", "splines"]

DEGREE = 3
"""Of the splines: so many nodes more than cells along each axis."""
STEEPEST = 0.05
"""Share of a motion's velocity that a correction may add: real_motion then gains more than a digit each time round."""
LEGS, LEG = 3, 4 * 13
"""The legs in front of a packed correction, and the numbers of each."""
HEAD = 9
"""Numbers in front of the nodes: where the first cell begins, cells per metre or radian, and how many nodes there are,
along each axis."""
ROUNDS = 20
"""At most; with STEEPEST twelve bring a correction of 20 mm to the last digit."""
SAME = 1e-15
"""Two rounds that differ by less are one [m, rad, s]."""

Four: TypeAlias = tuple[float, float, float, float]


class Along(NamedTuple):
    """The four splines of one axis that are not zero at a place, and how they change as the place moves."""

    first: int
    value: Four
    rate: Four
    change: Four


@compiled()
def _along(low: float, per_length: float, cells: int, position: float, velocity: float, acceleration: float) -> Along:
    """Return the splines at a position on an axis whose first cell begins at `low`."""
    place = (position - low) * per_length
    rate, change = velocity * per_length, acceleration * per_length
    if not 0.0 <= place <= cells:  # nor where it is not a number
        place = float(cells) if place > cells else 0.0
        rate = change = 0.0
    first = min(int(place), cells - 1)
    t = place - first
    s = 1.0 - t
    w = s * s * s / 6.0, (4.0 + t * t * (3.0 * t - 6.0)) / 6.0, (4.0 + s * s * (3.0 * s - 6.0)) / 6.0, t * t * t / 6.0
    d = -0.5 * s * s, t * (1.5 * t - 2.0), -s * (1.5 * s - 2.0), 0.5 * t * t
    dd = s, 3.0 * t - 2.0, 3.0 * s - 2.0, t
    square = rate * rate
    return Along(
        first,
        w,
        (d[0] * rate, d[1] * rate, d[2] * rate, d[3] * rate),
        (
            dd[0] * square + d[0] * change,
            dd[1] * square + d[1] * change,
            dd[2] * square + d[2] * change,
            dd[3] * square + d[3] * change,
        ),
    )


@compiled()
def _correction(legs: Array, motion: Matrix) -> Matrix:
    """Return c at a pose, and its first and second derivative by time as the pose moves."""
    numbers = legs.reshape(-1)[LEGS * LEG :]
    pose, velocity, acceleration = motion
    of_x, of_y, of_z = int(numbers[6]), int(numbers[7]), int(numbers[8])
    x = _along(numbers[0], numbers[3], of_x - DEGREE, pose[0], velocity[0], acceleration[0])
    y = _along(numbers[1], numbers[4], of_y - DEGREE, pose[1], velocity[1], acceleration[1])
    z = _along(numbers[2], numbers[5], of_z - DEGREE, pose[2], velocity[2], acceleration[2])
    value = rate = change = (0.0, 0.0, 0.0)
    for i in range(DEGREE + 1):
        for j in range(DEGREE + 1):
            w = x.value[i] * y.value[j]
            d = x.rate[i] * y.value[j] + x.value[i] * y.rate[j]
            dd = x.change[i] * y.value[j] + 2.0 * x.rate[i] * y.rate[j] + x.value[i] * y.change[j]
            for k in range(DEGREE + 1):
                at = HEAD + 3 * (((x.first + i) * of_y + y.first + j) * of_z + z.first + k)
                node = numbers[at], numbers[at + 1], numbers[at + 2]
                value = add(value, scale(w * z.value[k], node))
                rate = add(rate, scale(d * z.value[k] + w * z.rate[k], node))
                change = add(change, scale(dd * z.value[k] + 2.0 * d * z.rate[k] + w * z.change[k], node))
    return value, rate, change


@compiled()
def is_corrected(legs: Array) -> bool:
    """Whether legs have a correction."""
    return len(legs) > LEGS


@compiled()
def corrected_motion(legs: Array, motion: Matrix) -> Matrix:
    """Return the motion that the legs have to be told, for one of the platform: p + c(p), and its derivatives."""
    more = _correction(legs, motion)
    return add(motion[0], more[0]), add(motion[1], more[1]), add(motion[2], more[2])


@compiled()
def _apart(a: Vector, b: Vector) -> float:
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]), abs(a[2] - b[2]))


@compiled()
def real_motion(legs: Array, told: Matrix) -> Matrix:
    """Return the platform's motion when the legs are told one: p = q - c(p), and its derivatives, by iteration."""
    motion = told
    for _ in range(ROUNDS):
        less = _correction(legs, motion)
        real = subtract(told[0], less[0]), subtract(told[1], less[1]), subtract(told[2], less[2])
        same = max(_apart(real[0], motion[0]), _apart(real[1], motion[1]), _apart(real[2], motion[2])) <= SAME
        motion = real
        if same:
            break
    return motion


def splines(
    poses: Array, low: Sequence[float], high: Sequence[float], cells: Sequence[int]
) -> tuple[Array, NDArray[np.int64]]:
    """Return the value of every spline at poses (N, 3), (N, nodes), and the poses' cells, (N, 3).

    For who looks at a few poses, or at many once.
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
            raise KinematicsError(f"a correction has nodes of shape {nodes.shape}: wanted are (l + 3, m + 3, n + 3, 3)")
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
        """How many cells there are along x, y and phi."""
        l, m, n, _ = self.nodes.shape  # noqa: E741 - as above
        return l - DEGREE, m - DEGREE, n - DEGREE

    @property
    def size(self) -> Array:
        """Of a cell, (3,) [m, m, rad]."""
        return np.subtract(self.high, self.low) / self.cells

    @property
    def bound(self) -> Array:
        """What no correction in x, y and phi is beyond, (3,) [m, m, rad]."""
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
