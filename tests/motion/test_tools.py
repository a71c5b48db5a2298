"""A point of the platform goes where the goal says, straight and within its limits; the centre within its own."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control.test_control import PERIOD, ROBOT, SLOW, assert_within_limits
from control_rig import CONFIG, ControlRig
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from refusals import refusal
from trirail.config import Config
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.robot import forward
from trirail.motion.goal_planner import GoalPlanner
from trirail.motion.limits import MAX_RELATIVE_EXCESS
from trirail.motion.packing import pack_path, unpack_path
from trirail.motion.paths import Path, path_motion
from trirail.motion.runs import MotionState, centre_motion, rest, tool_motion
from trirail.motion.schedule import Schedule
from trirail.wire.goals import OwnLimits, PoseGoal, VelocityGoal
from trirail.wire.packets import Accepted, Refused

Tool = tuple[float, float]
Pose = tuple[float, float, float]

TOOLS = st.tuples(*[st.floats(-0.12, 0.12)] * 2)
POSES = st.tuples(st.floats(-0.04, 0.04), st.floats(-0.04, 0.04), st.floats(-0.4, 0.4))
NANOMETRE = 1e-9


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


@pytest.fixture(scope="module")
def goals() -> dict[bool, GoalPlanner]:
    """Planners of the shipped robot, and of one with slow sliders."""
    return {slow: GoalPlanner(ROBOT, config.limits, PERIOD) for slow, config in ((False, CONFIG), (True, SLOW))}


def point(poses: NDArray[np.float64], tool: Tool) -> NDArray[np.float64]:
    """Where a point of the platform is, (N, 2): by complex numbers, as nobody else computes it here."""
    at = poses[:, 0] + 1j * poses[:, 1] + complex(*tool) * np.exp(1j * poses[:, 2])
    return np.stack([at.real, at.imag], axis=1)


def at(pose: Pose, tool: Tool) -> Pose:
    """The pose goal that leaves the platform's centre at a pose."""
    x, y = point(np.array([pose]), tool)[0].tolist()
    return x, y, pose[2]


def planned(goals: GoalPlanner, begin: Pose, goal: PoseGoal) -> NDArray[np.float64]:
    """The poses of every cycle from rest to a goal, and of some cycles before and after."""
    run = goals.plan(goal, Schedule(rest(begin), PERIOD), 1.0, 3).run
    cycles = range(-3, math.ceil(run.end_time / PERIOD) + 3)
    return np.array([run.state(cycle * PERIOD, begin).pose for cycle in cycles])


def setpoints(rig: ControlRig, begun: int) -> NDArray[np.float64]:
    """Run to standstill; return the poses of all setpoints since a cycle, by forward kinematics."""
    rig.until(rig.holds, 20_000)
    return forward(ROBOT, rig.setpoints()[begun:, 0])


def assert_platform_within_limits(poses: NDArray[np.float64], tool: Tool) -> None:
    """A point of the platform, by differences."""
    limits = CONFIG.limits.platform
    rows = np.column_stack([point(poses, tool), poses[:, 2]])
    for limit in (limits.velocity, limits.acceleration, limits.jerk):
        rows = np.diff(rows, axis=0) / PERIOD
        assert (np.abs(rows).max(axis=0) <= np.array(limit) * 1.001).all()


def assert_straight(way: NDArray[np.float64]) -> None:
    along = way[-1] - way[0]
    length = float(np.hypot(*along))
    if length > 1e-6:
        assert np.abs((way - way[0]) @ [-along[1], along[0]]).max() / length < NANOMETRE


# ---------------------------------------------------------------------- the rigid body


@given(st.tuples(POSES, POSES, POSES), TOOLS)
def test_a_point_moves_as_the_rigid_body_does(motion: tuple[Pose, Pose, Pose], tool: Tool) -> None:
    """Against differences of where it is along the parabola that the motion says."""
    h = 1e-4
    p, v, a = np.array(motion)
    t = np.array([-h, 0.0, h])[:, None]
    before, now, after = point(p + v * t + a * t**2 / 2.0, tool)
    pose, velocity, acceleration = tool_motion(MotionState(*motion), tool)
    assert pose[:2] == pytest.approx(now.tolist(), abs=1e-15)
    assert velocity[:2] == pytest.approx(((after - before) / (2.0 * h)).tolist(), abs=1e-8)
    assert acceleration[:2] == pytest.approx(((after - 2.0 * now + before) / h**2).tolist(), abs=1e-7)
    assert (pose[2], velocity[2], acceleration[2]) == (motion[0][2], motion[1][2], motion[2][2])


@given(st.tuples(POSES, POSES, POSES), TOOLS)
def test_from_the_centre_to_a_point_and_back(motion: tuple[Pose, Pose, Pose], tool: Tool) -> None:
    for row, back in zip(motion, centre_motion(tool_motion(MotionState(*motion), tool), tool), strict=True):
        assert back == pytest.approx(row, abs=1e-15)


@given(st.lists(TOOLS, min_size=1, max_size=4), st.floats(0.0, 5.0))
def test_a_path_of_several_tools_is_sent_to_the_last_bit(tools: list[Tool], time: float) -> None:
    pieces = np.random.default_rng(len(tools)).normal(size=(len(tools), 3, 6))
    path = Path(np.arange(len(tools) + 1.0), pieces, False, np.array(tools))
    back = unpack_path(pack_path(path), 3)
    there, here = np.zeros((3, 3)), np.zeros((3, 3))
    path_motion(path.knots, path.pieces, path.tools, time, there)
    path_motion(back.knots, back.pieces, back.tools, time, here)
    assert here.tobytes() == there.tobytes()
    for broken in (path.tools[:0].tolist() + [(0.0, math.nan)] * len(tools), [(0.1, 0.0)] * (len(tools) + 1)):
        with pytest.raises(ValueError, match="a path"):
            unpack_path(pack_path(path._replace(tools=np.array(broken))), 3)


# ---------------------------------------------------------------------- goals


@given(POSES, POSES, TOOLS, st.booleans())
def test_the_tool_goes_straight_within_its_limits_and_the_centre_within_its_own(
    goals: dict[bool, GoalPlanner], begin: Pose, end: Pose, tool: Tool, slow: bool
) -> None:
    poses = planned(goals[slow], begin, PoseGoal(*at(end, tool), tool=tool))
    assert poses[-1] == pytest.approx(end, abs=NANOMETRE)
    assert_straight(point(poses, tool))
    assert_platform_within_limits(poses, tool)
    assert_platform_within_limits(poses, (0.0, 0.0))


@given(POSES, POSES, st.none() | TOOLS, st.booleans())
@example((0.110973, 0.056501, 0.380898), (0.136955, 0.005442, 0.023472), None, False)
@example((0.118839, -0.078274, 0.379732), (0.013187, -0.031977, -0.397632), None, False)
@example((-0.067277, 0.085107, 0.192926), (-0.071368, 0.098751, 0.100579), None, False)
def test_from_rest_every_way_is_straight_in_all_three(
    goals: dict[bool, GoalPlanner], begin: Pose, end: Pose, tool: Tool | None, slow: bool
) -> None:
    """x, y and phi share their time, whichever of them is the slowest in velocity, acceleration and jerk."""
    poses = planned(goals[slow], begin, PoseGoal(*at(end, tool or (0.0, 0.0)), tool=tool))
    rows = np.column_stack([point(poses, tool or (0.0, 0.0)), poses[:, 2]])
    along = rows[-1] - rows[0]
    if np.abs(along).max() > 1e-6:
        shares = (rows - rows[0]) @ along / (along @ along)
        assert np.abs(rows - rows[0] - np.outer(shares, along)).max() < NANOMETRE


@given(POSES, TOOLS, st.floats(-0.4, 0.4), st.booleans())
def test_a_pure_rotation_leaves_the_tool_where_it_is(
    goals: dict[bool, GoalPlanner], begin: Pose, tool: Tool, phi: float, slow: bool
) -> None:
    x, y, _ = at(begin, tool)
    try:
        poses = planned(goals[slow], begin, PoseGoal(x, y, phi, tool=tool))
    except RefusedError as refused:
        if refused.code is not RefusalCode.OUT_OF_WORKSPACE:
            raise
        return
    assert np.hypot(*(point(poses, tool) - (x, y)).T).max() < NANOMETRE
    assert poses[-1, 2] == pytest.approx(phi, abs=NANOMETRE)


@pytest.mark.parametrize("config", [CONFIG, SLOW], ids=["as shipped", "slow sliders"])
@pytest.mark.parametrize("tool", [(0.1, 0.0), (-0.03, 0.11)])
def test_every_setpoint_keeps_the_tool_on_its_line(config: Config, tool: Tool) -> None:
    """To a pose, then a pure rotation there: on every setpoint that is sent, also by a robot with slow sliders."""
    rig = ControlRig(config)
    rig.enable()
    x, y, phi = at((0.03, -0.02, 0.3), tool)
    for number, turned in enumerate((phi, -0.2)):
        begun = len(rig.rows) - 1
        assert isinstance(rig.send(f"g{number}", PoseGoal(x, y, turned, tool=tool)), Accepted)
        solved = setpoints(rig, begun)
        assert_straight(point(solved, tool))
        assert [*point(solved, tool)[-1], solved[-1, 2]] == pytest.approx([x, y, turned], abs=NANOMETRE)
    assert np.hypot(*(point(solved, tool) - (x, y)).T).max() < NANOMETRE
    assert rig.outcomes() == [("g0", "done"), ("g1", "done")]
    assert_within_limits(rig)


@pytest.mark.parametrize("config", [CONFIG, SLOW], ids=["as shipped", "slow sliders"])
@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.4), (0.02, -0.01, 0.4), (0.02, -0.01, 0.0)])
def test_a_jog_of_a_tool_turns_about_it_and_takes_it_straight(config: Config, velocity: Pose) -> None:
    """On every setpoint: while it begins, is renewed, and is let go."""
    rig, tool = ControlRig(config), (-0.03, 0.11)
    rig.enable()
    begun = len(rig.rows) - 1
    for now in (velocity, velocity, (0.0, 0.0, 0.0)):
        assert isinstance(rig.send("j1", VelocityGoal(*now, timeout=0.5, tool=tool)), Accepted)
        rig.cycles(150)
    solved = setpoints(rig, begun)
    way = point(solved, tool)
    assert_straight(way)
    along = way[-1] - way[0]
    assert np.hypot(*along) < NANOMETRE if not any(velocity[:2]) else along @ velocity[:2] > 0.002 * 0.02
    assert (solved[-1, 2] > 0.05) == (velocity[2] > 0.0)
    assert_platform_within_limits(solved, tool)
    assert_within_limits(rig)


def test_a_jog_of_a_far_tool_is_as_slow_as_the_centre_has_to_be(rig: ControlRig) -> None:
    rig.enable()
    begun = len(rig.rows) - 1
    rate = 0.9 * CONFIG.limits.platform.velocity[2]
    answer = rig.send("j1", VelocityGoal(0.0, 0.0, rate, timeout=0.1, tool=(0.5, 0.0)))
    assert isinstance(answer, Accepted)
    assert answer.reply.slowed > 1.1
    rig.cycles(200)
    assert_platform_within_limits(setpoints(rig, begun), (0.0, 0.0))


def test_a_far_tool_turns_as_fast_as_the_centre_may_go(goals: dict[bool, GoalPlanner]) -> None:
    """About a point 0.5 m away the centre's own limit is the nearer one."""
    poses = planned(goals[False], (0.0, 0.0, 0.0), PoseGoal(0.5, 0.0, 0.2, tool=(0.5, 0.0)))
    speed = np.abs(np.diff(poses[:, 1])).max() / PERIOD
    assert 0.85 * CONFIG.limits.platform.velocity[1] < speed <= CONFIG.limits.platform.velocity[1]
    assert_platform_within_limits(poses, (0.0, 0.0))


def test_own_limits_are_those_of_the_tool(goals: dict[bool, GoalPlanner]) -> None:
    tool, own = (0.1, 0.0), (0.02, 0.02, 0.1)
    limits = OwnLimits(velocity=own, acceleration=(0.5, 0.5, 3.0), jerk=(10.0, 10.0, 75.0))
    goal = PoseGoal(0.15, 0.0, 0.2, tool=tool, limits=limits)
    poses = planned(goals[False], (0.0, 0.0, 0.0), goal)
    speed = np.abs(np.diff(np.column_stack([point(poses, tool), poses[:, 2]]), axis=0)).max(axis=0) / PERIOD
    assert 0.99 < max(speed / own) <= 1.001


def test_out_of_the_workspace_is_where_the_centre_would_be(rig: ControlRig) -> None:
    rig.enable()
    assert isinstance(rig.send("g1", PoseGoal(0.2, 0.0, 0.0, tool=(0.1, 0.0))), Accepted)
    rig.until(rig.holds)
    refused = refusal(rig.send("g2", PoseGoal(0.1, 0.0, 0.0, tool=(-0.1, 0.0))))
    assert (refused.code, refused.limit) == ("out_of_workspace", 0.15)
    assert refused.value == pytest.approx(0.2)


# ---------------------------------------------------------------------- from motion


def states(rig: ControlRig, cycles: int) -> list[MotionState]:
    found = []
    for _ in range(cycles):
        rig.cycle()
        found.append(rig.control.commanded)
    return found


def assert_continuous(found: list[MotionState]) -> None:
    """Position, velocity and acceleration of the centre go on as their derivatives say, within the platform's jerk."""
    limits = CONFIG.limits.platform
    rows = np.array(found)
    jerk = np.array(limits.jerk) * (1.0 + MAX_RELATIVE_EXCESS) * PERIOD
    between = (rows[1:, 1] + rows[:-1, 1]) / 2.0 * PERIOD
    assert (np.abs(np.diff(rows[:, 0], axis=0) - between) <= jerk * PERIOD**2).all()
    assert (
        np.abs(np.diff(rows[:, 1], axis=0)) <= np.array(limits.acceleration) * (1.0 + MAX_RELATIVE_EXCESS) * PERIOD
    ).all()
    assert (np.abs(np.diff(rows[:, 2], axis=0)) <= jerk).all()


@settings(max_examples=8)
@example([((0.0, 0.03125, 0.0), None, 0.01, 0), ((0.0, 0.0, 0.0), None, None, 37)], CONFIG, ("pause", None))
@given(
    st.lists(
        st.tuples(POSES, st.none() | TOOLS, st.none() | st.sampled_from([0.0, 0.01, 0.03]), st.integers(0, 300)),
        min_size=2,
        max_size=3,
    ),
    st.sampled_from([CONFIG, SLOW]),
    st.sampled_from([None, ("override", 0.4), ("override", 1.7), ("pause", None), ("stop", None)]),
)
def test_from_tool_to_tool_in_motion_nothing_jumps(
    goals: list[tuple[Pose, Tool | None, float | None, int]], config: Config, order: tuple[str, float | None] | None
) -> None:
    """Goals that preempt and goals that blend, each with a tool of its own, and a change of rate on the way."""
    rig = ControlRig(config)
    rig.enable()
    found = [rig.control.commanded]
    for number, (pose, tool, blend, wait) in enumerate(goals):
        rig.post(f"g{number}", PoseGoal(*at(pose, tool or (0.0, 0.0)), tool=tool, blend=blend))
        found += [rig.control.commanded, *states(rig, wait)]
    if order:
        rig.order(*order)
        found += [rig.control.commanded, *states(rig, 200)]
        if order[0] == "pause" and rig.control.state.paused:
            rig.order("resume")
            found.append(rig.control.commanded)
    while not (rig.holds() and rig.control.goal_queue.idle):
        found += states(rig, 1)
        assert rig.control.fault is None
        assert len(found) < 30_000
    assert_continuous(found)
    assert_within_limits(rig)
    assert len(rig.outcomes()) == len(goals)
    if not order and rig.outcomes()[-1] == (f"g{len(goals) - 1}", "done"):
        # From motion Ruckig's own ends are off by up to ten nanometres.
        assert rig.control.commanded.pose == pytest.approx(goals[-1][0], abs=2e-8)


def test_a_coordinate_that_hardly_moves_bounds_nothing(goals: dict[bool, GoalPlanner]) -> None:
    poses = planned(goals[False], (0.0, 0.0, 0.0), PoseGoal(1e-310, 0.05, -1e-200))
    assert poses[-1] == pytest.approx((0.0, 0.05, 0.0), abs=NANOMETRE)


@pytest.mark.parametrize("arm", [0.1, 0.3, 0.5])
def test_a_jog_about_a_tool_reaches_the_velocity_that_limits_allow(rig: ControlRig, arm: float) -> None:
    """Only the ramp has too much jerk for the sliders: it is softer, the velocity stays."""
    rig.enable()
    asked = 0.3 * rig.config.limits.platform.velocity[2]
    answer = rig.send("turn", VelocityGoal(0.0, 0.0, asked, timeout=0.3, tool=(arm, 0.0)))
    assert isinstance(answer, Accepted)
    assert answer.reply.slowed == 1.0
    fastest = 0.0
    while not rig.holds():
        rig.cycle()
        fastest = max(fastest, rig.control.commanded.velocity[2])
    assert fastest == pytest.approx(asked)
    assert rig.control.fault is None
    assert_within_limits(rig)


def test_a_jog_that_cannot_move_is_refused_with_the_limit(rig: ControlRig) -> None:
    rig.enable()
    rig.goal("there", rig.config.limits.platform.x[1], 0.0, 0.0)
    rig.until(rig.holds)
    answer = rig.send("out", VelocityGoal(0.02, 0.0, 0.0, timeout=0.1))
    assert isinstance(answer, Refused)
    assert answer.code == "out_of_workspace"
    assert "limit of platform x (position 150 mm)" in answer.message
    assert rig.holds()
    assert isinstance(rig.send("in", VelocityGoal(-0.02, 0.0, 0.0, timeout=0.1)), Accepted)
