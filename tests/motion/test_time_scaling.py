"""How time runs along a path: its rate changes as quickly as the limits allow, and is no greater than they do."""

from __future__ import annotations

import itertools
import math

import msgspec
import numpy as np
import pytest
from control_rig import CONFIG
from hypothesis import assume, given
from hypothesis import strategies as st
from motion.test_runs import FAR, HERE, ROBOT, at, run_of, way
from trirail.motion.feasibility import PLATFORM_LAW_SHARES, PLATFORM_PLAN_SHARES, Checker
from trirail.motion.limits import Bounds
from trirail.motion.paths import Path, constant_law, law_falls
from trirail.motion.runs import LawState, stretched
from trirail.motion.time_scaling import CHANGE_SHARES, TimeScaling

PERIOD = CONFIG.period
LIMITS = CONFIG.limits
SCALING = TimeScaling(ROBOT, Checker(ROBOT, LIMITS, Bounds(LIMITS, PERIOD), PERIOD), PERIOD)
OF_VELOCITY, OF_ACCELERATION, OF_JERK = PLATFORM_LAW_SHARES
CHANGE = (
    OF_ACCELERATION
    / OF_VELOCITY
    * min(a / v for a, v in zip(LIMITS.platform.acceleration, LIMITS.platform.velocity, strict=True))
)
JERK = OF_JERK / OF_VELOCITY * min(j / v for j, v in zip(LIMITS.platform.jerk, LIMITS.platform.velocity, strict=True))
"""What brakes a motion at full speed within the platform's limits of acceleration and jerk [1/s, 1/s²]."""
RATE = st.sampled_from([0.0, 0.3, 1.0, 2.0])
SHARE = st.floats(0.01, 1.0)


def braking(by: float, most: float, jerk: float) -> float:
    """Return how long a rate takes to change by so much, from no change to none [s]."""
    return by / most + most / jerk if by > most**2 / jerk else 2.0 * math.sqrt(by / jerk)


@given(RATE, RATE, SHARE)
def test_a_rate_changes_as_quickly_as_a_motion_at_full_speed_may(rate: float, target: float, share: float) -> None:
    law = SCALING.ramp(LawState(0.3, rate, 0.0), target, SCALING.full_speed.scaled(share))
    assert law is not None
    ends = float(law.knots[-2])
    assert ends == pytest.approx(braking(abs(target - rate), share * CHANGE, share * JERK), abs=1e-6)
    changes = [at(law, time)[2, 0] for time in np.linspace(0.0, ends, 200)]
    assert np.abs(changes).max() <= share * CHANGE * (1.0 + 1e-9)
    assert np.abs(6.0 * law.pieces[:, 0, 3]).max() <= share * JERK * (1.0 + 1e-9)
    assert at(law, ends + 1e-6)[1:, 0] == pytest.approx((target, 0.0), abs=1e-9)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), SHARE)
def test_to_raise_a_rate_takes_as_long_as_to_lower_it(by: float, changing: float, share: float) -> None:
    """Also where it is changing already, faster than this share would have it: if it does not fall to zero by that."""
    change = changing * CHANGE
    assume(1.0 + by / 2.0 - change**2 / (2.0 * share * JERK) > 0.0)
    up = SCALING.ramp(LawState(0.0, 1.0 - by / 2.0, change), 1.0 + by / 2.0, SCALING.full_speed.scaled(share))
    down = SCALING.ramp(LawState(0.0, 1.0 + by / 2.0, -change), 1.0 - by / 2.0, SCALING.full_speed.scaled(share))
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
    scaling = TimeScaling(ROBOT, Checker(ROBOT, limits, Bounds(limits, PERIOD), PERIOD), PERIOD)
    law = scaling.ramp(LawState(0.0, 1.0, 0.0), 0.0, scaling.full_speed.scaled(1.0))
    assert law is not None
    most = (
        OF_ACCELERATION
        / OF_VELOCITY
        * min(a / v for a, v in zip(platform.acceleration, platform.velocity, strict=True))
    )
    jerk = OF_JERK / OF_VELOCITY * min(j / v for j, v in zip(platform.jerk, platform.velocity, strict=True))
    assert (most < CHANGE) or (jerk < JERK)
    assert float(law.knots[-2]) == pytest.approx(braking(1.0, most, jerk), abs=1e-6)


@given(FAR, st.floats(0.0, 0.95), RATE, SHARE)
def test_a_law_is_looked_at_until_it_changes_no_more(
    end: tuple[float, float, float], over: float, target: float, share: float
) -> None:
    run = run_of(way(end))
    run.time = over * run.path.duration
    law = SCALING.ramp(run.law_state, target, SCALING.full_speed.scaled(share))
    assert law is not None
    until = SCALING.last_new_time(run, law, target)
    s, rate, change = at(law, until)[:, 0]
    assert s == pytest.approx(run.path.duration) or (rate, change) == pytest.approx((target, 0.0), abs=1e-9)
    assert until <= law.knots[-2] + PERIOD


@given(st.floats(1.0, 3.0), RATE)
def test_a_path_runs_at_the_rate_at_which_it_meets_a_limit_and_no_faster(slower: float, rate: float) -> None:
    """On this one, stretched, it is the platform's jerk along x, of which plans use a share."""
    path = stretched(way((0.1, 0.0, 0.0)), slower)
    run = SCALING.start_run(path, rate, HERE)
    assert (
        run.target
        == run.law_state.rate
        == pytest.approx(min(rate, max(1.0, slower * PLATFORM_PLAN_SHARES[2] ** (1 / 3))), rel=1e-5)
    )


@pytest.mark.parametrize("over", [0.45, 0.5, 0.55])
def test_the_first_stop_that_fits_is_taken_and_ends_at_rest(over: float) -> None:
    run = run_of(stretched(way((0.1, 0.0, 0.0)), PLATFORM_PLAN_SHARES[2] ** (-1 / 3)))  # it takes what plans may
    run.time = over * run.path.duration
    law = SCALING.stop(run, HERE, (1.0, 0.5, 0.25))
    assert law is not None
    assert at(law, 1e3)[1:, 0] == pytest.approx((0.0, 0.0), abs=1e-9)
    run.change_law(law, 0.0)
    assert SCALING.sample(run.path, law, 0.0, run.end_time, HERE).within_limits
    assert run.end_time <= 0.18


# ---------------------------------------------------------------------- time along a path never runs backwards

STARTS = (0.0, 0.3, 5.0)
RATES = (0.0, 1e-9, 1e-3, 0.02, 0.2, 0.5, 0.9, 1.0, 1.4, 2.0)
TARGETS = (0.0, 0.2, 1.0, 2.0)


def fall(law: Path) -> float:
    """By how much the time along a path falls under a law at most, by the roots of its rate [s]."""
    s = []
    for piece, span in zip(law.pieces[:, 0, :4], np.diff(law.knots), strict=True):
        cubic = np.polynomial.Polynomial(piece)
        roots = np.asarray(cubic.deriv().trim(1e-12).roots(), dtype=np.complex128)
        turns = np.sort(roots.real[np.abs(roots.imag) < 1e-9])
        s += [float(cubic(time)) for time in (0.0, *turns[(turns > 0.0) & (turns < span)], span)]
    return float((np.maximum.accumulate(s) - s).max())


@pytest.mark.parametrize("share", CHANGE_SHARES)
def test_whatever_a_law_begins_with_its_time_never_falls(share: float) -> None:
    """Over all states of a law: where it begins, its rate, the change of that, where to and at which share."""
    lawful = 0
    for s, rate, change, target in itertools.product(STARTS, RATES, np.linspace(-1.0, 1.0, 9) * CHANGE, TARGETS):
        law = SCALING.ramp(LawState(s, rate, float(change)), target, SCALING.full_speed.scaled(share))
        unavoidable = rate - min(change, 0.0) ** 2 / (2.0 * share * JERK)
        if law is None:
            assert unavoidable < 1e-9, (s, rate, change, target)
            continue
        lawful += 1
        assert unavoidable > -1e-6
        assert not law_falls(law.knots, law.pieces)
        assert float(law.pieces[0, 0, 0]) == s
        assert float(law.pieces[-1, 0, 1]) == target
    assert lawful > 400


@given(
    st.lists(st.tuples(st.floats(0.01, 0.5), st.integers(-160, 160)), min_size=1, max_size=6),
    st.floats(0.0, 2.0),
    st.floats(-8.0, 8.0),
)
def test_falling_is_told_as_dense_looks_tell_it(pieces: list[tuple[float, int]], rate: float, change: float) -> None:
    """Laws of random jerks, which fall or do not."""
    knots, rows, s = [0.0], [], 0.0
    for span, jerk in pieces:
        rows.append([s, rate, change / 2.0, jerk / 6.0, 0.0, 0.0])
        s += span * (rate + span * (change / 2.0 + span * jerk / 6.0))
        rate += span * (change + span * jerk / 2.0)
        change += span * jerk
        knots.append(knots[-1] + span)
    law = Path(np.array(knots), np.array(rows)[:, None, :])
    by = fall(law)
    assume(not 1e-14 < by < 1e-10)  # rounding decides
    assert law_falls(law.knots, law.pieces) == (by > 1e-12)


@given(
    st.lists(st.tuples(st.floats(0.01, 0.5), *3 * [st.floats(-100.0, 100.0)]), min_size=1, max_size=4),
    st.floats(0.0, 2.0),
    st.floats(-8.0, 8.0),
)
def test_no_law_of_degree_5_falls_unnoticed(
    pieces: list[tuple[float, float, float, float]], rate: float, change: float
) -> None:
    knots, rows, s = [0.0], [], 0.0
    for span, *rest in pieces:
        piece = np.polynomial.Polynomial([s, rate, change / 2.0, *rest])
        rows.append(piece.coef)
        s, rate, change = (float(each(span)) for each in (piece, piece.deriv(), piece.deriv(2)))
        knots.append(knots[-1] + span)
    law = Path(np.array(knots), np.array(rows, dtype=np.float64)[:, None, :])
    dense = np.array([at(law, time)[0, 0] for time in np.linspace(0.0, knots[-1], 2001)])
    assert law_falls(law.knots, law.pieces) or (np.maximum.accumulate(dense) - dense).max() < 1e-11
    assert not law_falls(*constant_law(0.0)[:2])


@pytest.mark.parametrize(("power", "factor"), [(4, 1.0), (5, 1.0), (4, -1.0), (5, -1.0)])
def test_a_law_of_degree_5_that_rises_is_one(power: int, factor: float) -> None:
    law = Path(np.array([0.0, 0.1]), np.zeros((1, 1, 6)))
    law.pieces[0, 0, 1], law.pieces[0, 0, power] = 1.0, factor * 2.0 * 0.1 ** (1 - power) / power
    assert law_falls(law.knots, law.pieces) == (factor < 0.0)
