"""A change of rate, cycle by cycle: told once, looked at in time, and of the motion that there is."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from control.test_control import ROBOT, assert_within_limits
from control_rig import CONFIG, ControlRig
from hypothesis import given, settings
from hypothesis import strategies as st
from motion.test_runs import HERE, run_of, way
from motion.test_time_scaling import SCALING
from msgspec.structs import replace
from trirail.config import Config, corrected_geometry
from trirail.kinematics.robot import inverse
from trirail.motion.feasibility import PLATFORM_PLAN_SHARES
from trirail.motion.paths import Path
from trirail.motion.quintic import Point, quintic
from trirail.motion.rate_change import RateChange
from trirail.motion.rules import RULES
from trirail.motion.runs import MotionState, Run, rest, stretched
from trirail.motion.schedule import Schedule
from trirail.motion.time_scaling import TimeScaling
from trirail.wire.goals import PoseGoal, VelocityGoal
from trirail.wire.packets import Accepted

PERIOD = CONFIG.period
FAR = (0.1, 0.0, 0.0)


PLANNED = stretched(way(FAR), PLATFORM_PLAN_SHARES[2] ** (-1.0 / 3.0))
"""A path that takes of the platform's limits what plans do, and no less."""


def of_many_pieces(seconds: float) -> Path:
    """A path to FAR with 400 points: to look at it takes many cycles."""
    times = np.linspace(0.0, seconds, 400)
    share = times / seconds
    x = FAR[0] * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    return quintic([Point(t, (place, 0.0, 0.0)) for t, place in zip(times.tolist(), x.tolist(), strict=True)], HERE)


def begun(*runs: Run, cycles: int = 0) -> Schedule:
    schedule = Schedule(rest(HERE), PERIOD)
    schedule.replace_runs(deque(runs))
    for _ in range(cycles):
        schedule.advance()
    return schedule


def until_made(schedule: Schedule, change: RateChange) -> int:
    """Go on cycle by cycle until the motion has been told of its rate; return how many it took."""
    for number in range(60):
        if change.applied:
            return number
        schedule.advance()
        change.step()
    raise AssertionError("not within 60 cycles")


def test_a_law_that_was_not_looked_at_in_time_is_proposed_anew() -> None:
    """While a goal is planned the motion is left as it is: then the cycle in which its law was to begin is over."""
    schedule = begun(run_of(of_many_pieces(1.0)), cycles=300)
    run = schedule.runs[0]
    change = RateChange(SCALING, schedule, 0.5, PERIOD)
    schedule.advance()
    change.step()
    assert not change.applied  # it takes more than a cycle to look at it
    for _ in range(60):
        schedule.advance()
    assert until_made(schedule, change) > 0
    assert run.target == 0.5


@pytest.mark.parametrize("rate", [0.0, 0.3, 1.0])
def test_a_motion_that_has_not_begun_begins_at_the_new_rate(rate: float) -> None:
    first, second = run_of(way(FAR)), run_of(way(HERE, FAR), 0.6)
    schedule = begun(first, second, cycles=50)
    change = RateChange(SCALING, schedule, rate, PERIOD)
    assert change.step()
    assert (second.law_state.rate, second.target, second.law_state.change) == (rate, rate, 0.0)
    assert first.target == 1.0  # it stops where it is to


def test_a_goal_that_was_slow_by_itself_goes_as_fast_as_it_may_from_where_it_is() -> None:
    """Twice as fast as at half the speed, to the last thousandth; and what lies behind does not count."""
    for slow, cycles in ((2.0, 100), (2.0, 700), (1.5, 300)):
        schedule = begun(run_of(stretched(PLANNED, slow)), cycles=cycles)
        change = RateChange(SCALING, schedule, 2.0, PERIOD)
        until_made(schedule, change)
        assert schedule.runs[0].target == pytest.approx(slow, rel=1e-3)


@pytest.mark.parametrize("rate", [1.005, 1.5, 2.0])
def test_a_rate_that_the_path_cannot_take_is_given_up_at_once(rate: float) -> None:
    schedule = begun(run_of(PLANNED), cycles=100)
    change = RateChange(SCALING, schedule, rate, PERIOD)
    assert until_made(schedule, change) <= 6
    assert schedule.runs[0].target == pytest.approx(1.0, rel=1e-3)


def test_a_stop_that_is_asked_for_again_and_again_is_no_later() -> None:
    taken = []
    for again in (False, True):
        schedule = begun(run_of(way(FAR)), cycles=250)
        change = RateChange(SCALING, schedule, 0.0, PERIOD)
        for number in range(1000):
            if schedule.runs[0].at_rest:
                taken.append(number)
                break
            schedule.advance()
            change.step()
            if again:
                change = RateChange(SCALING, schedule, 0.0, PERIOD)
    assert taken[1] <= taken[0] + 3


# ---------------------------------------------------------------------- a stop is as quick as the speed allows


def of_velocities(factor: float) -> Config:
    """The robot with other velocity limits of the platform, which a motion need not be able to reach."""
    x, y, phi = (factor * velocity for velocity in CONFIG.limits.platform.velocity)
    platform = replace(CONFIG.limits.platform, velocity=(x, y, phi))
    return replace(CONFIG, limits=replace(CONFIG.limits, platform=platform))


def plain_stop(config: Config, motion: MotionState) -> float:
    """The longest stop with constant jerk of a platform coordinate or a slider from its present state [s].

    The acceleration is ended first, where it makes the speed greater.
    """
    platform, slider = config.limits.platform, config.limits.slider
    sliders = inverse(corrected_geometry(config), motion.pose, motion.velocity, motion.acceleration)
    velocities = np.array([*motion.velocity, *sliders.velocity])
    gained = np.array([*motion.acceleration, *sliders.acceleration]) * np.sign(velocities)
    accelerations = np.array([*platform.acceleration, *slider.accelerations])
    jerks = np.array([*platform.jerk, *slider.jerks])
    gained = np.maximum(gained, 0.0)
    speeds = np.abs(velocities) + gained**2 / (2.0 * jerks)
    longs = speeds / accelerations + accelerations / jerks
    stops = np.where(speeds > accelerations**2 / jerks, longs, 2.0 * np.sqrt(speeds / jerks))
    return float((gained / jerks + stops).max())


@settings(max_examples=30)
@given(
    factor=st.sampled_from([1.0, 10.0, 400.0]),
    share=st.floats(-3.0, -0.5).map(lambda power: 10.0**power),
    direction=st.tuples(*3 * [st.floats(-1.0, 1.0)]).filter(lambda way: max(map(abs, way)) > 0.5),
    command=st.sampled_from(["stop", "pause"]),
)
def test_a_stop_takes_no_longer_than_the_speed_of_the_motion_needs(
    factor: float, share: float, direction: tuple[float, float, float], command: str
) -> None:
    """Whatever the robot's velocity limits are, and however slow one of its coordinates is."""
    config = of_velocities(factor)
    rig = ControlRig(config)
    rig.enable()
    most = CONFIG.limits.platform.velocity
    x, y, phi = (share * way * limit for way, limit in zip(direction, most, strict=True))
    assert isinstance(rig.send("jog", VelocityGoal(x, y, phi, timeout=10.0)), Accepted)
    rig.cycles(300)
    least = plain_stop(config, rig.control.commanded)
    rig.order(command)
    took = rig.until(lambda: rig.control.commanded.at_rest) * PERIOD
    assert took <= 1.2 * least + 5 * PERIOD
    assert_within_limits(rig)


@settings(max_examples=60)
@given(
    begun_for=st.one_of(st.integers(1, 60), st.integers(1, 700)),
    factor=st.sampled_from([1.0, 400.0]),
    speed=st.floats(0.02, 1.0),
    share=st.floats(-2.0, 0.0).map(lambda power: 10.0**power),
    command=st.sampled_from(["stop", "pause"]),
)
def test_a_move_can_be_stopped_at_any_time_as_quickly_as_its_present_motion_needs(
    begun_for: int, factor: float, speed: float, share: float, command: str
) -> None:
    """Also while it begins, when the path itself uses the limits; or else it arrives."""
    config = of_velocities(factor)
    rig = ControlRig(config)
    rig.enable()
    goal = PoseGoal(0.05 * share, 0.02 * share, 0.2 * share, speed=speed)
    assert isinstance(rig.send("move", goal), Accepted)
    rig.cycles(begun_for)
    runs = rig.control.schedule.runs
    left = max(0.0, runs[-1].end_time - runs[-1].time) if runs else 0.0  # a motion that has ended may still settle
    least = min(left, plain_stop(config, rig.control.commanded))
    rig.order(command)
    assert rig.until(lambda: rig.control.commanded.at_rest) * PERIOD <= 1.05 * least + 5 * PERIOD
    assert_within_limits(rig)


@settings(max_examples=30)
@given(st.integers(1, 700), st.sampled_from([1.0, 5.0]), st.floats(0.1, 1.0), st.sampled_from(["stop", "pause"]))
def test_a_stop_never_begins_later_for_the_sake_of_a_quicker_one(
    begun_for: int, factor: float, speed: float, command: str
) -> None:
    """By the first rules, only changes were tried that suit full speed."""

    def braking_since(rules: int) -> tuple[int, int]:
        rig = ControlRig(of_velocities(factor))
        if rules == 1:
            rig.control._planner._scaling = TimeScaling(ROBOT, rig.control._planner._scaling._checker, PERIOD, rules)
        rig.enable()
        assert isinstance(rig.send("move", PoseGoal(0.05, 0.02, 0.2, speed=speed)), Accepted)
        rig.cycles(begun_for)
        rig.order(command)
        begun = rig.until(lambda: rig.control.commanded.at_rest or rig.control.schedule.runs[-1].law_state.change < 0.0)
        return begun, begun + rig.until(lambda: rig.control.commanded.at_rest)

    (before, stood_before), (begun, stood) = map(braking_since, (1, RULES))
    assert begun <= before + 1  # a straight stop, which fits almost always, is tried first
    assert stood <= stood_before + 2
