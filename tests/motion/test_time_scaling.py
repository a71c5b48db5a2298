"""How time runs along a path: its rate changes as quickly as the limits allow, and is no greater than they do."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from conftest import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from motion.test_runs import FAR, HERE, ROBOT, at, run_of, way
from trirail.motion.feasibility import Checker
from trirail.motion.limits import Bounds
from trirail.motion.runs import Rate, stretched
from trirail.motion.time_scaling import TimeScaling

PERIOD = CONFIG.period
LIMITS = CONFIG.limits
SCALING = TimeScaling(ROBOT, LIMITS.platform, Checker(ROBOT, LIMITS, Bounds(LIMITS, PERIOD), PERIOD), PERIOD)
CHANGE = min(a / v for a, v in zip(LIMITS.platform.acceleration, LIMITS.platform.velocity, strict=True))
JERK = min(j / v for j, v in zip(LIMITS.platform.jerk, LIMITS.platform.velocity, strict=True))
"""What brakes a motion at full speed within the platform's limits of acceleration and jerk [1/s², 1/s³]."""
RATE = st.sampled_from([0.0, 0.3, 1.0, 2.0])
SHARE = st.floats(0.01, 1.0)


def braking(by: float, most: float, jerk: float) -> float:
    """Return how long a rate takes to change by so much, from no change to none [s]."""
    return by / most + most / jerk if by > most**2 / jerk else 2.0 * math.sqrt(by / jerk)


@given(RATE, RATE, SHARE)
def test_a_rate_changes_as_quickly_as_a_motion_at_full_speed_may(rate: float, target: float, share: float) -> None:
    law = SCALING.ramp(Rate(0.3, rate, 0.0), target, share)
    assert law is not None
    ends = float(law.knots[-2])
    assert ends == pytest.approx(braking(abs(target - rate), share * CHANGE, share * JERK), abs=1e-6)
    changes = [at(law, time)[2, 0] for time in np.linspace(0.0, ends, 200)]
    assert np.abs(changes).max() <= share * CHANGE * (1.0 + 1e-9)
    assert np.abs(6.0 * law.pieces[:, 0, 3]).max() <= share * JERK * (1.0 + 1e-9)
    assert at(law, ends + 1e-6)[1:, 0] == pytest.approx((target, 0.0), abs=1e-9)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), SHARE)
def test_to_raise_a_rate_takes_as_long_as_to_lower_it(by: float, changing: float, share: float) -> None:
    """Also where it is changing already, faster than this share would have it."""
    change = changing * CHANGE
    up = SCALING.ramp(Rate(0.0, 1.0 - by / 2.0, change), 1.0 + by / 2.0, share)
    down = SCALING.ramp(Rate(0.0, 1.0 + by / 2.0, -change), 1.0 - by / 2.0, share)
    assert up is not None
    assert down is not None
    assert up.knots[-2] == pytest.approx(down.knots[-2], abs=1e-6)


@pytest.mark.parametrize("coordinate", range(3))
@pytest.mark.parametrize("quantity", ["acceleration", "jerk"])
def test_the_coordinate_that_can_brake_least_decides(coordinate: int, quantity: str) -> None:
    weaker = list(getattr(LIMITS.platform, quantity))
    weaker[coordinate] /= 4.0
    platform = msgspec.structs.replace(LIMITS.platform, **{quantity: tuple(weaker)})
    limits = msgspec.structs.replace(LIMITS, platform=platform)
    scaling = TimeScaling(ROBOT, platform, Checker(ROBOT, limits, Bounds(limits, PERIOD), PERIOD), PERIOD)
    law = scaling.ramp(Rate(0.0, 1.0, 0.0), 0.0, 1.0)
    assert law is not None
    most = min(a / v for a, v in zip(platform.acceleration, platform.velocity, strict=True))
    jerk = min(j / v for j, v in zip(platform.jerk, platform.velocity, strict=True))
    assert (most < CHANGE) or (jerk < JERK)
    assert float(law.knots[-2]) == pytest.approx(braking(1.0, most, jerk), abs=1e-6)


@given(FAR, st.floats(0.0, 0.95), RATE, SHARE)
def test_a_law_is_looked_at_until_it_changes_no_more(
    end: tuple[float, float, float], over: float, target: float, share: float
) -> None:
    run = run_of(way(end))
    run.time = over * run.path.duration
    law = SCALING.ramp(run.at, target, share)
    assert law is not None
    until = SCALING.until(run, law, target)
    s, rate, change = at(law, until)[:, 0]
    assert s == pytest.approx(run.path.duration) or (rate, change) == pytest.approx((target, 0.0), abs=1e-9)
    assert until <= law.knots[-2] + PERIOD


@given(st.floats(1.0, 3.0), RATE)
def test_a_path_runs_at_the_rate_at_which_it_meets_a_limit_and_no_faster(slower: float, rate: float) -> None:
    """On this one, stretched, it is the platform's velocity along x."""
    path = stretched(way((0.1, 0.0, 0.0)), slower)
    run = SCALING.begin(path, rate, HERE)
    assert run.target == run.at.rate == pytest.approx(min(rate, max(1.0, slower)), rel=1e-5)


@pytest.mark.parametrize("over", [0.45, 0.5, 0.55])
def test_the_first_stop_that_fits_is_taken_and_ends_at_rest(over: float) -> None:
    run = run_of(way((0.1, 0.0, 0.0)))
    run.time = over * run.path.duration
    quickest = SCALING.ramp(run.at, 0.0, 1.0)
    law = SCALING.stop(run, HERE, (1.0, 0.5, 0.25))
    assert quickest is not None
    assert law is not None
    assert at(law, 1e3)[1:, 0] == pytest.approx((0.0, 0.0), abs=1e-9)
    run.change_law(law, 0.0)
    assert run.ends >= float(quickest.knots[-2]) - 1e-9
