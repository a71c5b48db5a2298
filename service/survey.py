"""What a path, run by a law, asks of the sliders: looked at along its whole length, compiled."""

from __future__ import annotations

import math

import numpy as np

from service.algebra import Array
from service.closure import LEGS, forward_motion, inverse_motion
from service.compiled import compiled
from service.paths import HALVINGS, ROUNDING, motion_at, reached

__all__ = ["survey"]

NEAR = 1e-3
"""How near a limit a position may turn without being looked at [m, rad]."""


@compiled()
def _moments(
    knots: Array, law_knots: Array, law_pieces: Array, first: float, until: float, even: int, step: float
) -> Array:
    """Return when to look at a path, ascending: evenly, and over the step before and the one after every knot.

    Jerk is greatest next to a knot, of the path or of the law, and may be so for a short time only. Its mean over
    a step across a knot lies between the means over the steps that end and begin there.
    """
    times = np.empty(even + 2 * (len(knots) + len(law_knots)))
    for k in range(even):
        times[k] = first + (until - first) * k / (even - 1)
    n = even
    for k in range(len(knots) + len(law_knots)):
        knot = reached(law_knots, law_pieces, knots[k], until) if k < len(knots) else law_knots[k - len(knots)]
        for time in (knot - step, knot):
            if first <= time <= until:
                times[n] = time
                n += 1
    return np.sort(times[:n])


@compiled()
def _quantity(motion: Array, sliders: Array, i: int) -> tuple[float, float]:
    """Return one of the nine limited positions, x, y, phi, lambda_10 and lambda_32, and its velocity."""
    if i < 3:
        return motion[0, i], motion[1, i]
    if i < 6:
        return sliders[0, i - 3], sliders[1, i - 3]
    return sliders[3, i - 6], sliders[4, i - 6]


@compiled()
def _look(
    legs: Array,
    knots: Array,
    pieces: Array,
    in_sliders: bool,
    law_knots: Array,
    law_pieces: Array,
    time: float,
    near: Array,
    box: Array,
    motion: Array,
    sliders: Array,
) -> bool:
    """Write platform and sliders at a time of the law; whether they are within reach."""
    motion_at(knots, pieces, law_knots, law_pieces, time, motion)
    if in_sliders:
        targets = motion.copy()
        if forward_motion(legs, targets, near, motion) != 0:
            return False
        near[:] = motion[0]
    if inverse_motion(legs, motion, sliders) != 0:
        return False
    for i in range(9):
        column = i if i < 3 else 2 + i // 3
        position, _ = _quantity(motion, sliders, i)
        if not box[0, column] - ROUNDING <= position <= box[1, column] + ROUNDING:
            return False
    return True


@compiled(
    f"f8({LEGS}, f8[::1], f8[:, :, ::1], b1, f8[::1], f8[:, :, ::1], f8, f8, i8, f8, f8[::1], f8[:, ::1], f8[::1])"
)
def survey(
    legs: Array,
    knots: Array,
    pieces: Array,
    in_sliders: bool,
    law_knots: Array,
    law_pieces: Array,
    first: float,
    until: float,
    even: int,
    step: float,
    start: Array,
    box: Array,
    worst: Array,
) -> float:
    """Look at a path, run by a law, between two times; write the sliders' greatest velocity, acceleration and jerk.

    It is looked at `even` times, at its knots, and where a position turns near its limit. Jerk is the change of
    acceleration over a `step` [s], as the drives see it. `start` is the pose at the first time. `box` (2, 5) holds
    the limits, low and high, of x, y, phi, lambda_10 and lambda_32. Returns when it is first out of reach, else
    not a number; `worst` (3,) means nothing where it is.
    """
    times = _moments(knots, law_knots, law_pieces, first, until, even, step)
    motion, sliders, near = np.empty((2, 3, 3)), np.empty((2, 6, 3)), start.copy()
    last_motion, last_sliders, last = np.empty((3, 3)), np.empty((6, 3)), math.inf
    worst[:] = 0.0
    beyond = math.nan
    for k in range(len(times)):
        if abs(times[k] - last) < ROUNDING:
            motion[0], sliders[0] = last_motion, last_sliders
        elif not _look(
            legs, knots, pieces, in_sliders, law_knots, law_pieces, times[k], near, box, motion[0], sliders[0]
        ):
            beyond = times[k]
            break
        for i in range(9):
            column = i if i < 3 else 2 + i // 3
            before, leaving = _quantity(last_motion, last_sliders, i)
            _, coming = _quantity(motion[0], sliders[0], i)
            if times[k] - last < step or leaving * coming >= 0.0:
                continue
            # It has turned in between: about here, were the acceleration constant.
            turn = before + leaving * leaving / (leaving - coming) * (times[k] - last) / 2.0
            if box[0, column] + NEAR <= turn <= box[1, column] - NEAR:
                continue
            low, high = last, times[k]
            for _ in range(HALVINGS // 3):
                middle = (low + high) / 2.0
                if not _look(
                    legs, knots, pieces, in_sliders, law_knots, law_pieces, middle, near, box, motion[1], sliders[1]
                ):
                    beyond = middle
                    break
                _, velocity = _quantity(motion[1], sliders[1], i)
                if velocity * leaving > 0.0:
                    low = middle
                else:
                    high = middle
        if not math.isnan(beyond):
            break
        last = times[k] + step
        if not _look(legs, knots, pieces, in_sliders, law_knots, law_pieces, last, near, box, motion[1], sliders[1]):
            beyond, last = last, times[k]
            break
        last_motion[:], last_sliders[:] = motion[1], sliders[1]
        for i in range(3):
            worst[0] = max(worst[0], abs(sliders[0, 1, i]))
            worst[1] = max(worst[1], abs(sliders[0, 2, i]))
            worst[2] = max(worst[2], abs(sliders[1, 2, i] - sliders[0, 2, i]) / step)
    if not math.isnan(beyond):
        low = min(last, beyond)
        for _ in range(HALVINGS // 3):
            middle = (low + beyond) / 2.0
            if _look(legs, knots, pieces, in_sliders, law_knots, law_pieces, middle, near, box, motion[1], sliders[1]):
                low = middle
            else:
                beyond = middle
    return beyond
