"""Trajectories begin as the robot moves and end at rest, or are refused with what would be right."""

from __future__ import annotations

import math
import re

import msgspec
import numpy as np
import pytest
from control.test_control import PERIOD, ROBOT, assert_within_limits
from control_rig import CONFIG, ControlRig, expected_duration
from hypothesis import example, given, settings
from hypothesis import strategies as st
from refusals import refusal
from trirail.errors import RefusedError
from trirail.motion.feasibility import Checker, slowdown_factor
from trirail.motion.limits import Bounds
from trirail.motion.path_planner import PathPlanner
from trirail.motion.quintic import Point, quintic
from trirail.motion.runs import rest, stretched
from trirail.wire.goals import PoseGoal, TrajectoryGoal, TrajectoryPoint
from trirail.wire.kinds.trajectory import MAX_DURATION_S
from trirail.wire.packets import Accepted
from trirail.wire.vocabulary import Mode

STILL = (0.0, 0.0, 0.0)


def line(first: tuple[float, float, float] | None, last: tuple[float, float, float] | None) -> TrajectoryGoal:
    """Return 0.05 m along x in a second, with the velocities given at its ends."""
    return TrajectoryGoal(
        (TrajectoryPoint(0.0, 0.0, 0.0, 0.0, velocity=first), TrajectoryPoint(1.0, 0.05, 0.0, 0.0, velocity=last))
    )


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


@pytest.mark.parametrize("stretch", [False, True])
@pytest.mark.parametrize(
    ("goal", "code", "said"),
    [
        (line((0.1, 0.0, 0.0), None), "wrong_start", "the trajectory begins with 100 mm/s in x: let it begin"),
        (line(None, (0.1, 0.0, 0.0)), "wrong_end", "the trajectory ends with 100 mm/s in x: let it end at rest"),
        (line(None, (0.0, 0.0, -0.2)), "wrong_end", "the trajectory ends with -11.4592°/s in phi: let it end at rest"),
    ],
)
def test_an_end_that_moves_is_refused(
    rig: ControlRig, goal: TrajectoryGoal, code: str, said: str, stretch: bool
) -> None:
    rig.enable()
    answer = refusal(rig.send("g1", TrajectoryGoal(goal.points, stretch=stretch)))
    assert answer.code == code
    assert said in answer.message
    assert answer.limit == 0.0
    rig.cycles(20)
    assert rig.control.commanded.at_rest


def test_one_that_is_sent_in_motion_is_told_to_wait(rig: ControlRig) -> None:
    rig.enable()
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0))
    rig.cycles(100)
    x = rig.control.commanded.pose[0]
    points = TrajectoryPoint(0.0, x, 0.0, 0.0), TrajectoryPoint(1.0, 0.0, 0.0, 0.0)
    answer = refusal(rig.send("g2", TrajectoryGoal(points)))
    assert answer.code == "wrong_start"
    assert "the robot is moving: send the trajectory when the robot is at rest" in answer.message


@given(st.floats(0.03, 0.4), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.3, 0.3))
def test_one_that_is_too_fast_is_accepted_in_the_time_that_its_refusal_names(
    duration: float, x: float, y: float, phi: float
) -> None:
    rig = ControlRig()
    rig.enable()

    def within(seconds: float) -> TrajectoryGoal:
        return TrajectoryGoal((TrajectoryPoint(0.0, 0.0, 0.0, 0.0), TrajectoryPoint(seconds, x, y, phi)))

    answer = rig.send("g1", within(duration))
    if isinstance(answer, Accepted):
        return
    named = re.search(r"let it last ([0-9.]+) s", refusal(answer).message)
    assert named
    assert isinstance(rig.send("g2", within(float(named[1]))), Accepted)


@example(1e-3, 2e-4, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1e-9)
@example(1e-3, 2e-4, (0.0, 0.0, 0.0), (0.25, 0.0, 0.0), 1e-9)
@given(
    st.sampled_from([1e-3, 0.01, 0.1]),
    st.floats(1e-4, 5e-3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    st.sampled_from([1e-3, 1e-6, 1e-9]),
)
@settings(max_examples=200)
def test_the_time_that_a_refusal_names_is_accepted_also_if_it_is_shorter_than_a_cycle(
    period: float,
    duration: float,
    way: tuple[float, float, float],
    acceleration: tuple[float, float, float],
    scale: float,
) -> None:
    limits = CONFIG.limits
    planner = PathPlanner(
        ROBOT,
        limits.platform,
        limits.slider,
        Bounds(limits, period),
        Checker(ROBOT, limits, Bounds(limits, period), period),
        period,
    )
    end = scale * np.array(way)
    begins = 20.0 * period * np.array(acceleration) * limits.platform.jerk

    def within(seconds: float) -> list[Point]:
        begin = (begins * (duration / seconds) ** 2).tolist()
        still = (0.0, 0.0, 0.0)
        return [Point(0.0, still, still, begin), Point(seconds, end.tolist(), still, still)]

    try:
        planner.plan_trajectory(rest((0.0, 0.0, 0.0)), within(duration), stretch=False)
    except RefusedError as error:
        named = re.search(r"let it last ([0-9.]+) s", str(error))
        assert named
        planner.plan_trajectory(rest((0.0, 0.0, 0.0)), within(float(named[1])), stretch=False)


SPEED = st.floats(-0.5, 0.5)
SCALE = st.sampled_from((1.0, 1e-3, 1e-6, 1e-9))


@settings(max_examples=40)
@given(st.tuples(SPEED, SPEED, SPEED), st.tuples(SPEED, SPEED, SPEED), st.booleans(), SCALE)
def test_whatever_its_ends_the_setpoints_stay_within_the_limits(
    first: tuple[float, float, float], last: tuple[float, float, float], stretch: bool, scale: float
) -> None:
    """The smallest velocities, that may be rounding, among them."""
    rig = ControlRig()
    rig.enable()
    points = line(*(tuple(scale * v for v in ends) for ends in (first, last))).points  # type: ignore[arg-type]
    rig.send("g", TrajectoryGoal(points, stretch=stretch))
    rig.until(rig.holds, 20_000)
    rig.send("back", PoseGoal(0.0, 0.0, 0.0))
    rig.until(rig.holds)
    assert rig.control.fault is None
    assert_within_limits(rig)


SHARE = st.floats(-1.2, 1.2)
"""Acceleration at an end, as a share of that which the jerk limit allows in one cycle."""


@settings(max_examples=60)
@example(first=(0.0224 / 0.04, 0.0, 0.0), last=(0.0, 0.0, 0.0), seconds=0.18, way=0.0029)
@example(first=(0.0, 0.0, 0.0), last=(-0.0355 / 0.04, 0.0, 0.0), seconds=0.169, way=0.0025)
@given(st.tuples(SHARE, SHARE, SHARE), st.tuples(SHARE, SHARE, SHARE), st.floats(0.05, 0.6), st.floats(-0.01, 0.01))
def test_whatever_its_accelerations_at_rest_the_setpoints_stay_within_the_limits(
    first: tuple[float, float, float], last: tuple[float, float, float], seconds: float, way: float
) -> None:
    rig = ControlRig()
    rig.enable()
    jerk = CONFIG.limits.platform.jerk
    begin, end = (
        tuple(share * limit * PERIOD for share, limit in zip(each, jerk, strict=True)) for each in (first, last)
    )
    still = {"velocity": (0.0, 0.0, 0.0)}
    points = (
        TrajectoryPoint(0.0, 0.0, 0.0, 0.0, acceleration=begin, **still),  # type: ignore[arg-type]
        TrajectoryPoint(seconds, way, 0.0, 0.0, acceleration=end, **still),  # type: ignore[arg-type]
    )
    rig.send("g", TrajectoryGoal(points))
    rig.until(rig.holds, 20_000)
    assert rig.control.fault is None
    assert_within_limits(rig)


@given(
    st.sampled_from((0.3, 0.5, 1.0)),
    st.floats(-1.0, 1.0),
    st.floats(-1.0, 1.0),
    st.integers(0, 2),
    st.sampled_from((0.0, 0.005, 0.02)),
)
def test_one_with_accelerations_at_rest_is_stretched_until_it_fits(
    seconds: float, first: float, last: float, coordinate: int, way: float
) -> None:
    """As little as possible: the jerk at an end is the acceleration over one cycle, and becomes less by the square."""
    scale = 1.0 / CONFIG.limits.platform.velocity[0]
    poses, accelerations = np.zeros((2, 3)), np.zeros((2, 3))
    factor = CONFIG.limits.platform.velocity[coordinate] * scale
    poses[1, coordinate], accelerations[:, coordinate] = factor * way, np.multiply(factor, (first, last))
    points = [
        Point(t, p, STILL, a) for t, p, a in zip((0.0, seconds), poses.tolist(), accelerations.tolist(), strict=True)
    ]
    bounds = Bounds(CONFIG.limits, PERIOD)
    checker = Checker(ROBOT, CONFIG.limits, bounds, PERIOD)
    platform, slider = CONFIG.limits.platform, CONFIG.limits.slider
    plan = PathPlanner(ROBOT, platform, slider, bounds, checker, PERIOD).plan_trajectory(rest(STILL), points, True)
    assert slowdown_factor(checker.worst_shares(plan.path, STILL)) <= 1.0
    if plan.reply.slowed > 1.01:
        quicker = stretched(plan.path, 1.0 / 1.01)
        assert slowdown_factor(checker.worst_shares(quicker, STILL)) > 1.0


@example(magnitude=-5.0, seconds=1e-3, stretch=True)
@example(magnitude=-6.0, seconds=1.0, stretch=False)
@given(magnitude=st.floats(-8.0, -5.7) | st.floats(-5.6, -4.0), seconds=st.floats(1e-3, 10.0), stretch=st.booleans())
def test_no_trajectory_is_stretched_beyond_the_longest_duration(
    magnitude: float, seconds: float, stretch: bool
) -> None:
    """The platform may move by 10**magnitude [m/s]: along 0.1 m, it takes a day at 10**-5.66."""
    platform = msgspec.structs.replace(CONFIG.limits.platform, velocity=(10.0**magnitude,) * 3)
    limits = msgspec.structs.replace(CONFIG.limits, platform=platform)
    bounds = Bounds(limits, PERIOD)
    checker = Checker(ROBOT, limits, bounds, PERIOD)
    planner = PathPlanner(ROBOT, platform, limits.slider, bounds, checker, PERIOD)
    points = [Point(0.0, STILL, STILL, STILL), Point(seconds, (0.1, 0.0, 0.0), STILL, STILL)]
    shortest = 1.875 * 0.1 / 10.0**magnitude  # of a quintic from rest to rest
    if shortest > MAX_DURATION_S:
        with pytest.raises(RefusedError, match=r"would last .* s within its limits: the maximum is 86400 s") as refused:
            planner.plan_trajectory(rest(STILL), points, stretch)
        assert refused.value.limit == MAX_DURATION_S
    elif stretch:
        assert shortest <= planner.plan_trajectory(rest(STILL), points, stretch).path.duration <= MAX_DURATION_S


BEFORE_A_WAIT = (
    ((0.374, 0.25, -0.6, -6.0), (0.774, 0.225, 0.0, 0.0)),
    ((3.965, 0.5134, -0.0198, 1.6855), (6.3015, 0.686, 0.0, 0.0)),
)
"""Time, angle, angular velocity and angular acceleration at points: an acceleration and a turn between the points are
greater than at the points."""


@settings(max_examples=40)
@example(points=BEFORE_A_WAIT[0], wait=120.0)
@example(points=BEFORE_A_WAIT[1], wait=200.0)
@given(
    st.tuples(
        st.tuples(st.floats(0.1, 2.0), st.floats(0.0, 0.8), st.floats(-1.0, 1.0), st.floats(-4.0, 4.0)),
        st.tuples(st.floats(2.1, 4.0), st.floats(0.0, 0.8), st.just(0.0), st.just(0.0)),
    ),
    st.sampled_from((0.0, 20.0, 400.0)),
)
def test_before_a_long_wait_the_setpoints_stay_within_the_limits(
    points: tuple[tuple[float, float, float, float], ...], wait: float
) -> None:
    rig = ControlRig()
    rig.enable()
    rows = [(0.0, 0.0, 0.0, 0.0), *points]
    rows += [(points[-1][0] + wait, points[-1][1], 0.0, 0.0)] if wait else []
    goal = [
        TrajectoryPoint(t, 0.0, 0.0, phi, velocity=(0.0, 0.0, rate), acceleration=(0.0, 0.0, change))
        for t, phi, rate, change in rows
    ]
    answer = rig.send("g", TrajectoryGoal(tuple(goal), stretch=True))
    if isinstance(answer, Accepted):
        rig.cycles(math.ceil(points[-1][0] * answer.reply.slowed / PERIOD))
        assert rig.control.fault is None
        assert_within_limits(rig)
    else:
        assert refusal(answer).code == "out_of_workspace"


def test_rounding_of_a_velocity_is_not_a_motion(rig: ControlRig) -> None:
    rig.enable()
    assert isinstance(rig.send("g1", line((1e-9, 0.0, 0.0), (0.0, -1e-9, 0.0))), Accepted)
    rig.until(rig.holds)
    assert rig.mode is Mode.HOLDING
    assert_within_limits(rig)


def test_an_acceleration_at_an_end_is_bound_by_the_jerk_limit_over_one_cycle(rig: ControlRig) -> None:
    rig.enable()
    most = CONFIG.limits.platform.jerk[0] * PERIOD
    for at in (0, 1):
        for share, taken in ((0.9, True), (1.1, False)):
            accelerations = [STILL, STILL]
            accelerations[at] = (share * most, 0.0, 0.0)
            points = tuple(
                TrajectoryPoint(t, x, 0.0, 0.0, velocity=STILL, acceleration=a)
                for t, x, a in zip((0.0, 1.0), (0.0, 0.04), accelerations, strict=True)
            )
            answer = rig.send(f"g{at}{share}", TrajectoryGoal(points))
            assert isinstance(answer, Accepted) is taken
            rig.until(rig.holds)
            rig.goal(f"back{at}{share}", 0.0, 0.0, 0.0)
            rig.until(rig.holds)
    assert_within_limits(rig)


@pytest.mark.parametrize("coordinate", range(3))
@pytest.mark.generated(*range(10))
def test_no_velocity_between_two_samples_is_above_its_limit(coordinate: int, seed: int) -> None:
    """The points are so many that the samples are about as far apart."""
    rng = np.random.default_rng(seed)
    places = 0.1 * rng.uniform(0.5, 1.0, 61) * (-1.0) ** np.arange(61)
    times, poses, velocities = np.arange(61.0), np.zeros((61, 3)), np.zeros((61, 3))
    places[[0, -1]] = 0.0
    poses[:, coordinate], velocities[1:-1, coordinate] = places, rng.uniform(-0.1, 0.1, 59)
    path = quintic([Point(*row) for row in zip(times, poses.tolist(), velocities.tolist(), strict=True)], STILL)
    t = np.linspace(0.0, 1.0, 1001)
    most = np.abs(path.pieces[:, coordinate, 1:] @ (np.arange(1.0, 6.0)[:, None] * t ** np.arange(5.0)[:, None])).max()
    checker = Checker(ROBOT, CONFIG.limits, Bounds(CONFIG.limits, PERIOD), PERIOD)
    found = checker.worst_shares(path, STILL)[1 + coordinate, 0] * checker.platform_limits[coordinate, 0]
    assert found == pytest.approx(most, rel=2e-3)


PAUSE = st.floats(0.1, 50_000.0)


def after_a_pause(pause: float, x: float, seconds: float) -> TrajectoryGoal:
    """Return a motion along x in so many seconds, which begins after a pause."""
    points = [TrajectoryPoint(t, 0.0, 0.0, 0.0, velocity=STILL, acceleration=STILL) for t in (0.0, pause)]
    return TrajectoryGoal((*points, TrajectoryPoint(pause + seconds, x, 0.0, 0.0)))


@settings(max_examples=20)
@given(PAUSE)
def test_the_end_of_a_long_one_is_checked_like_its_start(pause: float) -> None:
    rig = ControlRig()
    rig.enable()
    assert refusal(rig.send("far", after_a_pause(pause, 0.2, 5.0))).code == "out_of_workspace"
    assert refusal(rig.send("fast", after_a_pause(pause, 0.05, 0.1))).code == "too_fast"
    assert isinstance(rig.send("fits", after_a_pause(pause, 0.05, 1.0)), Accepted)


@settings(max_examples=20)
@given(PAUSE)
def test_the_end_of_a_long_one_bounds_the_override(pause: float) -> None:
    rig = ControlRig()
    rig.enable()
    rig.command("override", 2.0)
    goal = after_a_pause(pause, 0.05, 0.5)
    rate = goal.points[-1].t / expected_duration(rig.send("g", goal))
    assert 1.0 <= rate < 1.5
