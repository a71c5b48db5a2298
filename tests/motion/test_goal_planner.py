"""From the motion under way to another goal: begun in motion, after a stop, or where the path before it ends."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from control.test_control import PERIOD, ROBOT, SLOW, assert_within_limits, with_sliders_of
from control_rig import CONFIG, ControlRig, expected_duration
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from motion.test_motion import only_from_rest
from trirail.kinematics.geometry import Geometry
from trirail.motion.feasibility import Checker
from trirail.motion.goal_planner import MIN_REPLAN_RATE, Extension, GoalPlanner
from trirail.motion.limits import Bounds
from trirail.motion.path_planner import PathPlanner
from trirail.motion.runs import rest
from trirail.motion.schedule import Schedule
from trirail.wire.goals import PoseGoal, VelocityGoal
from trirail.wire.packets import Accepted

Pose = tuple[float, float, float]


def accepted(rig: ControlRig, name: str, goal: PoseGoal) -> Accepted:
    answer = rig.send(name, goal)
    assert isinstance(answer, Accepted), answer
    return answer


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


@pytest.mark.parametrize(("override", "stops"), [(0.05, False), (0.01, False), (0.0, True)])
def test_only_from_a_path_that_has_nearly_stopped_the_robot_stops_first(override: float, stops: bool) -> None:
    platform = CONFIG.limits.platform
    jerk = tuple(limit / 200.0 for limit in platform.jerk)  # so that the last of a stop takes many cycles
    slow = msgspec.structs.replace(
        CONFIG, limits=msgspec.structs.replace(CONFIG.limits, platform=msgspec.structs.replace(platform, jerk=jerk))
    )
    rig = ControlRig(slow if stops else CONFIG)
    rig.enable()
    rig.command("override", override or 0.05)
    accepted(rig, "g1", PoseGoal(0.1, 0.0, 0.0))
    rig.cycles(1000)
    if stops:
        rig.command("override", override)
        rig.until(lambda: 0.0 < rig.control.schedule.runs[0].law_state.rate < MIN_REPLAN_RATE)
    assert accepted(rig, "g2", PoseGoal(0.0, 0.02, 0.0)).reply.stops_first is stops
    rig.command("override", 1.0)
    rig.until(rig.holds, 20_000)
    assert rig.outcomes() == [("g1", "preempted"), ("g2", "done")]
    assert_within_limits(rig)


def test_a_goal_that_stops_the_robot_first_stops_it_within_a_share_of_the_path_before_it() -> None:
    """It stands on the old path, at once and not where that leads, and the time to arrival is told to a few cycles."""
    rig = ControlRig(SLOW)
    rig.enable()
    accepted(rig, "g1", PoseGoal(0.08, 0.02, 0.3))
    rig.cycles(400)
    answer = accepted(rig, "g2", PoseGoal(-0.05, 0.05, -0.3))
    assert answer.reply.stops_first
    begun = len(rig.rows)
    schedule = rig.control.schedule
    rig.until(lambda: len(schedule.runs) == 1)
    stood = rig.control.commanded.pose
    assert 0.0 < stood[0] < 0.075
    assert stood[1] / stood[0] == pytest.approx(0.25, abs=1e-6)
    rig.until(rig.holds)
    assert (len(rig.rows) - begun) * PERIOD == pytest.approx(expected_duration(answer), abs=0.03)
    assert_within_limits(rig)


@pytest.mark.parametrize("before", [10, 30, 90])
def test_a_robot_that_stops_first_beyond_a_waiting_goals_seam_is_still_on_its_way(
    monkeypatch: pytest.MonkeyPatch, before: int
) -> None:
    """It passes where the goal that waited would have begun: that ends nothing, for the goal it stops for has begun."""
    monkeypatch.setattr(GoalPlanner, "_plan_from_motion", only_from_rest)
    rig = ControlRig()
    rig.enable()
    accepted(rig, "q0", PoseGoal(0.05, 0.0, 0.0, blend=0.03))
    accepted(rig, "q1", PoseGoal(0.1, 0.05, 0.0))
    run = rig.control.schedule.runs[0]
    seam = run.seams[0].s
    rig.until(lambda: run.law_state.s > seam - before * PERIOD)
    assert accepted(rig, "g2", PoseGoal(0.0, -0.05, 0.2)).reply.stops_first
    rig.until(lambda: rig.control.schedule.runs[0].law_state.s > seam)
    rig.cycles(2)
    assert rig.control.ledger.goal is not None
    assert rig.control.ledger.goal.id == "g2"
    rig.until(rig.holds)
    assert rig.outcomes() == [("q0", "preempted"), ("q1", "preempted"), ("g2", "done")]
    assert rig.control.commanded.pose == pytest.approx((0.0, -0.05, 0.2), abs=1e-9)


@pytest.mark.parametrize("blend", [0.0, 0.01, 1.0])
@pytest.mark.parametrize("passed", [0.0, 0.4, 0.999])
def test_a_goal_follows_from_where_the_path_comes_near_its_end_and_is_ahead(blend: float, passed: float) -> None:
    """Not before it, by more than a hair; nor where the path has been, or will be before the answer comes."""
    goals, lead = GoalPlanner(ROBOT, CONFIG.limits, PERIOD), 3
    run = goals.plan(PoseGoal(0.02, 0.0, 0.0), Schedule(rest((0.0, 0.0, 0.0)), PERIOD), 1.0, lead).run
    run.time = passed * run.path.duration
    extension = goals.append(PoseGoal(0.02, 0.02, 0.0), run, blend, lead)
    assert isinstance(extension, Extension)
    soonest = min(run.time + lead * PERIOD, run.path.duration)
    assert soonest - 1e-12 <= extension.s <= run.path.duration
    run.time = extension.s
    left = 0.02 - run.state(0.0, (0.0, 0.0, 0.0)).pose[0]
    assert left <= blend + 1e-9
    if extension.s > soonest + 1e-9:
        assert left == pytest.approx(blend, abs=1e-6)
    assert extension.reply.slowed == 1.0


def test_behind_a_goal_at_override_zero_another_one_is_planned_at_full_speed() -> None:
    """At which rate the two will run is not known yet."""
    goals = GoalPlanner(ROBOT, CONFIG.limits, PERIOD)
    run = goals.plan(PoseGoal(0.05, 0.0, 0.0), Schedule(rest((0.0, 0.0, 0.0)), PERIOD), 0.0, 3).run
    assert run.target == 0.0
    behind = goals.append(PoseGoal(0.0, 0.0, 0.0), run, 0.0, 3)
    assert behind.reply.slowed == 1.0
    assert (behind.s, behind.path.duration) == pytest.approx((run.path.duration,) * 2, abs=1e-4)


# ---------------------------------------------------------------------- what is planned


def test_a_jog_holds_its_velocity_for_as_long_as_it_may_last_at_the_greatest_override() -> None:
    """Twice its time-out: time along the path runs at up to twice its rate, and the control ends the jog."""
    goals = GoalPlanner(ROBOT, CONFIG.limits, PERIOD)
    jog = VelocityGoal(0.02, 0.0, 0.0, timeout=0.5)
    path = goals.plan(jog, Schedule(rest((0.0, 0.0, 0.0)), PERIOD), 1.0, 3).run.path
    held = np.abs(path.pieces[:, 0, 1] - 0.02) + np.abs(path.pieces[:, 0, 2:]).sum(axis=1) < 1e-9
    assert np.diff(path.knots)[held].sum() == pytest.approx(1.0, abs=1e-6)


@example(kind=0, sign=1.0, magnitude=-6.0, share=1.0)
@example(kind=0, sign=1.0, magnitude=math.log10(5e-3), share=1.0)
@example(kind=0, sign=1.0, magnitude=-3.0, share=0.1)
@given(
    kind=st.integers(0, 2),
    sign=st.sampled_from([1.0, -1.0]),
    magnitude=st.floats(-8.0, -2.3),
    share=st.sampled_from([1.0, 0.1, 0.03]) | st.floats(0.03, 1.0),
)
def test_a_jog_towards_a_limit_ends_at_the_limit_however_near_it_is(
    kind: int, sign: float, magnitude: float, share: float
) -> None:
    """The limit is 10**magnitude [m, rad] away: the jog is not refused, and has time to reach it."""
    platform, axis = CONFIG.limits.platform, np.eye(3)[kind]
    # 48 mm and 0.1 rad: the sliders permit x, y and phi there
    box = msgspec.structs.replace(platform, x=(-0.048, 0.048), y=(-0.048, 0.048), phi=(-0.1, 0.1))
    goals = GoalPlanner(ROBOT, msgspec.structs.replace(CONFIG.limits, platform=box), PERIOD)
    limit = sign * (0.048, 0.048, 0.1)[kind]
    begin = axis * (limit - sign * 10.0**magnitude)
    x, y, phi = (sign * share * platform.velocity[kind] * axis).tolist()
    plan = goals.plan(VelocityGoal(x, y, phi, timeout=2.0), Schedule(rest(begin.tolist()), PERIOD), 1.0, 3)
    assert plan.run.path.end == pytest.approx(axis * limit, abs=5e-9)


@example((0.1, 0.0, 0.0), (0.05, 0.05, -0.3), 200, (0.3, 0.3, 0.3))
@given(
    st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.3, 0.3)),
    st.tuples(st.floats(-0.06, 0.06), st.floats(-0.06, 0.06), st.floats(-0.5, 0.5)),
    st.integers(50, 300),
    st.tuples(*[st.sampled_from([0.3, 0.5, 1.0])] * 3),
)
@settings(max_examples=50)
def test_a_goal_that_preempts_says_how_much_longer_the_sliders_make_it_last(
    velocity: Pose, target: Pose, cycles: int, shares: Pose
) -> None:
    answers, begun = [], []
    for each in (shares, (10.0, 10.0, 10.0)):
        rig = ControlRig(with_sliders_of(each))
        rig.enable()
        rig.send("j1", VelocityGoal(*velocity, timeout=5.0))
        rig.cycles(cycles)
        begun.append(np.concatenate(rig.control.commanded))
        answers.append(accepted(rig, "g1", PoseGoal(*target)))
    held, free = answers
    assume(np.abs(begun[0] - begun[1]).max() < 1e-9 and not held.reply.stops_first and not free.reply.stops_first)
    assert free.reply.slowed == 1.0
    assert held.reply.slowed == pytest.approx(expected_duration(held) / expected_duration(free), rel=1e-6)


# What plans make use of, of the platform's limits along x.
JERK, ACCELERATION = 0.957 * CONFIG.limits.platform.jerk[0], 0.98 * CONFIG.limits.platform.acceleration[0]
CHANGES_AT = 2.0 * ACCELERATION**3 / JERK**2


@pytest.mark.parametrize("distance", [CHANGES_AT, math.nextafter(CHANGES_AT, 1.0), CHANGES_AT + 1e-17])
def test_where_ruckig_changes_its_profile_the_way_takes_no_more_jerk_and_hardly_longer(distance: float) -> None:
    goals = GoalPlanner(ROBOT, CONFIG.limits, PERIOD)
    motion = goals.plan(PoseGoal(distance, 0.0, 0.0), Schedule(rest((0.0, 0.0, 0.0)), PERIOD), 1.0, 3)
    assert np.abs(6.0 * motion.run.path.pieces[:, 0, 3]).max() == pytest.approx(JERK, rel=2e-6)
    assert motion.duration == pytest.approx(4.0 * ACCELERATION / JERK, rel=1e-3)
    assert motion.reply.slowed == 1.0


@pytest.mark.parametrize("far", range(3))
def test_how_near_a_pose_is_counts_the_edge_that_is_farthest_from_the_centre(far: int) -> None:
    """A turn moves that edge most: goals blend where every point of the platform is near enough."""
    a, b, c = (
        replace(leg, edge_point=(2.0 * leg.edge_point[0], 2.0 * leg.edge_point[1])) if number == far else leg
        for number, leg in enumerate(ROBOT.legs)
    )
    limits, robot = CONFIG.limits, Geometry((a, b, c))
    bounds = Bounds(limits, PERIOD)
    checker = Checker(robot, limits, bounds, PERIOD)
    planner = PathPlanner(robot, limits.platform, limits.slider, bounds, checker, PERIOD)
    reach = max(math.hypot(*leg.edge_point) for leg in robot.legs)
    assert planner.distance((0.03, 0.04, 0.2), (0.0, 0.0, 0.1)) == pytest.approx(0.05 + 0.1 * reach)
