"""What a path and the law it is run by ask of the sliders, where their accelerations alone do not tell."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from trirail.config import geometry
from trirail.motion import feasibility
from trirail.motion.feasibility import Checker, parts
from trirail.motion.limits import Bounds
from trirail.motion.path_sampling import MIN_SAMPLES_IN_PIECE, survey
from trirail.motion.paths import LAST_PIECE_S, Path, constant_law
from trirail.motion.runs import stretched

PERIOD = CONFIG.period
PLATFORM = msgspec.structs.replace(CONFIG.limits.platform, jerk=(1e3, 1e3, 1e3))
LIMITS = msgspec.structs.replace(CONFIG.limits, platform=PLATFORM)
"""Such that the sliders' jerk is what binds."""
CHECKER = Checker(geometry(CONFIG.geometry), LIMITS, Bounds(LIMITS, PERIOD), PERIOD)
SPEED = 0.1
"""Of the platform along x, on a path of one second, at full rate [m/s]."""


def straight() -> Path:
    pieces = np.zeros((1, 3, 6))
    pieces[0, 0, :2] = -SPEED / 2.0, SPEED
    return Path(np.array([0.0, 1.0]), pieces)


def slower(by: float, within: float, edge: float) -> Path:
    """Return the law that takes so much off a rate of one; its change begins and ends at zero, in so short an edge."""
    knots = np.array([0.0, edge, within - edge, within, LAST_PIECE_S])
    most = -by / (within - edge)
    s, rate, change = 0.0, 1.0, 0.0
    pieces = np.zeros((4, 1, 6))
    for k, jerk in enumerate((most / edge, 0.0, -most / edge, 0.0)):
        pieces[k, 0, :4] = s, rate, change / 2.0, jerk / 6.0
        t = knots[k + 1] - knots[k] if k < 3 else 0.0
        s += rate * t + change * t**2 / 2.0 + jerk * t**3 / 6.0
        rate, change = rate + change * t + jerk * t**2 / 2.0, change + jerk * t
    return Path(knots, pieces)


@given(knots=st.integers(2, 400), seconds=st.floats(0.1, 20.0))
def test_a_look_along_a_path_gives_signs_of_life_between_its_parts(knots: int, seconds: float) -> None:
    beats: list[None] = []
    checker = Checker(geometry(CONFIG.geometry), LIMITS, Bounds(LIMITS, PERIOD), PERIOD, lambda: beats.append(None))
    path = Path(np.linspace(0.0, seconds, knots), np.zeros((knots - 1, 3, 6)))
    checker.worst_shares(path, (0.0, 0.0, 0.0))
    assert len(beats) == len(parts(path, constant_law(1.0), 0.0, seconds, feasibility.SAMPLES_PER_PART))
    assert len(beats) >= (knots - 1) * (MIN_SAMPLES_IN_PIECE + 1) // feasibility.SAMPLES_PER_PART


@pytest.mark.parametrize(("share", "within_limits"), [(0.9, True), (1.5, False)])
def test_a_change_of_rate_counts_with_what_the_velocities_tell(share: float, within_limits: bool) -> None:
    """Within one cycle the accelerations before and after are zero; a slider's velocity takes a step all the same."""
    by = share * LIMITS.slider.jerks[0] * PERIOD**2 / 2.0 / SPEED
    law = slower(by, PERIOD, PERIOD / 20.0)
    assert CHECKER.sample(straight(), law, 0.0, 0.9, (-SPEED / 2.0, 0.0, 0.0)).within_limits is within_limits


@pytest.mark.parametrize("first", [0.0, 0.3])
def test_a_path_that_begins_out_of_reach_and_leads_farther_out_leaves_it_at_once(first: float) -> None:
    pieces = np.zeros((1, 3, 6))
    pieces[0, 0, :2] = 2.0 * LIMITS.platform.x[1], SPEED
    found = CHECKER.sample(Path(np.array([0.0, 1.0]), pieces), constant_law(1.0), first, 0.9, (0.0, 0.0, 0.0))
    assert found.leaves_at == pytest.approx(first, abs=1e-6)
    assert not found.fits
    assert not found.within_limits


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_where_a_path_leaves_the_workspace_is_said_to_the_moment(share: float) -> None:
    pieces = np.zeros((1, 3, 6))
    pieces[0, 0, :2] = LIMITS.platform.x[1] - share * SPEED, SPEED
    found = CHECKER.sample(Path(np.array([0.0, 1.0]), pieces), constant_law(1.0), 0.0, 1.0, (0.0, 0.0, 0.0))
    assert found.leaves_at == pytest.approx(share, abs=1e-4)


@pytest.mark.parametrize(
    ("seconds", "moments"), [(0.01, 16), (0.08, 16), (0.125, 25), (0.25, 50), (0.32, 64), (0.4, 64), (500.0, 64)]
)
def test_how_often_a_path_is_looked_at(monkeypatch: pytest.MonkeyPatch, seconds: float, moments: int) -> None:
    """Beside its knots: every 5 ms, sixteen times at least and sixty-four times at most."""
    asked: list[int] = []

    def noted(*arguments: Any) -> float:
        asked.append(arguments[9])
        return survey(*arguments)

    monkeypatch.setattr(feasibility, "survey", noted)
    path = stretched(straight(), seconds)
    found = CHECKER.sample(path, constant_law(1.0), 0.0, seconds, (-SPEED / 2.0, 0.0, 0.0))
    assert math.isnan(found.leaves_at)
    assert asked == [moments]


# ---------------------------------------------------------------------- shares of the limits

# The code's own margins, written down once more: of the sliders, x, y, phi, x and y of the centre on a tool's path;
# velocity, acceleration and jerk.
PLANS = np.array([(0.98, 0.98, 0.93), *[(0.995, 0.98, 0.957)] * 5])
"""Shares of the limits that plans make use of."""
CHANGES = np.array([(0.99, 0.99, 0.98), *[(0.997, 0.99, 0.985)] * 5])
"""Shares of the limits that a motion may use while its rate changes."""


@pytest.mark.parametrize("row", range(6))
@pytest.mark.parametrize("quantity", range(3))
def test_what_a_motion_may_use_of_each_limit_while_its_rate_changes(row: int, quantity: int) -> None:
    for share, borne in ((1.0 - 1e-5, True), (1.0 + 1e-5, False)):
        worst = np.zeros((6, 3))
        worst[row, quantity] = share * CHANGES[row, quantity] / PLANS[row, quantity]
        assert CHECKER.keeps_limits(worst) is borne


def test_what_plans_may_use_of_the_sliders_limits() -> None:
    slider = LIMITS.slider
    expected = PLANS[0] * (slider.velocities[0], slider.accelerations[0], slider.jerks[0])
    assert CHECKER.slider_limits == pytest.approx(expected)


def test_what_plans_and_changes_of_rate_may_use_of_the_limits() -> None:
    limits = np.array([PLATFORM.velocity, PLATFORM.acceleration, PLATFORM.jerk]).T
    assert CHECKER.platform_limits == pytest.approx(limits * PLANS[1:4])
    assert CHECKER.centre_limits == pytest.approx(limits[:2] * PLANS[4:])
    slider = LIMITS.slider
    sliders = np.array([slider.velocities, slider.accelerations, slider.jerks]).T
    assert CHECKER.law_limits == pytest.approx(np.concatenate([limits * CHANGES[1:4], sliders * CHANGES[0]]))
    assert (PLANS < CHANGES).all()
    assert (CHANGES < 1.0).all()


# ---------------------------------------------------------------------- part by part


@given(
    st.lists(st.sampled_from([0.001, 0.05, 0.2, 1.0, 60.0]), min_size=1, max_size=60),
    st.integers(1, 100),
    st.sampled_from([0.5, 1.0, 2.0]),
    st.floats(0.0, 0.4),
    st.floats(0.5, 1.0),
)
def test_the_parts_of_a_path_follow_each_other_and_have_so_many_samples(
    durations: list[float], most: int, rate: float, begin: float, end: float
) -> None:
    path = Path(np.append(0.0, np.cumsum(durations)), np.zeros((len(durations), 3, 6)))
    first, until = begin * path.duration / rate, end * path.duration / rate
    found = parts(path, constant_law(rate), first, until, most)
    times = [first, *(end_of_part for _, end_of_part in found)]
    assert found == list(pairwise(times))
    assert times[-1] == until
    samples = np.clip(np.array(durations) / 0.03, 4, 16).astype(int) + 1
    for a, b in found:
        pieces = samples[(path.knots[1:] > rate * a + 1e-6) & (path.knots[:-1] < rate * b - 1e-6)]
        assert len(pieces) == 1 or pieces.sum() <= most
    for (a, _), (_, b) in pairwise(found):
        assert samples[(path.knots[1:] > rate * a + 1e-6) & (path.knots[:-1] < rate * b - 1e-6)].sum() > most
