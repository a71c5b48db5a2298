"""Time-optimal straight paths in pose space or in slider space."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.closed_forward import LEGS_TYPE, forward_motion
from trirail.kinematics.closure import inverse_motion
from trirail.kinematics.compiled import compiled
from trirail.kinematics.recursion import ZERO
from trirail.motion.paths import ROUNDING, Path, law_at, transfer_to_point
from trirail.motion.time_optimal import END_COEFFICIENTS, limit_excess, minimise_time, spline_states

__all__ = ["time_optimal"]

INTERVALS = 32
"""Number of intervals with constant jerk per path. Ten times as many intervals would shorten a path by only 0.25 %."""
SAMPLE_CELLS = 64
"""Number of cells into which a line is divided. Within a cell, the derivatives of the line are interpolated."""
KNOT_LIMIT_SHARE = 0.999
"""Fraction of the limits that the method may use. The margin covers peaks between the times that are checked."""
INITIAL_SLOWDOWN = 1.01
"""Factor by which the first iterate is slower than a law that just reaches the limits."""


def time_optimal(
    legs: Array,
    path: Path,
    own: Sequence[Sequence[float]],
    others: Sequence[Sequence[float]],
    centre: Array,
    near: Sequence[float],
) -> Path | None:
    """Return the fastest straight path from rest to rest between the ends of a path; None if the method fails.

    The limits are enforced only at discrete times. The result must therefore be checked by Checker, like every path.

    Parameters
    ----------
    legs : Array
        Packed legs of the robot.
    path : Path
        Straight path that defines the line and the first iterate.
    own, others : (3, 3)
        Limits of the coordinates of the path, and of the coordinates of the other space. For a path in pose space, the
        other space is the slider space, and vice versa. Rows are velocity, acceleration, jerk.
    centre : (2, 3)
        Limits of the platform's centre in x and y, used if the path describes another point of the platform.
    near : (3,)
        Pose that selects the branch of the forward kinematics for a path in slider space.
    """
    begin = path.pieces[0, :, 0].copy()
    length = path.end - begin
    square = float((length * length).sum())
    limits = np.empty((6 if len(path.tools) else 4, 3))
    samples = np.empty((SAMPLE_CELLS + 1, len(limits), 2))
    branch = np.array(near, dtype=np.float64)
    tool = path.tools[0] if len(path.tools) else np.zeros(2)
    if math.sqrt(square) <= ROUNDING or _sample_line(legs, begin, length, path.in_sliders, tool, branch, samples):
        return None
    limits[:3] = np.array(others).T
    limits[3] = 1.0 / (np.abs(length) / np.array(own)).max(axis=1)
    limits[4:] = centre[: len(limits) - 4]
    limits *= KNOT_LIMIT_SHARE
    progress = (path.pieces * length[:, None]).sum(axis=1, keepdims=True) / square
    progress[:, :, 0] -= float((begin * length).sum()) / square
    coefficients, step = np.empty(INTERVALS + END_COEFFICIENTS), path.duration / INTERVALS
    _resample(path.knots, progress, step, coefficients)
    step *= INITIAL_SLOWDOWN * limit_excess(samples, limits, coefficients, step)
    step = minimise_time(samples, limits, coefficients, step)
    if not math.isfinite(step):
        return None
    states = np.empty((INTERVALS, 4))
    spline_states(coefficients, step, states)
    slower = max(1.0, _peak_velocity(states, step) / limits[3, 0])
    states /= slower ** np.arange(4.0)
    pieces = np.zeros((INTERVALS, 3, 6))
    pieces[:, :, :4] = (states / (1.0, 1.0, 2.0, 6.0))[:, None] * length[:, None]
    pieces[:, :, 0] += begin
    knots = np.linspace(0.0, INTERVALS * step * slower, INTERVALS + 1)
    return Path(knots, pieces, path.in_sliders, np.tile(path.tools[:1], (INTERVALS, 1)))


def _peak_velocity(states: Array, step: float) -> float:
    """Return the peak velocity of a law, given its states sigma, v, a, j at the start of intervals (n, 4).

    The peak may be within an interval. It must be found here, because Checker does not know the limits of the goal.
    """
    _, v, a, j = states.T
    turn = np.clip(np.divide(-a, j, out=np.zeros_like(a), where=j != 0.0), 0.0, step)
    return float(np.abs(v + a * turn + j * turn**2 / 2.0).max())


@compiled(f"i8({LEGS_TYPE}, f8[::1], f8[::1], b1, f8[::1], f8[::1], f8[:, :, ::1])", allocates=True)
def _sample_line(
    legs: Array, begin: Array, length: Array, in_sliders: bool, tool: Array, near: Array, out: Array
) -> int:
    """Write the first and second derivatives with respect to sigma of all coordinates that have limits.

    These are the coordinates of the other space, sigma itself and, for a path of another point, x and y of the centre.
    Returns 0, or a code of forward_into.
    """
    motion, other = np.zeros((3, 3)), np.empty((6, 3))
    rate = length[0], length[1], length[2]
    cells = len(out) - 1
    for k in range(cells + 1):
        sigma = k / cells
        at = begin[0] + sigma * rate[0], begin[1] + sigma * rate[1], begin[2] + sigma * rate[2]
        if in_sliders:
            code = forward_motion(legs, (at, rate, ZERO), near, other)
            near[:] = other[0]
        else:
            motion[0, 0], motion[0, 1], motion[0, 2] = at
            motion[1] = length
            motion[2] = 0.0
            transfer_to_point(motion, -tool[0], -tool[1])
            code = inverse_motion(legs, motion, other)
        if code:
            return code
        for i in range(3):
            out[k, i, 0], out[k, i, 1] = other[1, i], other[2, i]
        out[k, 3, 0], out[k, 3, 1] = 1.0, 0.0
        for i in range(out.shape[1] - 4):
            out[k, 4 + i, 0], out[k, 4 + i, 1] = motion[1, i], motion[2, i]
    return 0


@compiled("void(f8[::1], f8[:, :, ::1], f8, f8[::1])")
def _resample(knots: Array, pieces: Array, step: float, coefficients: Array) -> None:
    """Write the coefficients of a spline that approximates a law. The spline is exact if one cubic covers two steps."""
    for k in range(len(coefficients)):
        sigma, _, change = law_at(knots, pieces, (k - 1) * step)
        coefficients[k] = sigma - step**2 * change / 6.0
    coefficients[:END_COEFFICIENTS], coefficients[-END_COEFFICIENTS:] = 0.0, 1.0
