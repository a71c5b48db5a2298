"""Compiled sampling of a path under a law, to compare positions with limits and to find the greatest rates."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.closed_forward import LEGS_TYPE, sign_of_det_j2
from trirail.kinematics.closure import inverse_motion
from trirail.kinematics.compiled import compiled
from trirail.kinematics.recursion import ZERO
from trirail.motion.paths import BISECTIONS, ROUNDING, law_at, passing_time, platform_at, tool_at, transfer_to_point

__all__ = ["survey"]

TURN_CLEARANCE = 1e-3
"""Distance from a limit within which the turning point of a position is computed exactly [m, rad]."""
UNIT_WEIGHTS = (1.0, 1.0, 1.0)
MIN_END_ACCELERATION = 1e-9
"""Acceleration of the sliders at an end of a path below which the path counts as ending without acceleration [m/s²]."""
RETURN_SLOWDOWN = 10.0
"""Factor by which velocities are reduced while the robot returns from outside its limits."""
MIN_PEAK = 1.0 + 1e-4
"""Estimated peak of a velocity between two samples above which the peak is computed, relative to the greatest velocity
of the earlier samples."""
PEAK_BISECTIONS = 6
"""Number of bisection steps after which the error of a peak of the velocity is below a thousandth."""
SAMPLES_PER_PIECE = 4
"""Number of samples in every piece of a path."""


@compiled()
def _insert_time(times: Array, n: int, time: float, first: float, until: float) -> int:
    """Append `time` to the first n times if it is between `first` and `until`. Return the new number of times."""
    if first <= time <= until:
        times[n] = time
        n += 1
    return n


@compiled()
def _sample_times(
    knots: Array, law_knots: Array, law_pieces: Array, first: float, until: float, even: int, step: float
) -> Array:
    """Return the sample times in ascending order: evenly spaced, within every piece, and on both sides of every knot.

    The jerk may have a short peak next to a knot of the path or of the law. The step that ends at the knot and the step
    that begins at the knot are therefore sampled. The mean jerk of any step across the knot is between their mean
    jerks.
    """
    times = np.empty(even + (SAMPLES_PER_PIECE + 1) * len(knots) + 2 * len(law_knots))
    for k in range(even):
        times[k] = first + (until - first) * k / (even - 1)
    n = even
    begin = law_at(law_knots, law_pieces, first)[0]
    end = law_at(law_knots, law_pieces, until)[0]
    for k in range(len(knots)):
        for part in range(SAMPLES_PER_PIECE if k < len(knots) - 1 else 1):
            s = knots[k]
            if part:
                s += (knots[k + 1] - knots[k]) * part / SAMPLES_PER_PIECE
            if begin <= s <= end:
                time = passing_time(law_knots, law_pieces, s, until)
                n = _insert_time(times, n, time, first, until)
                if not part:
                    n = _insert_time(times, n, time - step, first, until)
    for knot in law_knots:
        n = _insert_time(times, n, knot, first, until)
        n = _insert_time(times, n, knot - step, first, until)
    return np.sort(times[:n])


@compiled()
def _limited_position(motion: Array, sliders: Array, i: int) -> tuple[float, float]:
    """Return position i and its velocity. The nine positions with limits are x, y, phi, sliders and cross slides."""
    if i < 3:
        return motion[0, i], motion[1, i]
    if i < 6:
        return sliders[0, i - 3], sliders[1, i - 3]
    return sliders[3, i - 6], sliders[4, i - 6]


class PathProblem(NamedTuple):
    """Path and law to be sampled, with the robot and its limits.

    `box` (2, 9) holds the position limits. `reach` (2, 9) holds the limits that apply to this path. If a position
    starts outside its limits, `reach` is extended to this position, and shrinks as the position moves inwards.
    Otherwise, `reach` equals `box`.
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


@compiled()
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
        position, _ = _limited_position(motion, sliders, i)
        problem.reach[0, i], problem.reach[1, i] = min(problem.box[0, i], position), max(problem.box[1, i], position)
        if max(problem.box[0, i] - position, position - problem.box[1, i]) > tolerance[i]:
            beyond = 1
    return beyond


@compiled()
def _narrow_reach(problem: PathProblem, motion: Array, sliders: Array) -> None:
    """Shrink `reach` while a position returns from outside its limits. The position cannot move out again."""
    for i in range(9):
        position, _ = _limited_position(motion, sliders, i)
        problem.reach[0, i] = min(problem.box[0, i], max(problem.reach[0, i], position))
        problem.reach[1, i] = max(problem.box[1, i], min(problem.reach[1, i], position))


@compiled()
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
        position, _ = _limited_position(motion, sliders, i)
        if not problem.reach[0, i] - ROUNDING <= position <= problem.reach[1, i] + ROUNDING:
            return False
    phi = motion[0, 2]
    if problem.box[0, 2] - ROUNDING <= phi <= problem.box[1, 2] + ROUNDING:
        return True
    # J2 is regular within the limits of phi. Outside these limits, a singular angle may be on the way back.
    return sign_of_det_j2(problem.legs, (motion[0, 0], motion[0, 1], phi)) == sign_of_det_j2(problem.legs, ZERO)


@compiled()
def _find_turn_beyond_limit(
    problem: PathProblem, last: float, time: float, near: Array, motion: Array, sliders: Array
) -> float:
    """Return a time at which a position that turns between two samples is out of reach; NaN if there is none.

    `motion` (3, 3, 3) and `sliders` (3, 6, 3) hold the samples at `last` and `time`, and space for a third sample.
    """
    for i in range(9):
        before, leaving = _limited_position(motion[0], sliders[0], i)
        _, coming = _limited_position(motion[1], sliders[1], i)
        if leaving * coming >= 0.0:
            continue
        # Estimate the turning point, assuming constant acceleration.
        turn = before + leaving * leaving / (leaving - coming) * (time - last) / 2.0
        if problem.box[0, i] + TURN_CLEARANCE <= turn <= problem.box[1, i] - TURN_CLEARANCE:
            continue
        low, high = last, time
        for _ in range(BISECTIONS // 3):
            middle = (low + high) / 2.0
            if not _solve_at(problem, middle, near, motion[2], sliders[2]):
                return middle
            _, velocity = _limited_position(motion[2], sliders[2], i)
            if velocity * leaving > 0.0:
                low = middle
            else:
                high = middle
    return math.nan


@compiled()
def _measure_peaks(
    problem: PathProblem, last: float, time: float, near: Array, motion: Array, sliders: Array, worst: Array
) -> None:
    """Update the greatest velocities `worst` (6, 3) where a velocity has a peak between two samples.

    `motion` (3, 3, 3) and `sliders` (3, 6, 3) hold the samples at `last` and `time`, and space for a third sample. Only
    the coordinates of the path are measured: if it moves another point, x and y of the centre are not among them.
    """
    for i in range(2 if len(problem.tools) else 0, 6):
        of_slider, n = i >= 3, i % 3
        states = sliders if of_slider else motion
        row, weight = (0, problem.shares[0, n]) if of_slider else (1 + n, 1.0)
        begin, end = states[0, 2, n], states[1, 2, n]
        if begin * end >= 0.0:
            continue
        # With constant jerk, the velocity would rise by half of this value.
        rise = begin * begin / abs(begin - end) * (time - last)
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


@compiled()
def _measure_tool(
    problem: PathProblem, time: float, motion: Array, arms: Array, step: float, whole: bool, worst: Array
) -> None:
    """Update the maxima `worst` with the rates of the tool, and with those of the centre if the tool is another point.

    `motion` (3, 3, 3) holds the motion of the platform one step later and at `time`. `arms` (2, 3, 3) is space for the
    tool's motion.
    """
    u, v = tool_at(problem.knots, problem.tools, law_at(problem.law_knots, problem.law_pieces, time)[0])
    arms[:] = motion[:2]
    if u != 0.0 or v != 0.0:
        # Use the same point one step later, even if a piece for another point begins in between.
        transfer_to_point(arms[0], u, v)
        transfer_to_point(arms[1], u, v)
        for i in range(2):
            _measure_rates(motion[1], motion[0], i, step, whole, worst[4 + i])
    for i in range(3):
        _measure_rates(arms[1], arms[0], i, step, whole, worst[1 + i])


@compiled()
def _sample_path(
    problem: PathProblem, times: Array, until: float, step: float, near: Array, worst: Array
) -> tuple[float, float]:
    """Sample a path at ascending times, and one step after each of these times.

    Returns the last time that was found within reach, and a later time out of reach (NaN if there is none).
    """
    motion, sliders, arms = np.empty((3, 3, 3)), np.empty((3, 6, 3)), np.empty((2, 3, 3))
    last = -math.inf
    for k in range(len(times)):
        time = times[k]
        if abs(time - last) < ROUNDING:
            motion[1], sliders[1] = motion[0], sliders[0]
        elif not _solve_at(problem, time, near, motion[1], sliders[1]):
            return last, time
        elif time > last + step and k > 0:
            leaves_at = _find_turn_beyond_limit(problem, last, time, near, motion, sliders)
            if not math.isnan(leaves_at):
                return last, leaves_at
            _measure_peaks(problem, last, time, near, motion, sliders, worst)
        if time >= 0.0:
            _narrow_reach(problem, motion[1], sliders[1])
        last = time + step
        if not _solve_at(problem, last, near, motion[0], sliders[0]):
            return time, last
        whole = time >= 0.0 and last <= until  # False for the first step from rest and the last step to rest
        for i in range(3):
            weights = problem.shares[0, i], problem.shares[1, i], problem.shares[2, i]
            _measure_rates(sliders[1], sliders[0], i, step, whole, worst[0], weights)
        _measure_tool(problem, time, motion, arms, step, whole, worst)
    return last, math.nan


@compiled()
def _measure_jump(problem: PathProblem, edge: float, time: float, step: float, near: Array, worst: Array) -> None:
    """Update the jerk in `worst` at an end of the path, `edge`, at which the acceleration is not 0.

    The setpoint next to the standstill may lie anywhere within the first or last step of the path, which ends or begins
    at `time`. The jerk of that step is therefore added to the jump of the acceleration.
    """
    motion, sliders, arms = np.empty((3, 3, 3)), np.empty((3, 6, 3)), np.empty((2, 3, 3))
    if not _solve_at(problem, edge, near, motion[0], sliders[0]) or np.abs(sliders[0, 2]).max() <= MIN_END_ACCELERATION:
        return
    if not _solve_at(problem, time, near, motion[0], sliders[0]):
        return
    motion[1], sliders[1] = motion[0], sliders[0]
    motion[1, 1:], sliders[1, 1:3] = 0.0, 0.0
    for i in range(3):
        weights = problem.shares[0, i], problem.shares[1, i], problem.shares[2, i]
        _measure_rates(sliders[1], sliders[0], i, step, False, worst[0], weights)
    _measure_tool(problem, time, motion, arms, step, False, worst)


@compiled(
    f"f8({LEGS_TYPE}, f8[::1], f8[:, :, ::1], b1, f8[:, ::1], f8[::1], f8[:, :, ::1], "
    "f8, f8, i8, f8, f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1])"
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
    problem = PathProblem(legs, knots, pieces, in_sliders, tools, law_knots, law_pieces, box, np.empty((2, 9)), shares)
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
