"""A way too fast for sliders or platform: straight, within limits, and never later there than slowed as a whole."""

from __future__ import annotations

import random
import statistics
from collections.abc import Sequence
from typing import NamedTuple
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
from control_rig import CONFIG
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from trirail.config import geometry
from trirail.errors import RefusedError
from trirail.kinematics.robot import forward, inverse
from trirail.motion.feasibility import SLIDER_PLAN_SHARES, Checker
from trirail.motion.limits import Bounds
from trirail.motion.path_planner import PathPlanner, Plan
from trirail.motion.paths import Path, evaluate
from trirail.motion.ruckig_call import Kinodynamic
from trirail.motion.runs import MotionState, rest

ROBOT = geometry(CONFIG.geometry)
PLATFORM = CONFIG.limits.platform
WEAK = (0.3, 3.0, 50.0)
"""Velocity, acceleration and jerk of sliders for which nearly all motions are too fast."""

Triple = tuple[float, ...]
POSE = st.tuples(st.floats(-0.06, 0.06), st.floats(-0.06, 0.06), st.floats(-0.5, 0.4))
SLIDERS = st.tuples(st.floats(0.05, 1.0), st.floats(0.5, 15.0), st.floats(10.0, 400.0))
SPEED = st.one_of(st.just(1.0), st.floats(0.05, 1.0))

NODES = chebyshev.chebpts2(24)
DERIVATIVES = [
    chebyshev.chebvander(NODES, 9 - n)
    @ chebyshev.chebder(np.eye(10), n)
    @ np.linalg.pinv(chebyshev.chebvander(NODES, 9))
    for n in range(1, 4)
]
"""What turns values at nodes into first to third derivatives there, by way of a polynomial of degree 9."""


class Pair(NamedTuple):
    """A plan, and the one that there would be if paths were only slowed as a whole."""

    plan: Plan
    uniform: Plan


def planner_of(sliders: Sequence[float]) -> PathPlanner:
    velocity, acceleration, jerk = sliders
    slider = msgspec.structs.replace(CONFIG.limits.slider, velocity=velocity, acceleration=acceleration, jerk=jerk)
    limits = msgspec.structs.replace(CONFIG.limits, slider=slider)
    bounds = Bounds(limits, CONFIG.period)
    checker = Checker(ROBOT, limits, bounds, CONFIG.period)
    return PathPlanner(ROBOT, limits.platform, limits.slider, bounds, checker, CONFIG.period)


def to_pose(
    sliders: Sequence[float], start: Triple, target: Triple, speed: float = 1.0, own: Kinodynamic | None = None
) -> Pair:
    planner = planner_of(sliders)
    plan = planner.plan_to_pose(rest(start), target, speed, own)
    with patch("trirail.motion.path_planner.time_optimal", return_value=None):
        return Pair(plan, planner.plan_to_pose(rest(start), target, speed, own))


def to_sliders(sliders: Sequence[float], start: Triple, target: Triple) -> Pair:
    planner = planner_of(sliders)
    plan = planner.plan_to_sliders(rest(start), target)
    with patch("trirail.motion.path_planner.time_optimal", return_value=None):
        return Pair(plan, planner.plan_to_sliders(rest(start), target))


def positions(path: Path) -> NDArray[np.float64]:
    """Return where a path is at the nodes of every piece, (pieces, nodes, 3)."""
    t = np.diff(path.knots)[:, None] * (NODES + 1.0) / 2.0
    found: NDArray[np.float64] = np.einsum("pdk,pnk->pnd", path.pieces, t[:, :, None] ** np.arange(6.0))
    return found


def greatest(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the greatest velocity, acceleration and jerk (3,) of any slider, and of x, y and phi (3, 3), on a path.

    From positions alone, piece by piece: velocities and accelerations of the kinematics have no part in it.
    """
    given = positions(path)
    flat = given.reshape(-1, 3)
    other = (forward(ROBOT, flat) if path.in_sliders else inverse(ROBOT, flat).position).reshape(given.shape)
    sliders, platform = (given, other) if path.in_sliders else (other, given)
    spans = np.diff(path.knots)[:, None, None]

    def rates(values: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = values - values[:, :1]
        return np.array(
            [
                np.abs(np.einsum("mn,pnd->pmd", matrix, moved) * (2.0 / spans) ** (n + 1)).max(axis=(0, 1))
                for n, matrix in enumerate(DERIVATIVES)
            ]
        )

    return rates(sliders).max(axis=1), rates(platform)


def assert_within(path: Path, sliders: Sequence[float], own: Kinodynamic | None = None) -> None:
    platform = own or Kinodynamic(PLATFORM.velocity, PLATFORM.acceleration, PLATFORM.jerk)
    of_sliders, of_platform = greatest(path)
    assert (of_sliders <= sliders).all(), of_sliders / sliders
    assert (of_platform <= np.array(platform) * (1.0 + 1e-4)).all(), of_platform / platform


def assert_straight(path: Path) -> None:
    """The path goes from its begin to its end on the straight line, and never back."""
    at = positions(path).reshape(-1, 3)
    length = path.end - at[0]
    share = (at - at[0]) @ length / (length @ length)
    assert np.abs(at - at[0] - share[:, None] * length).max() < 1e-12
    assert np.diff(share).min() > -1e-9


def assert_joined(path: Path, start: Sequence[float], end: Sequence[float]) -> None:
    """It begins and ends at rest, where it should; position, velocity and acceleration take no step at its knots."""
    assert path.pieces[0, :, 0].tolist() == list(start)
    assert path.end == pytest.approx(end, abs=1e-12)
    powers = np.diff(path.knots)[:, None] ** np.arange(6.0)
    for n, tolerance in enumerate((1e-12, 1e-9, 1e-6)):
        factor = np.array([np.prod([k - i for i in range(n)]) if k >= n else 0.0 for k in range(6)])
        ends = (path.pieces[:, :, n:] * factor[n:] * powers[:, None, : 6 - n]).sum(axis=2)
        begins = path.pieces[:, :, n] * factor[n]
        assert ends[:-1] == pytest.approx(begins[1:], abs=tolerance)
        if n:
            assert not begins[0].any()
            assert ends[-1] == pytest.approx([0.0] * 3, abs=tolerance)


def assert_better(pair: Pair, start: Sequence[float], end: Sequence[float]) -> None:
    """The plan is the one slowed as a whole, to the last bit, or sooner there, and straight."""
    plan, uniform = pair
    if plan.path.duration == uniform.path.duration:
        assert plan.reply.slowed == uniform.reply.slowed
        assert np.array_equal(plan.path.pieces, uniform.path.pieces)
        return
    assert plan.path.duration < uniform.path.duration
    asked = uniform.path.duration / uniform.reply.slowed
    assert plan.path.duration >= asked * (1.0 - 1e-9)
    assert plan.reply.slowed == pytest.approx(plan.path.duration / asked)
    assert_straight(plan.path)
    assert_joined(plan.path, start, end)


@settings(max_examples=60)
@given(start=POSE, end=POSE, sliders=SLIDERS, speed=SPEED)
def test_any_sliders(start: Triple, end: Triple, sliders: Triple, speed: float) -> None:
    pair = to_pose(sliders, start, end, speed)
    assert_better(pair, start, end)
    assert pair.plan.reply.slowed >= 1.0 - 1e-12
    if pair.plan.path.duration < pair.uniform.path.duration:
        assert_within(pair.plan.path, sliders)


@settings(max_examples=40)
@given(start=POSE, end=POSE, sliders=SLIDERS)
def test_straight_in_slider_space(start: Triple, end: Triple, sliders: Triple) -> None:
    """There it is the platform that may be too fast."""
    first, last = (tuple(inverse(ROBOT, np.array(pose)).position.tolist()) for pose in (start, end))
    try:
        pair = to_sliders(sliders, start, last)
    except RefusedError as error:
        assume(error.code != "out_of_workspace")
        raise
    assert_better(pair, pair.uniform.path.pieces[0, :, 0].tolist(), last)
    assert first == pytest.approx(pair.plan.path.pieces[0, :, 0].tolist(), abs=1e-12)
    if pair.plan.path.duration < pair.uniform.path.duration:
        assert_within(pair.plan.path, sliders)


def test_sooner_on_weak_sliders() -> None:
    rnd = random.Random(6)
    box = ((-0.06, 0.06), (-0.06, 0.06), (-0.5, 0.4))
    ways = [[tuple(rnd.uniform(*bounds) for bounds in box) for _ in range(2)] for _ in range(30)]
    pairs = [to_pose(WEAK, way[0], way[1]) for way in ways]
    assert statistics.median(pair.plan.path.duration / pair.uniform.path.duration for pair in pairs) < 0.93


@pytest.mark.parametrize("end", [(0.05, -0.02, 0.3), (-0.04, 0.05, -0.3)])
@pytest.mark.parametrize("sliders", [WEAK, (0.05, 3.0, 50.0), (0.3, 0.5, 50.0)])
def test_a_way_comes_close_to_the_limit_that_is_nearest(sliders: Triple, end: Triple) -> None:
    """To half a percent of what plans make use of: else the whole way could be made sooner."""
    plan, uniform = to_pose(sliders, (0.0, 0.0, 0.0), end)
    assert plan.path.duration < uniform.path.duration
    of_sliders, _ = greatest(plan.path)
    assert (of_sliders / sliders).max() > 0.995 * SLIDER_PLAN_SHARES[0]


def test_what_fits_stays_ruckigs() -> None:
    """To the last bit, whatever the way by which others are made sooner."""
    start, end = (0.0, 0.0, 0.0), (0.03, -0.02, 0.1)
    with patch("trirail.motion.path_planner.time_optimal", side_effect=AssertionError):
        plan = planner_of((1.0, 15.0, 400.0)).plan_to_pose(rest(start), end)
    assert plan.reply.slowed == 1.0


@pytest.mark.parametrize("length", [0.0, 1e-12, 1e-8, 1e-6, 1e-4, 1e-2])
@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.6, -0.8, 2.0)])
def test_tiny_and_pure_turns(direction: Triple, length: float) -> None:
    start = (0.02, -0.01, 0.3)
    end = tuple(at + length * way for at, way in zip(start, direction, strict=True))
    weak = (0.02, 0.1, 2.0)
    pair = to_pose(weak, start, end)
    assert_better(pair, start, end)
    if length >= 1e-6:  # below, rounding is all that third derivatives of positions tell
        assert_within(pair.plan.path, weak)


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_a_goals_own_limits_are_kept(share: float) -> None:
    own = Kinodynamic(
        *([share * each for each in of] for of in (PLATFORM.velocity, PLATFORM.acceleration, PLATFORM.jerk))
    )
    pair = to_pose((0.15, 1.0, 15.0), (-0.05, 0.05, -0.4), (0.05, -0.02, 0.3), own=own)
    assert pair.plan.path.duration < pair.uniform.path.duration
    assert_within(pair.plan.path, (0.15, 1.0, 15.0), own)


@settings(max_examples=30)
@given(start=POSE, end=POSE, then=POSE, share=st.floats(0.05, 0.95))
def test_another_goal_on_the_way(start: Triple, end: Triple, then: Triple, share: float) -> None:
    """What begins in motion begins with that motion, or is refused: then the robot stops first."""
    planner = planner_of(WEAK)
    path = planner.plan_to_pose(rest(start), end).path
    out = np.zeros((3, 3))
    evaluate(path.knots, path.pieces, share * path.duration, out)
    state = MotionState(*out.tolist())
    try:
        plan = planner.plan_to_pose(state, then)
    except RefusedError:
        return
    evaluate(plan.path.knots, plan.path.pieces, 0.0, out)
    assert out == pytest.approx(np.array(state), abs=1e-9)
    assert plan.path.end == pytest.approx(then, abs=1e-7)


def test_the_same_bits_every_time() -> None:
    ways = [to_pose(WEAK, (-0.05, 0.05, -0.4), (0.05, -0.02, 0.3)).plan.path for _ in range(2)]
    assert ways[0].knots.tobytes() == ways[1].knots.tobytes()
    assert ways[0].pieces.tobytes() == ways[1].pieces.tobytes()
