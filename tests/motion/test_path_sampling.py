"""What is found along a path's whole length, against the same path looked at a thousand times as often."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from motion.test_runs import ROBOT, way
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from trirail.kinematics.robot import inverse
from trirail.motion.path_sampling import survey
from trirail.motion.paths import Path, constant_law
from trirail.motion.quintic import Point, quintic
from trirail.motion.runs import joined, repeat_tool, stretched

Array = NDArray[np.float64]
Pose = tuple[float, float, float]

STEP = 0.001
"""The period of a cycle [s]."""
LEGS = ROBOT.packed()
ANYWHERE = np.array([[-9.0] * 9, [9.0] * 9])
"""Limits of x, y, phi, lambda_10 and lambda_32 that nothing reaches."""
COLUMNS = ((0,), (1,), (2,), (3, 4, 5), (6, 7, 8))
"""Which of x, y, phi, the sliders' and the passive positions each limit is of."""
POSES = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.3, 0.3))
TOOLS = st.sampled_from([(0.0, 0.0), (0.1, 0.0), (-0.02, 0.08)])
RATES = st.sampled_from([0.5, 1.0, 2.0])


class Dense(NamedTuple):
    """A path, looked at in a thousand moments."""

    times: Array
    places: Array
    """x, y, phi, the sliders' and the passive positions, (n, 9)."""
    worst: Array
    """As of survey, (6, 3)."""


def rows_at(path: Path, times: Array) -> Array:
    """Return the path's own point, or its sliders, and two derivatives at times along it, (3, n, 3)."""
    k = np.clip(np.searchsorted(path.knots, times, side="right") - 1, 0, len(path.pieces) - 1)
    t = (times - path.knots[k])[:, None]
    pieces = path.pieces[k]
    found = []
    for n in range(3):
        factors = [math.perm(power, n) for power in range(n, 6)]
        found.append((pieces[:, :, n:] * factors * t[:, :, None] ** np.arange(6 - n)).sum(axis=2))
    return np.array(found)


def looked_at(path: Path, rate: float, number: int) -> Dense:
    """Look at a path in pose space from its beginning to its end, at a constant rate."""
    times = np.linspace(0.0, path.duration / rate, number)
    own = rows_at(path, np.minimum(times * rate, path.duration)) * np.array([1.0, rate, rate**2])[:, None, None]
    centre = own.copy()
    if len(path.tools):
        arm = complex(*path.tools[0]) * np.exp(1j * own[0, :, 2])
        rates = (arm, 1j * own[1, :, 2] * arm, (1j * own[2, :, 2] - own[1, :, 2] ** 2) * arm)
        for n, moved in enumerate(rates):
            centre[n, :, 0] -= moved.real
            centre[n, :, 1] -= moved.imag
    solved = inverse(ROBOT, *centre)
    worst = np.zeros((6, 3))
    sliders = np.array([solved.position, solved.velocity, solved.acceleration])
    cycle = round(STEP / times[1])
    subjects = [sliders, own[:, :, :1], own[:, :, 1:2], own[:, :, 2:], centre[:, :, :1], centre[:, :, 1:2]]
    for row, rows in enumerate(subjects if len(path.tools) else subjects[:4]):
        jerk = (rows[2][cycle:] - rows[2][:-cycle]) / STEP
        worst[row] = [np.abs(values).max() for values in (rows[1], rows[2], jerk)]
    return Dense(times, np.hstack([centre[0], solved.position, solved.passive_position]), worst)


def surveyed(path: Path, rate: float, box: Array = ANYWHERE, even: int = 16, step: float = STEP) -> tuple[float, Array]:
    """Return when a path is first out of reach, and the greatest rates."""
    worst, law = np.zeros((6, 3)), constant_law(rate)
    start = rows_at(path, np.zeros(1))[0, 0]
    until = path.duration / rate
    leaves_at = survey(
        LEGS, *path, law.knots, law.pieces, 0.0, until, even, step, start, box, np.zeros(9), np.ones((3, 3)), worst
    )
    return leaves_at, worst


def there_and_back(begin: Pose, middle: Pose, tool: tuple[float, float]) -> Path:
    """Return a path that goes on for a while beyond its middle, and turns where there is no knot."""
    velocity = 0.4 * np.subtract(middle, begin)
    points = [Point(0.0, begin), Point(1.0, middle, velocity.tolist()), Point(2.0, begin)]
    path = quintic(points, begin)
    return path._replace(tools=repeat_tool(tool, len(path.pieces)))


@given(POSES, POSES, POSES, TOOLS, RATES)
def test_the_greatest_rates_are_those_of_a_closer_look(
    begin: Pose, middle: Pose, end: Pose, tool: tuple[float, float], rate: float
) -> None:
    """Of the fastest slider, the path's own point and the centre: velocity, acceleration, and jerk over a cycle."""
    assume(min(math.dist(begin, middle), math.dist(middle, end)) > 1e-3)
    path = joined([way(middle, begin), way(end, middle)])
    path = path._replace(tools=repeat_tool(tool, len(path.pieces)))
    steps = math.ceil(path.duration / rate / STEP)
    expected = looked_at(path, rate, 4 * steps + 1).worst
    leaves_at, worst = surveyed(path, rate, even=64)
    assert math.isnan(leaves_at)
    assert worst == pytest.approx(expected, rel=0.05, abs=1e-9)
    assert (worst[:, :2] <= expected[:, :2] * (1.0 + 1e-2) + 1e-9).all()


SHARES = st.tuples(*[st.floats(-1.0, 1.0)] * 3)
SECONDS = st.sampled_from([0.05, 0.3, 1.0, 4.0])
LEGS_OF_WAY = st.lists(st.tuples(POSES, SHARES, SHARES, SECONDS), min_size=1, max_size=4)
WAITS = st.sampled_from([0.0, 10.0, 300.0])


def uneven(begin: Pose, legs: list[tuple[Pose, Pose, Pose, float]]) -> Path:
    """Return a path through points with velocities and accelerations, whose pieces are very different in length."""
    spans = [*(seconds for *_, seconds in legs), legs[-1][3]]
    points, t = [Point(0.0, begin, (0.0,) * 3, (0.0,) * 3)], 0.0
    for (pose, velocity, acceleration, seconds), following in zip(legs, spans[1:], strict=True):
        t, longer = t + seconds, max(seconds, following)
        rates = np.multiply(velocity, 0.2 / longer).tolist(), np.multiply(acceleration, 0.5 / longer**2).tolist()
        points.append(Point(t, pose, *rates))
    points.append(Point(t + spans[-1], begin, (0.0,) * 3, (0.0,) * 3))
    return quintic(points, begin)


def waiting(path: Path, seconds: float) -> Path:
    """Return a path that waits at its end."""
    if not seconds:
        return path
    still = np.zeros((1, 3, 6))
    still[0, :, 0] = path.end
    return joined([path, Path(np.array([0.0, seconds]), still)])


@given(POSES, LEGS_OF_WAY, WAITS)
def test_no_rate_of_uneven_pieces_is_greater_than_what_is_found(
    begin: Pose, legs: list[tuple[Pose, Pose, Pose, float]], wait: float
) -> None:
    """However long the path waits afterwards. The margin that plans have is of 2 % for accelerations, 4 % for jerks."""
    path = uneven(begin, legs)
    expected = looked_at(path, 1.0, 2 * round(path.duration / STEP) + 1).worst
    leaves_at, worst = surveyed(waiting(path, wait), 1.0, even=64)
    assert math.isnan(leaves_at)
    assert (expected <= worst * (1.002, 1.01, 1.03) + 1e-6).all()


@given(POSES, LEGS_OF_WAY, st.sampled_from([0.005, 0.01, 0.02, 0.1]), st.floats(0.05, 1.0))
def test_no_acceleration_is_greater_than_what_is_found_however_long_a_cycle_is(
    begin: Pose, legs: list[tuple[Pose, Pose, Pose, float]], step: float, quicker: float
) -> None:
    """Also in pieces that are shorter than a cycle. Where peaks between samples are missed, 30 % are lacking."""
    path = stretched(uneven(begin, legs), quicker)
    expected = looked_at(path, 1.0, 4 * round(path.duration / STEP) + 1).worst
    leaves_at, worst = surveyed(path, 1.0, even=64, step=step)
    assert math.isnan(leaves_at)
    assert (expected[:, 1] <= worst[:, 1] * 1.05 + 1e-6).all()


@given(POSES, POSES, st.floats(0.5, 3.0))
def test_a_jerk_that_is_greatest_just_before_the_end_is_seen(begin: Pose, end: Pose, seconds: float) -> None:
    """It grows evenly, from none at the beginning; however far apart the moments are, the last cycle is looked at."""
    assume(math.dist(begin, end) > 1e-3)
    left = Polynomial([seconds, -1.0])
    shape = (left**3 - left**4 / (4.0 * seconds)).coef
    c = np.subtract(begin, end) / (0.75 * seconds**3)
    pieces = np.zeros((1, 3, 6))
    pieces[0, :, :5] = np.outer(c, shape)
    pieces[0, :, 0] += end
    _, worst = surveyed(Path(np.array([0.0, seconds]), pieces), 1.0)
    assert worst[1:4, 2] == pytest.approx(6.0 * np.abs(c), rel=0.01, abs=1e-9)


@given(POSES, POSES, st.integers(0, 4), st.integers(0, 1), st.floats(0.05, 0.95), RATES)
def test_when_a_path_is_first_out_of_reach_is_known_for_every_limit(
    begin: Pose, end: Pose, column: int, side: int, share: float, rate: float
) -> None:
    assume(math.dist(begin, end) > 1e-3)
    path = way(end, begin)
    seen = looked_at(path, rate, 4001)
    places = seen.places[:, COLUMNS[column]]
    outward = (places if side else -places).max(axis=1)
    most = outward.max()
    assume(most - outward[0] > 1e-3)
    limit = outward[0] + share * (most - outward[0])
    box = ANYWHERE.copy()
    box[side, COLUMNS[column]] = limit if side else -limit
    leaves_at, _ = surveyed(path, rate, box)
    first = int(np.argmax(outward > limit))
    assert seen.times[first - 1] - 1e-6 <= leaves_at <= seen.times[first] + 1e-6  # a limit has 1e-9 m of rounding
    box[side, COLUMNS[column]] = (most + 1e-6) * (1.0 if side else -1.0)
    leaves_at, _ = surveyed(path, rate, box)
    assert math.isnan(leaves_at)


@settings(max_examples=150)
@example((0.0, 0.0, -0.3), (0.0, 0.0, 0.3), 2, 1, (0.0, 0.0))
@example((0.0, 0.0, 0.3), (0.0, 0.0, -0.3), 2, 0, (0.0, 0.0))
@given(POSES, POSES, st.integers(0, 4), st.integers(0, 1), TOOLS)
def test_a_turn_beyond_a_limit_between_two_looks_is_seen(
    begin: Pose, middle: Pose, column: int, side: int, tool: tuple[float, float]
) -> None:
    """By however little more than rounding it is beyond."""
    path = there_and_back(begin, middle, tool)
    seen = looked_at(path, 1.0, 20001)
    outward = (seen.places[:, COLUMNS[column]] * (1.0 if side else -1.0)).max(axis=1)
    most = outward.max()
    assume(most > max(outward[0], outward[-1]) + 1e-3)
    for room, inside in ((1e-6, True), (-1e-6, False)):
        box = ANYWHERE.copy()
        box[side, COLUMNS[column]] = (most + room) * (1.0 if side else -1.0)
        leaves_at, _ = surveyed(path, 1.0, box)
        assert math.isnan(leaves_at) is inside
        if not inside:
            beyond = seen.times[outward > most + room]
            assert beyond[0] - 2e-4 <= leaves_at <= beyond[-1] + 2e-4


@settings(max_examples=150)
@given(POSES, LEGS_OF_WAY, WAITS, st.integers(0, 4), st.integers(0, 1))
def test_a_turn_of_uneven_pieces_beyond_a_limit_is_seen(
    begin: Pose, legs: list[tuple[Pose, Pose, Pose, float]], wait: float, column: int, side: int
) -> None:
    """Also if a position turns twice between two looks."""
    path = uneven(begin, legs)
    seen = looked_at(path, 1.0, 20001)
    outward = (seen.places[:, COLUMNS[column]] * (1.0 if side else -1.0)).max(axis=1)
    most = outward.max()
    assume(most > max(outward[0], outward[-1]) + 1e-3)
    for room, inside in ((3e-6, True), (-1e-6, False)):
        box = ANYWHERE.copy()
        box[side, COLUMNS[column]] = (most + room) * (1.0 if side else -1.0)
        leaves_at, _ = surveyed(waiting(path, wait), 1.0, box)
        assert math.isnan(leaves_at) is inside
