"""A change of rate, cycle by cycle: told once, looked at in time, and of the motion that there is."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from control_rig import CONFIG
from motion.test_runs import HERE, run_of, way
from motion.test_time_scaling import SCALING
from trirail.motion.feasibility import PLATFORM_PLAN_SHARES
from trirail.motion.paths import Path
from trirail.motion.quintic import Point, quintic
from trirail.motion.rate_change import RateChange
from trirail.motion.runs import Run, rest, stretched
from trirail.motion.schedule import Schedule

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
