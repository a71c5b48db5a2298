"""Correction of motions for as-built errors: from the real pose to the pose for which the legs are solved, and back.

The functions are compiled. Motions have the rows pose, velocity, acceleration. `legs` is Geometry.packed(), which also
contains the packed Correction of trirail.kinematics.correction if the robot has a correction.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

from trirail.kinematics.algebra import add, scale, subtract
from trirail.kinematics.arrays import Array, Matrix, Vector
from trirail.kinematics.compiled import compiled
from trirail.kinematics.correction import DEGREE, HEADER_LENGTH, LEG, LEGS

__all__ = ["corrected_motion", "is_corrected", "real_motion"]

MAX_ITERATIONS = 20
"""Greatest number of iterations. If the slope of the correction is below STEEPEST, twelve iterations solve a correction
of 20 mm to the last digit."""
CONVERGED = 1e-15
"""Change per iteration below which the iteration ends [m, rad, s]."""

Four: TypeAlias = tuple[float, float, float, float]


class SplineValues(NamedTuple):
    """Values and first two time derivatives of the four splines of one axis that are not zero at a position.

    `nodes` are the indices of their nodes. Beyond the border, the outermost node is repeated.
    """

    nodes: tuple[int, int, int, int]
    value: Four
    rate: Four
    change: Four


@compiled()
def _along(
    low: float, per_length: float, cells: int, position: float, velocity: float, acceleration: float
) -> SplineValues:
    """Return the splines of an axis at a position. The first cell of the axis begins at `low`."""
    place = (position - low) * per_length
    rate, change = velocity * per_length, acceleration * per_length
    if not -DEGREE <= place <= cells + DEGREE:  # also True for NaN
        place = float(cells + DEGREE) if place > 0.0 else -float(DEGREE)
        rate = change = 0.0
    first = math.floor(place)
    t = place - first
    s = 1.0 - t
    w = s * s * s / 6.0, (4.0 + t * t * (3.0 * t - 6.0)) / 6.0, (4.0 + s * s * (3.0 * s - 6.0)) / 6.0, t * t * t / 6.0
    d = -0.5 * s * s, t * (1.5 * t - 2.0), -s * (1.5 * s - 2.0), 0.5 * t * t
    dd = s, 3.0 * t - 2.0, 3.0 * s - 2.0, t
    square = rate * rate
    last = cells + DEGREE - 1
    return SplineValues(
        (
            min(max(first, 0), last),
            min(max(first + 1, 0), last),
            min(max(first + 2, 0), last),
            min(max(first + 3, 0), last),
        ),
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
    """Return the correction c at a pose, with its first and second time derivatives for a moving pose."""
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
                at = HEADER_LENGTH + 3 * ((x.nodes[i] * of_y + y.nodes[j]) * of_z + z.nodes[k])
                node = numbers[at], numbers[at + 1], numbers[at + 2]
                value = add(value, scale(w * z.value[k], node))
                rate = add(rate, scale(d * z.value[k] + w * z.rate[k], node))
                change = add(change, scale(dd * z.value[k] + 2.0 * d * z.rate[k] + w * z.change[k], node))
    return value, rate, change


@compiled()
def is_corrected(legs: Array) -> bool:
    """Return whether the packed legs contain a correction."""
    return len(legs) > LEGS


@compiled()
def corrected_motion(legs: Array, motion: Matrix) -> Matrix:
    """Return the motion for which the legs must be solved, p + c(p) with its derivatives, for a motion p."""
    more = _correction(legs, motion)
    return add(motion[0], more[0]), add(motion[1], more[1]), add(motion[2], more[2])


@compiled()
def _apart(a: Vector, b: Vector) -> float:
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]), abs(a[2] - b[2]))


@compiled()
def real_motion(legs: Array, of_legs: Matrix) -> Matrix:
    """Return the real motion p of the platform, given the motion q for which the legs were solved.

    The equation p = q - c(p) and its derivatives are solved by iteration.
    """
    motion = of_legs
    for _ in range(MAX_ITERATIONS):
        less = _correction(legs, motion)
        real = subtract(of_legs[0], less[0]), subtract(of_legs[1], less[1]), subtract(of_legs[2], less[2])
        same = max(_apart(real[0], motion[0]), _apart(real[1], motion[1]), _apart(real[2], motion[2])) <= CONVERGED
        motion = real
        if same:
            break
    return motion
