"""What a path, run by a law, asks of sliders and platform: looked at along its whole length, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.closed_forward import LEGS_TYPE
from trirail.kinematics.closure import inverse_motion
from trirail.kinematics.compiled import compiled
from trirail.motion.paths import HALVINGS, ROUNDING, law_at, platform_at, reached, tool_at, transfer

__all__ = ["survey"]

NEAR = 1e-3
"""How near a limit a position may turn without being looked at [m, rad]."""
EQUAL = (1.0, 1.0, 1.0)
WITHIN = 4
"""Parts of every piece of a path at whose ends it is looked at."""


@compiled()
def _add(times: Array, n: int, time: float, first: float, until: float) -> int:
    """Put a time behind the first n if it is between two others; return how many there are."""
    if first <= time <= until:
        times[n] = time
        n += 1
    return n


@compiled()
def _moments(
    knots: Array, law_knots: Array, law_pieces: Array, first: float, until: float, even: int, step: float
) -> Array:
    """Return when to look at a path, ascending: evenly, within every piece, and on both sides of every knot.

    Jerk is greatest next to a knot, of the path or of the law, and may be so for a short time only. Its mean over
    a step across a knot lies between the means over the steps that end and begin there.
    """
    times = np.empty(even + (WITHIN + 1) * len(knots) + 2 * len(law_knots))
    for k in range(even):
        times[k] = first + (until - first) * k / (even - 1)
    n = even
    begin = law_at(law_knots, law_pieces, first)[0]
    end = law_at(law_knots, law_pieces, until)[0]
    for k in range(len(knots)):
        for part in range(WITHIN if k < len(knots) - 1 else 1):
            s = knots[k]
            if part:
                s += (knots[k + 1] - knots[k]) * part / WITHIN
            if begin <= s <= end:
                time = reached(law_knots, law_pieces, s, until)
                n = _add(times, n, time, first, until)
                if not part:
                    n = _add(times, n, time - step, first, until)
    for knot in law_knots:
        n = _add(times, n, knot, first, until)
        n = _add(times, n, knot - step, first, until)
    return np.sort(times[:n])


@compiled()
def _quantity(motion: Array, sliders: Array, i: int) -> tuple[float, float]:
    """Return one of the nine limited positions, x, y, phi, of the sliders and of the cross slides, and its velocity."""
    if i < 3:
        return motion[0, i], motion[1, i]
    if i < 6:
        return sliders[0, i - 3], sliders[1, i - 3]
    return sliders[3, i - 6], sliders[4, i - 6]


class Way(NamedTuple):
    """A path, the law it is run by, the robot that takes it, and what limits that."""

    legs: Array
    knots: Array
    pieces: Array
    in_sliders: bool
    tools: Array
    law_knots: Array
    law_pieces: Array
    box: Array
    shares: Array


@compiled()
def _solve_at(way: Way, time: float, near: Array, motion: Array, sliders: Array) -> bool:
    """Write platform and sliders at a time of the law; whether they are within reach."""
    law = law_at(way.law_knots, way.law_pieces, time)
    if platform_at(way.legs, way.knots, way.pieces, way.in_sliders, way.tools, law, near, motion) != 0:
        return False
    if way.in_sliders:
        near[:] = motion[0]
    if inverse_motion(way.legs, motion, sliders) != 0:
        return False
    for i in range(9):
        position, _ = _quantity(motion, sliders, i)
        if not way.box[0, i] - ROUNDING <= position <= way.box[1, i] + ROUNDING:
            return False
    return True


@compiled()
def _turns(way: Way, last: float, time: float, near: Array, motion: Array, sliders: Array) -> float:
    """Return when a position that turns near its limit between two looks is beyond it, else not a number.

    `motion` (3, 3, 3) and `sliders` (3, 6, 3) hold the looks at `last` and at `time`, and have room for one more.
    """
    for i in range(9):
        before, leaving = _quantity(motion[0], sliders[0], i)
        _, coming = _quantity(motion[1], sliders[1], i)
        if leaving * coming >= 0.0:
            continue
        # It has turned about here, were the acceleration constant.
        turn = before + leaving * leaving / (leaving - coming) * (time - last) / 2.0
        if way.box[0, i] + NEAR <= turn <= way.box[1, i] - NEAR:
            continue
        low, high = last, time
        for _ in range(HALVINGS // 3):
            middle = (low + high) / 2.0
            if not _solve_at(way, middle, near, motion[2], sliders[2]):
                return middle
            _, velocity = _quantity(motion[2], sliders[2], i)
            if velocity * leaving > 0.0:
                low = middle
            else:
                high = middle
    return math.nan


@compiled()
def _measure_rates(
    now: Array, then: Array, i: int, step: float, whole: bool, worst: Array, by: tuple[float, float, float] = EQUAL
) -> None:
    """Raise `worst` (3,) to the velocity, acceleration and jerk of column i of rows (position, velocity, acceleration).

    `then` are the rows a step later. `whole` tells whether the motion goes on for the whole step. The
    three count `by` so much.
    """
    worst[0] = max(worst[0], by[0] * abs(now[1, i]))
    worst[1] = max(worst[1], by[1] * abs(now[2, i]))
    # The mean jerk of this step, and what the velocity says of its beginning and its end: a rate may change
    # within a single step, where the accelerations before and after are the same.
    change = then[1, i] - now[1, i]
    early = 2.0 * (change / step - now[2, i]) / step
    late = 2.0 * (then[2, i] - change / step) / step
    worst[2] = max(worst[2], by[2] * (abs(early + late) / 2.0))
    if whole:
        worst[2] = max(worst[2], by[2] * abs(early), by[2] * abs(late))


@compiled()
def _measure_tool(way: Way, time: float, motion: Array, arms: Array, step: float, whole: bool, worst: Array) -> None:
    """Measure the rates of x, y, phi: of the path's tool, and of the centre in the two last rows where it is another.

    `motion` (3, 3, 3) holds the platform a step later and at a time; `arms` (2, 3, 3) is room for the tool's.
    """
    u, v = tool_at(way.knots, way.tools, law_at(way.law_knots, way.law_pieces, time)[0])
    arms[:] = motion[:2]
    if u != 0.0 or v != 0.0:
        # Of the same point a step later, also where another one's piece begins in between.
        transfer(arms[0], u, v)
        transfer(arms[1], u, v)
        for i in range(2):
            _measure_rates(motion[1], motion[0], i, step, whole, worst[4 + i])
    for i in range(3):
        _measure_rates(arms[1], arms[0], i, step, whole, worst[1 + i])


@compiled()
def _walk(way: Way, times: Array, until: float, step: float, near: Array, worst: Array) -> tuple[float, float]:
    """Look at a path at ascending times and a step later; return the last time within reach, and one beyond it."""
    motion, sliders, arms = np.empty((3, 3, 3)), np.empty((3, 6, 3)), np.empty((2, 3, 3))
    last = -math.inf
    for k in range(len(times)):
        time = times[k]
        if abs(time - last) < ROUNDING:
            motion[1], sliders[1] = motion[0], sliders[0]
        elif not _solve_at(way, time, near, motion[1], sliders[1]):
            return last, time
        elif time > last + step and k > 0:
            leaves_at = _turns(way, last, time, near, motion, sliders)
            if not math.isnan(leaves_at):
                return last, leaves_at
        last = time + step
        if not _solve_at(way, last, near, motion[0], sliders[0]):
            return time, last
        whole = time >= 0.0 and last <= until  # else it is the step from or to a standstill, in which nothing else is
        for i in range(3):
            by = way.shares[0, i], way.shares[1, i], way.shares[2, i]
            _measure_rates(sliders[1], sliders[0], i, step, whole, worst[0], by)
        _measure_tool(way, time, motion, arms, step, whole, worst)
    return last, math.nan


@compiled(
    f"f8({LEGS_TYPE}, f8[::1], f8[:, :, ::1], b1, f8[:, ::1], f8[::1], f8[:, :, ::1], "
    "f8, f8, i8, f8, f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])"
)
def survey(
    legs: Array,
    knots: Array,
    pieces: Array,
    in_sliders: bool,
    tools: Array,
    law_knots: Array,
    law_pieces: Array,
    first: float,
    until: float,
    even: int,
    step: float,
    start: Array,
    box: Array,
    shares: Array,
    worst: Array,
) -> float:
    """Look at a path, run by a law, between two times; write the greatest velocities, accelerations and jerks.

    It is looked at `even` times, at its knots and between them, and where a position turns near its limit. Jerk is
    what the setpoints before and after a `step` [s] say of it, as the drives see it. `start` is the pose at the first
    time. `box` (2, 9) holds the limits, low and high, of x, y, phi, of each slider and of each cross slide, `shares`
    (3, 3) by what the velocity, acceleration and jerk of each slider count. Returns when it is first out of reach, else
    not a number. `worst` (6, 3) has velocity, acceleration and jerk of the slider that has most, of x, y and phi of
    the path's tool, and of x and y of the platform's centre where the tool is another point; nothing where the path is
    out of reach.
    """
    way = Way(legs, knots, pieces, in_sliders, tools, law_knots, law_pieces, box, shares)
    times = _moments(knots, law_knots, law_pieces, first, until, even, step)
    near = start.copy()
    worst[:] = 0.0
    inside, leaves_at = _walk(way, times, until, step, near, worst)
    if not math.isnan(leaves_at):
        motion, sliders = np.empty((3, 3)), np.empty((6, 3))
        inside = max(inside, first)
        for _ in range(HALVINGS // 3):
            middle = (inside + leaves_at) / 2.0
            if _solve_at(way, middle, near, motion, sliders):
                inside = middle
            else:
                leaves_at = middle
    return leaves_at
