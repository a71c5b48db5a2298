"""A path and the law by which its time runs: what they tell of now, of the end and of goals to follow comes true."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
import pytest
from control_rig import CONFIG
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from ruckig import ControlInterface, InputParameter, Ruckig, Synchronization, Trajectory
from trirail.config import geometry
from trirail.kinematics.robot import forward, inverse
from trirail.motion.paths import Path, constant_law, evaluate
from trirail.motion.runs import ZERO_RATES, MotionState, Run, cut, from_ruckig, joined, law_from_ruckig, rest, stretched
from trirail.motion.schedule import Schedule

PERIOD = CONFIG.period
ROBOT = geometry(CONFIG.geometry)
HERE = (0.0, 0.0, 0.0)
PLACE = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.3, 0.3))
MOTION = st.tuples(*[st.floats(-0.1, 0.1)] * 3)
SHARE = st.floats(0.0, 1.0)


def ruckig(begin: MotionState, end: Sequence[float]) -> Trajectory:
    request, trajectory = InputParameter(3), Trajectory(3)
    request.current_position, request.target_position = list(begin.pose), list(end)
    request.current_velocity, request.current_acceleration = list(begin.velocity), list(begin.acceleration)
    request.max_velocity, request.max_acceleration, request.max_jerk = [0.25] * 3, [2.0] * 3, [40.0] * 3
    request.synchronization = Synchronization.Phase
    assert Ruckig(3).calculate(request, trajectory) >= 0
    return trajectory


def way(end: Sequence[float], begin: Sequence[float] = HERE, in_sliders: bool = False) -> Path:
    """From rest to rest."""
    return from_ruckig(ruckig(rest(begin), end), in_sliders)


def ramp(rate: float, target: float, s: float = 0.0) -> Trajectory:
    """From one rate to another within jerk and acceleration of time."""
    request, trajectory = InputParameter(1), Trajectory(1)
    request.control_interface = ControlInterface.Velocity
    request.current_position, request.current_velocity, request.target_velocity = [s], [rate], [target]
    request.max_acceleration, request.max_jerk = [8.0], [160.0]
    assert Ruckig(1).calculate(request, trajectory) >= 0
    return trajectory


def at(path: Path, time: float) -> NDArray[np.float64]:
    """Return value, velocity and acceleration (3, d)."""
    out = np.zeros((3, path.pieces.shape[1]))
    evaluate(path.knots, path.pieces, time, out)
    return out


def run_of(path: Path, rate: float = 1.0) -> Run:
    return Run(ROBOT.packed(), path, constant_law(rate), rate)


def until_it_stands(run: Run) -> float:
    """Advance a run as a schedule does, from shortly before its end; return when it stands, in time of its law [s]."""
    run.time = max(run.time, run.end_time - 50 * PERIOD)
    while not run.at_rest:
        run.time += PERIOD
        assert run.time < 60.0
    return run.time


# ---------------------------------------------------------------------- paths


@example(HERE, ZERO_RATES, ZERO_RATES, HERE, 1.0)
@given(PLACE, MOTION, MOTION, PLACE, SHARE)
def test_a_path_is_ruckigs_trajectory(
    pose: tuple[float, float, float],
    velocity: tuple[float, float, float],
    acceleration: tuple[float, float, float],
    end: tuple[float, float, float],
    share: float,
) -> None:
    trajectory = ruckig(MotionState(pose, velocity, acceleration), end)
    path = from_ruckig(trajectory)
    assert path.duration == pytest.approx(max(trajectory.duration, 1e-9))
    time = share * trajectory.duration
    assert at(path, time) == pytest.approx(np.array(trajectory.at_time(time)), abs=1e-6)
    assert at(path, path.duration + 1.0) == pytest.approx(np.array([end, ZERO_RATES, ZERO_RATES]), abs=1e-7)


@given(st.floats(0.0, 2.0), st.sampled_from([0.0, 0.3, 1.0, 2.0]), st.floats(0.0, 3.0), SHARE, st.floats(0.0, 100.0))
def test_a_law_is_ruckigs_change_of_rate_and_then_goes_on(
    rate: float, target: float, s: float, share: float, after: float
) -> None:
    trajectory = ramp(rate, target, s)
    law = law_from_ruckig(trajectory, target)
    time = share * trajectory.duration
    assert at(law, time)[:, 0] == pytest.approx(np.ravel(trajectory.at_time(time)), abs=1e-6)
    (end,), *_ = trajectory.at_time(trajectory.duration)
    later = at(law, trajectory.duration + 1e-6 + after)[:, 0]
    assert later == pytest.approx((end + target * (1e-6 + after), target, 0.0), abs=1e-6)


@given(PLACE, PLACE, st.floats(0.0, 1.2), st.floats(1.0, 5.0), SHARE)
def test_paths_are_joined_cut_and_stretched(
    middle: tuple[float, float, float], end: tuple[float, float, float], upto: float, slower: float, share: float
) -> None:
    first, second = way(middle), way(end, middle)
    both = joined([first, second])
    assert both.duration == pytest.approx(first.duration + second.duration)
    time = share * both.duration
    expected = at(first, time) if time < first.duration else at(second, time - first.duration)
    assert at(both, time) == pytest.approx(expected, abs=1e-9)
    short = cut(both, upto * both.duration)
    assert short.duration == min(upto, 1.0) * both.duration
    inside = share * short.duration
    assert at(short, inside)[:2] == pytest.approx(at(both, inside)[:2], abs=1e-9)
    slow = stretched(both, slower)
    rates = np.array([1.0, slower, slower**2])[:, None]
    assert slow.duration == pytest.approx(slower * both.duration)
    assert at(slow, slower * time)[:2] * rates[:2] == pytest.approx(at(both, time)[:2], abs=1e-7)
    assert at(slow, slower * first.duration / 3.0) * rates == pytest.approx(at(both, first.duration / 3.0), abs=1e-5)


@given(factor=st.floats(1.0, 1e300), rates=st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=6))
def test_a_path_may_be_made_as_slow_as_a_float_can_tell(factor: float, rates: list[float]) -> None:
    """Without a warning; what is too slow to be told stands."""
    path = stretched(Path(np.array([0.0, 1.0]), np.tile(rates, (1, 3, 1))), factor)
    assert np.isfinite(path.pieces).all()
    assert path.pieces[0, 0, 1] == rates[1] / factor


# ---------------------------------------------------------------------- a run


FAR = st.sampled_from([(0.1, 0.0, 0.0), (-0.05, 0.08, 0.3), (0.0, 0.0, -0.4)])


@given(FAR, st.sampled_from([0.1, 0.5, 1.0, 2.0]), SHARE)
def test_what_a_run_tells_of_its_end_is_what_happens(
    end: tuple[float, float, float], rate: float, share: float
) -> None:
    path = way(end)
    run = run_of(path, rate)
    run.time = share * path.duration / rate
    assert run.law_state == pytest.approx((share * path.duration, rate, 0.0))
    assert run.progress == pytest.approx(share, abs=1e-9)
    assert run.remaining == pytest.approx((1.0 - share) * path.duration / rate, abs=1e-6)
    assert run.destination(HERE) == pytest.approx(end, abs=1e-7)
    pose, velocity, acceleration = run.state(0.0, HERE)
    expected = at(path, run.law_state.s)
    assert pose == pytest.approx(expected[0], abs=1e-9)
    assert velocity == pytest.approx(rate * expected[1], abs=1e-9)
    assert acceleration == pytest.approx(rate**2 * expected[2], abs=1e-9)
    ends = run.end_time
    assert until_it_stands(run) == pytest.approx(ends, abs=PERIOD)
    assert run.arrived
    assert run.progress == 1.0
    assert run.remaining == pytest.approx(0.0, abs=1e-9)
    assert run.state(0.0, HERE).velocity == pytest.approx(ZERO_RATES, abs=1e-6)
    run.time += 7.5 * PERIOD
    assert (run.progress, run.remaining) == (1.0, 0.0)


@given(FAR, st.floats(0.05, 0.9), st.sampled_from([0.0, 0.3, 2.0]))
def test_a_change_of_rate_ends_where_and_when_it_is_told_to(
    end: tuple[float, float, float], share: float, target: float
) -> None:
    path = way(end)
    run = run_of(path)
    run.time = share * path.duration
    change = law_from_ruckig(ramp(1.0, target, run.law_state.s), target)
    before = run.state(0.0, HERE)
    run.change_law(change, target)
    assert (run.time, run.target) == (0.0, target)
    assert run.state(0.0, HERE).velocity == pytest.approx(before.velocity, abs=1e-9)
    stops_at = float(at(change, 1e6)[0, 0]) if target == 0.0 else math.inf
    for s in np.linspace(run.law_state.s + 1e-6, path.duration, 5).tolist():
        when = run.arrival_at(s)
        assert math.isinf(when) is (s > stops_at)
        if math.isfinite(when):
            assert at(change, when)[0, 0] == pytest.approx(s, abs=1e-9)
            assert at(change, when - 1e-4)[0, 0] <= s
    left = run.remaining
    if target == 0.0:
        assert left == pytest.approx(path.duration - run.law_state.s)  # at full speed, when it goes on
    else:
        assert left == pytest.approx(run.arrival_at(path.duration))
    ends = run.end_time
    assert until_it_stands(run) == pytest.approx(ends, abs=2.0 * PERIOD)
    assert run.arrived is (stops_at >= path.duration)
    assert run.state(0.0, HERE).velocity == pytest.approx(ZERO_RATES, abs=1e-9)


@given(PLACE)
def test_a_run_in_slider_space_tells_the_platforms_motion(end: tuple[float, float, float]) -> None:
    begin, sliders = inverse(ROBOT, np.array(HERE)).position, inverse(ROBOT, np.array(end)).position
    run = run_of(way(sliders.tolist(), begin.tolist(), in_sliders=True))
    near: Sequence[float] = HERE
    while not run.at_rest:
        state = run.state(0.0, near)
        expected = at(run.path, run.law_state.s)
        motion = inverse(ROBOT, np.array(state.pose), np.array(state.velocity), np.array(state.acceleration))
        assert motion.position == pytest.approx(expected[0], abs=1e-9)
        assert motion.velocity == pytest.approx(expected[1], abs=1e-8)
        assert motion.acceleration == pytest.approx(expected[2], abs=1e-6)
        near = state.pose
        run.time += 20 * PERIOD
    assert run.destination(near) == pytest.approx(forward(ROBOT, sliders, near=np.array(near)).tolist(), abs=1e-9)


def test_a_pose_that_cannot_be_is_not_a_number() -> None:
    run = run_of(way((1.0, 1.0, 1.0), in_sliders=True))  # no platform reaches that far
    assert all(map(math.isnan, run.destination(HERE)))
    run.time = run.path.duration
    assert all(math.isnan(number) for row in run.state(0.0, HERE) for number in row)


# ---------------------------------------------------------------------- goals behind each other


LINE = [(0.05, 0.0, 0.0), (0.05, 0.05, 0.0), (0.0, 0.05, 0.2)]


def chain(blend: float = 0.0) -> tuple[Run, list[float]]:
    """Three goals, each beginning so long before the one before it ends; and the times along the path of the seams."""
    run, seams, begin = run_of(way(LINE[0])), [], LINE[0]
    for end in LINE[1:]:
        seams.append(run.path.duration - blend)
        run.append(seams[-1], way(end, begin))
        begin = end
    return run, seams


def test_goals_behind_each_other_are_told_one_after_the_other() -> None:
    run, seams = chain()
    ends = [*seams, run.path.duration]
    for number, (begin, end) in enumerate(zip([0.0, *seams], ends, strict=True)):
        for share in (0.01, 0.5, 0.99):
            run.time = begin + share * (end - begin)
            assert run.pass_seams() == (1 if number and share == 0.01 else 0)
            assert run.destination(HERE) == pytest.approx(LINE[number], abs=1e-7)
            assert run.progress == pytest.approx(share)
            assert run.remaining == pytest.approx((1.0 - share) * (end - begin), abs=1e-6)
            assert run.end_time == pytest.approx(ends[-1])
    assert not run.seams


def test_a_longer_cycle_passes_several_goals_at_once() -> None:
    run, seams = chain()
    run.time = seams[-1]
    assert run.pass_seams() == 2
    assert run.progress == 0.0


@pytest.mark.parametrize("left", [0, 1])
def test_goals_that_are_dropped_leave_those_before_them(left: int) -> None:
    run, seams = chain(blend=0.01)
    other = run.copy()
    run.drop(left)
    assert len(run.seams) == left
    assert len(other.seams) == 2  # a copy is a run of its own
    end = at(run.path, run.path.duration)
    assert end == pytest.approx(np.array([LINE[left], ZERO_RATES, ZERO_RATES]), abs=1e-7)
    for time in np.linspace(0.0, [*seams][left] - 1e-9, 7):
        assert at(run.path, time) == pytest.approx(at(other.path, time), abs=1e-9)


# ---------------------------------------------------------------------- runs one after the other


def test_a_schedule_goes_from_run_to_run_and_tells_how_long_it_takes() -> None:
    schedule = Schedule(rest(HERE), PERIOD)
    assert schedule.advance() == 0
    assert (schedule.remaining, schedule.last) == (0.0, None)
    first, second = run_of(way(LINE[0])), run_of(way(LINE[1], LINE[0]), 0.5)
    schedule.replace_runs(deque([first, second]))
    assert schedule.last is second
    assert schedule.remaining == pytest.approx(first.end_time + second.end_time)
    first_ends = math.ceil(first.end_time / PERIOD)
    for cycle in range(first_ends):
        left = schedule.remaining
        assert len(schedule.runs) == 2, cycle
        schedule.advance()
        assert left - schedule.remaining == pytest.approx(PERIOD, abs=PERIOD)
    assert list(schedule.runs) == [second]
    assert schedule.commanded.pose == pytest.approx(LINE[0], abs=1e-6)
    for _ in range(math.ceil(second.end_time / PERIOD)):
        assert not second.at_rest
        schedule.advance()
    assert list(schedule.runs) == [second]  # the last one stays, and stands
    assert schedule.commanded.pose == pytest.approx(LINE[1], abs=1e-7)
    assert schedule.commanded.at_rest


@pytest.mark.parametrize("wait", [0, 1, 30])
def test_a_motion_that_was_looked_ahead_for_takes_over_where_it_begins(wait: int) -> None:
    schedule = Schedule(rest(HERE), PERIOD)
    for _ in range(5):
        schedule.advance()
    under_way, _ = chain()
    schedule.replace_runs(deque([under_way]))
    for _ in range(100):
        schedule.advance()
    ahead = schedule.ahead(wait)
    state = under_way.state(wait * PERIOD, HERE)
    assert ahead.commanded.pose == pytest.approx(state.pose, abs=1e-9)
    assert ahead.cycle == schedule.cycle + wait
    assert under_way.time == pytest.approx(100 * PERIOD)  # to look ahead changes nothing
    for _ in range(wait):
        schedule.advance()
    assert schedule.commanded == ahead.commanded  # to the last bit
    later = run_of(way(LINE[2], state.pose))
    schedule.replace_runs(deque([later]))
    assert schedule.last is later
    assert schedule.remaining == pytest.approx(later.end_time)
    looked = schedule.ahead(50)
    for _ in range(50):
        schedule.advance()
    assert later.time == pytest.approx(50 * PERIOD)
    assert looked.commanded.pose == pytest.approx(schedule.commanded.pose, abs=1e-12)
    assert looked.remaining == pytest.approx(schedule.remaining, abs=1e-9)


def test_whatever_changes_the_motion_under_way_makes_it_another_version() -> None:
    """And nothing else does: a motion that goes on as it would have is the one that was planned from."""
    schedule = Schedule(rest(HERE), PERIOD)
    under_way = run_of(way(LINE[0]))
    seen = [schedule.version]

    def another() -> bool:
        seen.append(schedule.version)
        return seen[-1] > seen[-2]

    schedule.replace_runs(deque([under_way, run_of(way(LINE[1]))]))
    assert another()
    for _ in range(20):
        schedule.advance()
    assert not another()
    schedule.change_law(under_way, constant_law(0.5, under_way.law_state.s), 0.5)
    assert another()
    schedule.append(schedule.runs[-1].path.duration, way(LINE[2]))
    assert another()
    schedule.drop(0)
    assert another()
    schedule.stop_on_path()
    assert another()
    assert list(schedule.runs) == [under_way]


def test_a_schedule_tells_of_each_goal_that_ends_on_the_way() -> None:
    schedule = Schedule(rest(HERE), PERIOD)
    run, seams = chain()
    schedule.replace_runs(deque([run]))
    passed = [cycle for cycle in range(round(run.end_time / PERIOD)) if schedule.advance()]
    assert passed == pytest.approx([seam / PERIOD for seam in seams], abs=1.0)
