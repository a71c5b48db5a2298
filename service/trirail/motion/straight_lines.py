"""Straight paths, in pose space or in slider space, made as fast as platform and sliders allow."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.closed_forward import LEGS_TYPE, forward_motion
from trirail.kinematics.closure import inverse_motion
from trirail.kinematics.compiled import compiled
from trirail.kinematics.recursion import ZERO
from trirail.motion.paths import ROUNDING, Path, law_at, transfer
from trirail.motion.time_optimal import FIXED, minimise_time, spline_states, too_fast

__all__ = ["time_optimal"]

INTERVALS = 32
"""In which jerk is constant: with ten times as many a way takes a quarter of a percent less."""
CELLS = 64
"""Of a line, between whose ends its derivatives are interpolated."""
BETWEEN = 0.999
"""Share of the limits that is made use of at the ends of intervals: the rest is for what lies between."""
START = 1.01
"""How many times slower than just within limits the search begins."""


def time_optimal(
    legs: Array,
    path: Path,
    own: Sequence[Sequence[float]],
    others: Sequence[Sequence[float]],
    centre: Array,
    near: Sequence[float],
) -> Path | None:
    """Return the fastest straight way from rest where a path begins to rest where it ends; None where there is none.

    Rows velocity, acceleration and jerk (3, 3) limit the coordinates in which the path is given, `own`, and those of
    the other space, `others`: platform or sliders; `centre` (2, 3) those of the platform's centre in x and y, where
    the path is that of another point. `near` is a pose on the branch of a path in slider space. The limits are held at
    some moments only: the way is to be looked at, as every path is.
    """
    begin = path.pieces[0, :, 0].copy()
    length = path.end - begin
    square = float((length * length).sum())
    limits = np.empty((6 if len(path.tools) else 4, 3))
    samples = np.empty((CELLS + 1, len(limits), 2))
    branch = np.array(near, dtype=np.float64)
    tool = path.tools[0] if len(path.tools) else np.zeros(2)
    if math.sqrt(square) <= ROUNDING or _sample(legs, begin, length, path.in_sliders, tool, branch, samples):
        return None
    limits[:3] = np.array(others).T
    limits[3] = 1.0 / (np.abs(length) / np.array(own)).max(axis=1)
    limits[4:] = centre[: len(limits) - 4]
    limits *= BETWEEN
    behind = (path.pieces * length[:, None]).sum(axis=1, keepdims=True) / square
    behind[:, :, 0] -= float((begin * length).sum()) / square
    coefficients, step = np.empty(INTERVALS + FIXED), path.duration / INTERVALS
    _resample(path.knots, behind, step, coefficients)
    step *= START * too_fast(samples, limits, coefficients, step)
    step = minimise_time(samples, limits, coefficients, step)
    if not math.isfinite(step):
        return None
    states = np.empty((INTERVALS, 4))
    spline_states(coefficients, step, states)
    slower = max(1.0, _fastest(states, step) / limits[3, 0])
    states /= slower ** np.arange(4.0)
    pieces = np.zeros((INTERVALS, 3, 6))
    pieces[:, :, :4] = (states / (1.0, 1.0, 2.0, 6.0))[:, None] * length[:, None]
    pieces[:, :, 0] += begin
    knots = np.linspace(0.0, INTERVALS * step * slower, INTERVALS + 1)
    return Path(knots, pieces, path.in_sliders, np.tile(path.tools[:1], (INTERVALS, 1)))


def _fastest(states: Array, step: float) -> float:
    """Return the greatest velocity of a law from its states, v, a, j after sigma, at the beginning of intervals.

    It may be within an interval, and a goal's own limits are known to nobody who looks at the path later.
    """
    _, v, a, j = states.T
    turn = np.clip(np.divide(-a, j, out=np.zeros_like(a), where=j != 0.0), 0.0, step)
    return float(np.abs(v + a * turn + j * turn**2 / 2.0).max())


@compiled(f"i8({LEGS_TYPE}, f8[::1], f8[::1], b1, f8[::1], f8[::1], f8[:, :, ::1])")
def _sample(legs: Array, begin: Array, length: Array, in_sliders: bool, tool: Array, near: Array, out: Array) -> int:
    """Write how the other space's coordinates, sigma itself and a tool path's centre change with sigma.

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
            transfer(motion, -tool[0], -tool[1])
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
    """Write the coefficients of a spline like a law: the same where the law is one cubic for as long as two steps."""
    for k in range(len(coefficients)):
        sigma, _, change = law_at(knots, pieces, (k - 1) * step)
        coefficients[k] = sigma - step**2 * change / 6.0
    coefficients[:FIXED], coefficients[-FIXED:] = 0.0, 1.0
