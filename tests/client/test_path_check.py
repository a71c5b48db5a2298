"""What the page is told before anything moves: of any pose, and of any file."""

from __future__ import annotations

import dataclasses
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.client import trajectory
from trirail.client.path_check import CheckedPath, check_path, find_obstacle
from trirail.config import SIM, FramesTable, load
from trirail.kinematics.robot import inverse
from trirail.motion.backlash_reserve import planned_limits
from trirail.motion.goal_planner import GoalPlanner
from trirail.motion.limits import Bounds
from trirail.motion.runs import centre_motion, rest
from trirail.motion.schedule import Schedule
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.wire.goals import TrajectoryGoal
from trirail.wire.packed_trajectory import packed
from trirail.workspace.singularity import distance_to_singularity
from trirail.workspace.violations import violations
from trirail_drivers.interface import Triple

TIP, TABLE = (0.02, 0.03), (0.05, 0.02, 0.3)
FRAMES = FramesTable(tool={"tip": TIP}, work={"table": TABLE})
CONFIGURED = DrawnRobot.from_config(load(SIM))
ROBOT = DrawnRobot(CONFIGURED.name, CONFIGURED.geometry, CONFIGURED.limits, CONFIGURED.rate_hz, FRAMES)
BOUNDS = Bounds(ROBOT.limits, 1.0 / ROBOT.rate_hz)
ZERO = (0.0, 0.0, 0.0)
place = st.floats(-0.2, 0.2)


@given(
    st.tuples(place, place, st.floats(-1.5, 1.5)), st.sampled_from([None, "tip"]), st.sampled_from(["base", "table"])
)
def test_a_pose_that_is_out_of_reach_is_never_called_free(
    pose: tuple[float, float, float], tool: str | None, frame: str
) -> None:
    x, y, angle = TABLE if frame == "table" else ZERO
    c, s = math.cos(angle), math.sin(angle)
    of_point = x + c * pose[0] - s * pose[1], y + s * pose[0] + c * pose[1], angle + pose[2]
    centre = centre_motion(rest(of_point), TIP if tool else (0.0, 0.0)).pose
    found = find_obstacle(ROBOT, ZERO, pose, tool, frame)
    permitted = not violations(ROBOT.geometry, ROBOT.limits, np.array(centre)) and not BOUNDS.pose_violation(centre)
    assert permitted or (found and not found.on_way)
    assert find_obstacle(ROBOT, ZERO, pose, "no such", frame)
    assert find_obstacle(ROBOT, ZERO, pose, tool, "no such")


@given(st.sampled_from(range(3)), st.sampled_from([-1.0, 1.0]), st.floats(1e-6, 0.02))
def test_a_limit_of_the_platform_is_an_obstacle_with_its_values(axis: int, sign: float, beyond: float) -> None:
    """Narrower than the reach of the robot, so that no other limit is exceeded first."""
    platform = msgspec.structs.replace(CONFIGURED.limits.platform, x=(-0.05, 0.05), y=(-0.04, 0.04), phi=(-0.3, 0.2))
    limits = msgspec.structs.replace(CONFIGURED.limits, platform=platform)
    robot = dataclasses.replace(ROBOT, limits=limits)
    low, high = (platform.x, platform.y, platform.phi)[axis]
    limit = high if sign > 0.0 else low
    pose = [0.0, 0.0, 0.0]
    pose[axis] = limit + sign * beyond
    outside = (pose[0], pose[1], pose[2])
    found = find_obstacle(robot, ZERO, outside, None, "base")
    assert found is not None
    assert (found.on_way, found.code, found.what) == (False, "platform_position", "xyφ"[axis])
    assert (found.value, found.limit, found.unit) == (pose[axis], limit, "m" if axis < 2 else "rad")
    pose[axis] = limit
    inside = (pose[0], pose[1], pose[2])
    assert find_obstacle(robot, ZERO, inside, None, "base") is None
    # A robot beyond the limit may return, and stay, but not move farther out.
    assert find_obstacle(robot, outside, inside, None, "base") is None
    pose[axis] += 2.0 * sign * beyond
    assert find_obstacle(robot, outside, (pose[0], pose[1], pose[2]), None, "base")


@given(st.floats(-math.tau, math.tau), st.floats(-0.5, 0.5), st.sampled_from([-1, 0, 1]))
def test_an_angle_in_a_frame_is_the_same_after_a_whole_turn(turned: float, phi: float, turns: int) -> None:
    robot = dataclasses.replace(ROBOT, frames=FramesTable(work={"table": (0.0, 0.0, turned)}))
    assert find_obstacle(robot, ZERO, (0.0, 0.0, phi - turned + turns * math.tau), None, "table") is None


@pytest.mark.parametrize("limit", ["position", "passive", "singularity_margin"])
def test_a_robot_beyond_a_limit_of_its_joints_may_return_but_not_move_farther(limit: str) -> None:
    start, farther = (0.1, 0.02, 0.4), (0.12, 0.024, 0.48)
    limits, motion = CONFIGURED.limits, inverse(ROBOT.geometry, start)
    if limit == "singularity_margin":
        margin = float(distance_to_singularity(ROBOT.geometry, start)) + 0.01
        limits = msgspec.structs.replace(limits, singularity_margin=margin)
    else:
        values = motion.position if limit == "position" else motion.passive_position
        ends = -1.0, float(values.max()) - 1e-4
        limits = msgspec.structs.replace(limits, slider=msgspec.structs.replace(limits.slider, **{limit: ends}))
    robot = dataclasses.replace(ROBOT, limits=limits)
    assert violations(robot.geometry, limits, start)
    assert find_obstacle(robot, start, ZERO, None, "base") is None
    assert find_obstacle(robot, start, start, None, "base") is None
    assert find_obstacle(robot, start, farther, None, "base") is not None


def test_a_path_is_checked_as_the_service_plans_it_with_backlash() -> None:
    limits = CONFIGURED.limits
    slow = msgspec.structs.replace(limits, slider=msgspec.structs.replace(limits.slider, velocity=0.1))
    without = dataclasses.replace(ROBOT, limits=slow)
    robot = dataclasses.replace(without, backlash=(1e-4, 1e-4, 1e-4))
    text = "t,x,y,phi\n0,0,0,0\n0.01,0.05,0,0"
    reserved = check_path(robot, "a.csv", text, True)
    assert not reserved.why
    assert reserved.duration > check_path(without, "a.csv", text, True).duration
    planner = GoalPlanner(robot.geometry, planned_limits(robot.limits, robot.backlash), 1.0 / robot.rate_hz)
    goal = packed(TrajectoryGoal(tuple(trajectory.parse("a.csv", text)), stretch=True))
    assert reserved.duration == planner.plan(goal, Schedule(rest(ZERO), 1.0 / robot.rate_hz), 1.0, 0).duration


rows = st.lists(st.lists(st.one_of(st.floats(-2.0, 2.0).map(str), st.text(max_size=5)), max_size=6).map(",".join))
texts = st.one_of(st.text(), rows.map(lambda lines: "\n".join(["t,x,y,phi", *lines])))


@given(st.sampled_from(["a.csv", "a.json", "", "…"]), texts, st.booleans())
def test_whatever_is_in_a_file_comes_to_an_answer(name: str, text: str, stretch: bool) -> None:
    found = check_path(ROBOT, name, text, stretch)
    assert isinstance(found, CheckedPath)
    assert found.why or (found.duration > 0.0 and len(found.line) > 2)


anywhere = st.tuples(place, place, st.floats(-0.6, 0.6))


@given(st.one_of(st.just(ZERO), anywhere), st.lists(anywhere, max_size=6), st.integers(1, 3), st.booleans())
def test_a_path_that_is_called_free_stays_in_reach(
    first: Triple, others: list[Triple], standing: int, stretch: bool
) -> None:
    """Also one that stands still all the time or at first."""
    poses = [first] * (standing + 1) + others
    lines = [f"{k},{x},{y},{phi}" for k, (x, y, phi) in enumerate(poses)]
    found = check_path(ROBOT, "path.csv", "\n".join(["t,x,y,phi", *lines]), stretch)
    if found.why:
        return
    assert np.allclose(found.line[0], first, atol=1e-9)
    assert np.allclose(found.line[-1], poses[-1], atol=1e-9)
    assert found.slowed == 1.0 or stretch
    for pose in found.line:
        assert not BOUNDS.pose_violation(pose)
        assert not violations(ROBOT.geometry, ROBOT.limits, np.array(pose))
