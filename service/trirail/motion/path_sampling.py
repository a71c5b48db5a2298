"""Compiled sampling of a path under a law, to compare positions with limits and to find the greatest rates."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trirail.kinematics.arrays import Array, Vector
from trirail.kinematics.closed_forward import LEGS_TYPE, sign_of_det_j2
from trirail.kinematics.closure import inverse_motion
from trirail.kinematics.compiled import compiled
from trirail.kinematics.recursion import ZERO
from trirail.motion.paths import (
    BISECTIONS,
    OUTWARD_ROUNDING,
    ROUNDING,
    law_at,
    passing_time,
    platform_at,
    tool_at,
    transfer_to_point,
)

__all__ = ["survey"]

UNIT_WEIGHTS = (1.0, 1.0, 1.0)
MIN_END_ACCELERATION = 1e-9
"""Acceleration of the sliders at an end of a path below which the path counts as ending without acceleration [m/s²]."""
RETURN_SLOWDOWN = 10.0
"""Factor by which velocities are reduced while the robot returns from outside its limits."""
MIN_PEAK = 1.0 + 1e-4
"""Estimated peak of a rate between two samples above which the peak is computed, relative to the greatest value of the
earlier samples."""
PEAK_BISECTIONS = 6
"""Number of bisection steps after which the error of a peak of the velocity is below a thousandth."""
MIN_SAMPLES_IN_PIECE, MAX_SAMPLES_IN_PIECE = 4, 16
"""Least and greatest number of samples in every piece of a path."""
SHORT_STEP_S = 0.001
"""Cycle time above which the least number of samples in a piece is higher [s]. Peaks between samples are estimated from
the jerk over a cycle, which says little if the cycle lasts longer than the interval of the samples."""
PIECE_SAMPLE_INTERVAL_S = 0.03
"""Interval of the samples in a piece, if their number allows this interval [s]."""
MAX_VELOCITY_RISE = 0.25
"""Upper bound for the rise of a velocity between two samples, as a fraction of the interval times the sum of both
accelerations. For a cubic, the fraction is at most 4/27."""


@compiled()
def _insert_time(times: Array, n: int, time: float, first: float, until: float) -> int:
    """Append `time` to the first n times if it is between `first` and `until`. Return the new number of times."""
    if first <= time <= until:
        times[n] = time
        n += 1
    return n


@compiled()
def _samples_in_piece(duration: float, step: float) -> int:
    """Return the number of samples in a piece of a path with a duration [s], for a cycle time `step` [s]."""
    least = MIN_SAMPLES_IN_PIECE * max(1.0, step / SHORT_STEP_S)
    return int(min(max(duration / PIECE_SAMPLE_INTERVAL_S, least), MAX_SAMPLES_IN_PIECE))


@compiled(allocates=True)
def _sample_times(
    knots: Array, law_knots: Array, law_pieces: Array, first: float, until: float, even: int, step: float
) -> Array:
    """Return the sample times in ascending order: evenly spaced, within every piece, and on both sides of every knot.

    The jerk may have a short peak next to a knot of the path or of the law. The step that ends at the knot and the step
    that begins at the knot are therefore sampled. The mean jerk of any step across the knot is between their mean
    jerks.
    """
    begin = law_at(law_knots, law_pieces, first)[0]
    end = law_at(law_knots, law_pieces, until)[0]
    low, high = 0, len(knots) - 1  # first and last knot of the pieces between `begin` and `end`
    while low < high and knots[low + 1] < begin:
        low += 1
    while high > low and knots[high - 1] > end:
        high -= 1
    times = np.empty(even + (MAX_SAMPLES_IN_PIECE + 1) * (high - low + 1) + 2 * len(law_knots))
    for k in range(even):
        times[k] = first + (until - first) * k / (even - 1)
    n = even
    last = 0.0
    for k in range(low, high + 1):
        time = passing_time(law_knots, law_pieces, knots[k], until)
        if k > low:
            number = _samples_in_piece(knots[k] - knots[k - 1], step)
            for part in range(1, number):
                n = _insert_time(times, n, last + (time - last) * part / number, first, until)
        if begin <= knots[k] <= end:
            n = _insert_time(times, n, time, first, until)
            n = _insert_time(times, n, time - step, first, until)
        last = time
    for knot in law_knots:
        n = _insert_time(times, n, knot, first, until)
        n = _insert_time(times, n, knot - step, first, until)
    return np.sort(times[:n])


@compiled()
def _limited_position(motion: Array, sliders: Array, i: int) -> Vector:
    """Return position i, its velocity and its acceleration.

    The nine positions with limits are x, y, phi, sliders and cross slides.
    """
    if i < 3:
        return motion[0, i], motion[1, i], motion[2, i]
    if i < 6:
        return sliders[0, i - 3], sliders[1, i - 3], sliders[2, i - 3]
    return sliders[3, i - 6], sliders[4, i - 6], sliders[5, i - 6]


class PathProblem(NamedTuple):
    """Path and law to be sampled, with the robot and its limits.

    `box` (2, 9) holds the position limits, extended by ROUNDING. `reach` (2, 9) holds the limits that apply to this
    path. If a position starts outside its limits, `reach` is extended to this position, and shrinks as the position
    moves inwards. Otherwise, `reach` equals `box`.
    """

    legs: Array
    knots: Array
    pieces: Array
    in_sliders: bool
    tools: Array
    law_knots: Array
    law_pieces: Array
    box: Array
    reach: Array
    shares: Array


@compiled(allocates=True)
def _initialise_reach(problem: PathProblem, time: float, near: Array, tolerance: Array) -> int:
    """Set `reach` for a path that begins at a time of the law.

    Returns 0, 1 if the path begins beyond a limit by more than `tolerance`, or -1 if the start is singular.
    """
    motion, sliders = np.empty((3, 3)), np.empty((6, 3))
    problem.reach[0], problem.reach[1] = -math.inf, math.inf
    if not _solve_at(problem, time, near, motion, sliders):
        return -1
    beyond = 0
    for i in range(9):
        position, _, _ = _limited_position(motion, sliders, i)
        problem.reach[0, i], problem.reach[1, i] = min(problem.box[0, i], position), max(problem.box[1, i], position)
        if max(problem.box[0, i] - position, position - problem.box[1, i]) > tolerance[i]:
            beyond = 1
    return beyond


@compiled()
def _narrow_reach(problem: PathProblem, motion: Array, sliders: Array) -> None:
    """Shrink `reach` while a position returns from outside its limits. The position cannot move out again."""
    for i in range(9):
        position, _, _ = _limited_position(motion, sliders, i)
        problem.reach[0, i] = min(problem.box[0, i], max(problem.reach[0, i], position))
        problem.reach[1, i] = max(problem.box[1, i], min(problem.reach[1, i], position))


@compiled(allocates=True)
def _solve_at(problem: PathProblem, time: float, near: Array, motion: Array, sliders: Array) -> bool:
    """Write the motion of the platform and the sliders at a time of the law. Return True if they are within reach."""
    law = law_at(problem.law_knots, problem.law_pieces, time)
    if (
        platform_at(problem.legs, problem.knots, problem.pieces, problem.in_sliders, problem.tools, law, near, motion)
        != 0
    ):
        return False
    if problem.in_sliders:
        near[:] = motion[0]
    if inverse_motion(problem.legs, motion, sliders) != 0:
        return False
    for i in range(9):
        position, _, _ = _limited_position(motion, sliders, i)
        if not problem.reach[0, i] - OUTWARD_ROUNDING <= position <= problem.reach[1, i] + OUTWARD_ROUNDING:
            return False
    phi = motion[0, 2]
    if problem.box[0, 2] <= phi <= problem.box[1, 2]:
        return True
    # J2 is regular within the limits of phi. Outside these limits, a singular angle may be on the way back.
    return sign_of_det_j2(problem.legs, (motion[0, 0], motion[0, 1], phi)) == sign_of_det_j2(problem.legs, ZERO)


@compiled()
def _find_zero(
    problem: PathProblem, i: int, order: int, low: float, high: float, near: Array, motion: Array, sliders: Array
) -> tuple[float, bool]:
    """Return the time at which a derivative of position i is zero, by bisection, and False if it is out of reach.

    The derivative of the given order has different signs at the times `low` and `high`. `motion` (3, 3) and `sliders`
    (6, 3) hold the sample at `high`, and afterwards the sample at the last time of the bisection.
    """
    sign = _limited_position(motion, sliders, i)[order]
    middle = high
    for _ in range(BISECTIONS // 3):
        middle = (low + high) / 2.0
        if not _solve_at(problem, middle, near, motion, sliders):
            return middle, False
        if _limited_position(motion, sliders, i)[order] * sign < 0.0:
            low = middle
        else:
            high = middle
    return middle, True


@compiled(allocates=True)
def _find_turn_beyond_limit(
    problem: PathProblem, last: float, time: float, near: Array, motion: Array, sliders: Array
) -> float:
    """Return a time at which a position that turns between two samples is out of reach; NaN if there is none.

    `motion` (4, 3, 3) and `sliders` (4, 6, 3) hold the samples at `last` and `time`, and space for a third sample.
    """
    span = time - last
    for i in range(9):
        before, leaving, begin = _limited_position(motion[0], sliders[0], i)
        after, coming, end = _limited_position(motion[1], sliders[1], i)
        once = leaving * coming < 0.0
        # With constant jerk, the velocity falls by half of `fall` and rises again, or it rises and falls again.
        fall = begin * begin / abs(begin - end) * span if begin * end < 0.0 else 0.0
        if not once and (leaving * begin >= 0.0 or fall <= abs(leaving)):
            continue
        speed = max(abs(leaving), abs(coming)) + MAX_VELOCITY_RISE * span * (abs(begin) + abs(end))
        if (
            problem.box[0, i] <= min(before, after) - span * speed
            and max(before, after) + span * speed <= problem.box[1, i]
        ):
            continue
        motion[2], sliders[2] = motion[1], sliders[1]
        if once:
            turn, within = _find_zero(problem, i, 1, last, time, near, motion[2], sliders[2])
            if not within:
                return turn
            continue
        middle, within = _find_zero(problem, i, 2, last, time, near, motion[2], sliders[2])
        if not within:
            return middle
        if _limited_position(motion[2], sliders[2], i)[1] * leaving >= 0.0:
            continue
        turn, within = _find_zero(problem, i, 1, last, middle, near, motion[2], sliders[2])
        if not within:
            return turn
        motion[2], sliders[2] = motion[1], sliders[1]
        turn, within = _find_zero(problem, i, 1, middle, time, near, motion[2], sliders[2])
        if not within:
            return turn
    return math.nan


@compiled()
def _peak_of_cubic(begin: float, end: float, slope: float, end_slope: float) -> tuple[float, float]:
    """Return the place between 0 and 1 of the extremum of a cubic, and its value there.

    The cubic is given by its values and slopes at 0 and 1. The slopes have different signs.
    """
    rise = end - begin
    a, b = slope + end_slope - 2.0 * rise, 3.0 * rise - 2.0 * slope - end_slope
    # The derivative is 3 a u² + 2 b u + slope, which is zero where u = (-b -+ root) / 3a = slope / (-b -+ root).
    root = math.sqrt(max(0.0, b * b - 3.0 * a * slope))
    q = -(b + math.copysign(root, b))
    u = slope / q
    if not 0.0 <= u <= 1.0:
        u = q / (3.0 * a)
    return u, begin + u * (slope + u * (b + u * a))


@compiled()
def _measure_peaks(
    problem: PathProblem,
    last: float,
    time: float,
    near: Array,
    motion: Array,
    sliders: Array,
    jerks: Array,
    worst: Array,
) -> None:
    """Update the maxima `worst` (6, 3) where a velocity or an acceleration has a peak between two samples.

    `motion` (4, 3, 3) and `sliders` (4, 6, 3) hold the samples at `last` and `time`, and space for a third sample.
    `jerks` (2, 6) are the jerks of x, y, phi and the sliders at these two samples. Only the coordinates of the path are
    measured: if it moves another point, x and y of the centre are not among them.
    """
    span = time - last
    for i in range(2 if len(problem.tools) else 0, 6):
        of_slider, n = i >= 3, i % 3
        states = sliders if of_slider else motion
        row = 0 if of_slider else 1 + n
        begin, end = states[0, 2, n], states[1, 2, n]
        if jerks[0, i] * jerks[1, i] < 0.0:
            share, peak = _peak_of_cubic(begin, end, jerks[0, i] * span, jerks[1, i] * span)
            weight = problem.shares[1, n] if of_slider else 1.0
            if weight * abs(peak) > worst[row, 1] * MIN_PEAK:
                if not _solve_at(problem, last + share * span, near, motion[2], sliders[2]):
                    return
                worst[row, 1] = max(worst[row, 1], weight * abs(states[2, 2, n]))
        if begin * end >= 0.0:
            continue
        # With constant jerk, the velocity would rise by half of this value.
        rise = begin * begin / abs(begin - end) * span
        weight = problem.shares[0, n] if of_slider else 1.0
        if weight * (abs(states[0, 1, n]) + rise) <= worst[row, 0] * MIN_PEAK:
            continue
        low, high = last, time
        for _ in range(PEAK_BISECTIONS):
            middle = (low + high) / 2.0
            if not _solve_at(problem, middle, near, motion[2], sliders[2]):
                return
            worst[row, 0] = max(worst[row, 0], weight * abs(states[2, 1, n]))
            if states[2, 2, n] * begin > 0.0:
                low = middle
            else:
                high = middle


@compiled()
def _measure_rates(
    now: Array,
    then: Array,
    i: int,
    step: float,
    whole: bool,
    worst: Array,
    weights: tuple[float, float, float] = UNIT_WEIGHTS,
) -> None:
    """Update the maxima `worst` (3,) with velocity, acceleration and jerk of column i, from two samples one step apart.

    `now` and `then` have the rows position, velocity, acceleration. `whole` is True if the motion covers the complete
    step, without a standstill. The values are multiplied by `weights`.
    """
    worst[0] = max(worst[0], weights[0] * abs(now[1, i]))
    worst[1] = max(worst[1], weights[1] * abs(now[2, i]))
    # In addition to the mean jerk, compute the jerk of both halves of the step from the change of velocity. Within a
    # step, the acceleration may rise and fall again, and the mean jerk would be zero.
    change = then[1, i] - now[1, i]
    early = 2.0 * (change / step - now[2, i]) / step
    late = 2.0 * (then[2, i] - change / step) / step
    worst[2] = max(worst[2], weights[2] * (abs(early + late) / 2.0))
    if whole:
        worst[2] = max(worst[2], weights[2] * abs(early), weights[2] * abs(late))


@compiled(allocates=True)
def _measure_tool(
    problem: PathProblem, time: float, now: Array, then: Array, arms: Array, step: float, whole: bool, worst: Array
) -> None:
    """Update the maxima `worst` with the rates of the tool, and with those of the centre if the tool is another point.

    `now` and `then` (3, 3) hold the motion of the platform at `time` and one step later. `arms` (2, 3, 3) is space for
    the tool's motion.
    """
    u, v = tool_at(problem.knots, problem.tools, law_at(problem.law_knots, problem.law_pieces, time)[0])
    arms[0], arms[1] = now, then
    if u != 0.0 or v != 0.0:
        # Use the same point one step later, even if a piece for another point begins in between.
        transfer_to_point(arms[0], u, v)
        transfer_to_point(arms[1], u, v)
        for i in range(2):
            _measure_rates(now, then, i, step, whole, worst[4 + i])
    for i in range(3):
        _measure_rates(arms[0], arms[1], i, step, whole, worst[1 + i])


@compiled(allocates=True)
def _sample_path(
    problem: PathProblem, times: Array, until: float, step: float, near: Array, worst: Array
) -> tuple[float, float]:
    """Sample a path at ascending times, and one step after each of these times.

    Returns the last time that was found within reach, and a later time out of reach (NaN if there is none).
    """
    # The samples are: the previous one, the present one, space for one in between, and the one a step later.
    motion, sliders, arms = np.empty((4, 3, 3)), np.empty((4, 6, 3)), np.empty((2, 3, 3))
    jerks = np.empty((2, 6))
    before = last = -math.inf
    for k in range(len(times)):
        time = times[k]
        if abs(time - last) < ROUNDING:
            motion[1], sliders[1] = motion[3], sliders[3]
        elif not _solve_at(problem, time, near, motion[1], sliders[1]):
            return before, time
        if k > 0 and time > before + ROUNDING:
            leaves_at = _find_turn_beyond_limit(problem, before, time, near, motion, sliders)
            if not math.isnan(leaves_at):
                return before, leaves_at
        if time >= 0.0:
            _narrow_reach(problem, motion[1], sliders[1])
        last = time + step
        if not _solve_at(problem, last, near, motion[3], sliders[3]):
            return time, last
        for i in range(3):
            jerks[1, i] = (motion[3, 2, i] - motion[1, 2, i]) / step
            jerks[1, 3 + i] = (sliders[3, 2, i] - sliders[1, 2, i]) / step
        if k > 0 and time > before + ROUNDING:
            _measure_peaks(problem, before, time, near, motion, sliders, jerks, worst)
        whole = time >= 0.0 and last <= until  # False for the first step from rest and the last step to rest
        for i in range(3):
            weights = problem.shares[0, i], problem.shares[1, i], problem.shares[2, i]
            _measure_rates(sliders[1], sliders[3], i, step, whole, worst[0], weights)
        _measure_tool(problem, time, motion[1], motion[3], arms, step, whole, worst)
        before = time
        motion[0], sliders[0], jerks[0] = motion[1], sliders[1], jerks[1]
    return before, math.nan


@compiled(allocates=True)
def _measure_jump(problem: PathProblem, edge: float, time: float, step: float, near: Array, worst: Array) -> None:
    """Update the jerk in `worst` at an end of the path, `edge`, at which the acceleration is not 0.

    The setpoint next to the standstill may lie anywhere within the first or last step of the path, which ends or begins
    at `time`. The jerk of that step is therefore added to the jump of the acceleration.
    """
    motion, sliders, arms = np.empty((2, 3, 3)), np.empty((2, 6, 3)), np.empty((2, 3, 3))
    if not _solve_at(problem, edge, near, motion[0], sliders[0]) or np.abs(sliders[0, 2]).max() <= MIN_END_ACCELERATION:
        return
    if not _solve_at(problem, time, near, motion[0], sliders[0]):
        return
    motion[1], sliders[1] = motion[0], sliders[0]
    motion[1, 1:], sliders[1, 1:3] = 0.0, 0.0
    for i in range(3):
        weights = problem.shares[0, i], problem.shares[1, i], problem.shares[2, i]
        _measure_rates(sliders[1], sliders[0], i, step, False, worst[0], weights)
    _measure_tool(problem, time, motion[1], motion[0], arms, step, False, worst)


@compiled(
    f"f8({LEGS_TYPE}, f8[::1], f8[:, :, ::1], b1, f8[:, ::1], f8[::1], f8[:, :, ::1], "
    "f8, f8, i8, f8, f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1])",
    allocates=True,
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
    tolerance: Array,
    shares: Array,
    worst: Array,
) -> float:
    """Sample a path under a law between two times. Find the greatest rates, and the first time out of reach.

    Parameters
    ----------
    legs, knots, pieces, in_sliders, tools, law_knots, law_pieces
        Packed legs of the robot, the path and its law.
    first, until : float
        Times of the law between which the path is sampled [s].
    even : int
        Number of evenly spaced samples. More samples are added at knots, between knots, and at turning points near a
        limit.
    step : float
        Cycle time [s]. Jerk is computed from setpoints one step apart, as it acts on the drives.
    start : (3,)
        Pose at `first`. It selects the branch of the forward kinematics.
    box : (2, 9)
        Low and high limits of x, y, phi, of each slider and of each cross slide.
    tolerance : (9,)
        Tolerances of the limits. If a path begins farther outside its limits than the tolerance, velocities are
        multiplied by RETURN_SLOWDOWN.
    shares : (3, 3)
        Factors for velocity, acceleration and jerk of each slider, which make sliders with different limits comparable.
    worst : (6, 3)
        Output: greatest velocity, acceleration and jerk. The rows are: all sliders; x, y and phi of the tool; x and y
        of the centre, if the tool is another point. Undefined if the path leaves the workspace.

    Returns
    -------
    float
        First time at which the path is out of reach [s]; NaN if it stays within reach.
    """
    wider = np.empty((2, 9))
    wider[0], wider[1] = box[0] - ROUNDING, box[1] + ROUNDING
    problem = PathProblem(
        legs, knots, pieces, in_sliders, tools, law_knots, law_pieces, wider, np.empty((2, 9)), shares
    )
    times = _sample_times(knots, law_knots, law_pieces, first, until, even, step)
    worst[:] = 0.0
    near = start.copy()
    start_code = _initialise_reach(problem, max(first, 0.0), near, tolerance)
    if start_code < 0:
        return first
    near[:] = start
    inside, leaves_at = _sample_path(problem, times, until, step, near, worst)
    if math.isnan(leaves_at):
        if law_at(law_knots, law_pieces, until)[0] >= knots[-1] - ROUNDING:
            _measure_jump(problem, until, max(until - step, first, 0.0), step, near, worst)
        if first < 0.0:
            near[:] = start
            _measure_jump(problem, 0.0, min(step, until), step, near, worst)
    else:
        motion, sliders = np.empty((3, 3)), np.empty((6, 3))
        inside = max(inside, first)
        for _ in range(BISECTIONS // 3):
            middle = (inside + leaves_at) / 2.0
            if _solve_at(problem, middle, near, motion, sliders):
                inside = middle
            else:
                leaves_at = middle
    if start_code > 0:
        worst[:, 0] *= RETURN_SLOWDOWN
    return leaves_at
