"""The fastest law along a line, by itself: as fast as Ruckig's, however the line is measured, and within its limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from ruckig import InputParameter, Ruckig, Trajectory
from trirail.motion.time_optimal import limit_excess, minimise_time, spline_states

Array = NDArray[np.float64]
Limits = tuple[float, float, float]

INTERVALS, CELLS = 32, 64
SIGMA = np.linspace(0.0, 1.0, CELLS + 1)
"""The share of the line that is behind, where its derivatives are given."""
LIMITS = [(9.0, 4.0, 30.0), (1.2, 99.0, 30.0), (1.2, 4.0, 30.0), (0.7, 3.0, 20.0)]
"""Of velocity, acceleration and jerk along a line of length one: which of them bind differs."""
WEAK = (100.0, 100.0, 1000.0)
"""Limits that bind nothing here."""


def ruckigs(limits: Limits) -> float:
    """Return how long Ruckig takes for a distance of one, from rest to rest [s]."""
    request, trajectory = InputParameter(1), Trajectory(1)
    request.target_position = [1.0]
    request.max_velocity, request.max_acceleration, request.max_jerk = ([limit] for limit in limits)
    assert Ruckig(1).calculate(request, trajectory) >= 0
    return float(trajectory.duration)


def parabola(bend: float) -> Array:
    """Derivatives of a coordinate that goes from 0 to 1 as sigma + bend sigma (1 - sigma)."""
    return np.stack([1.0 + bend * (1.0 - 2.0 * SIGMA), np.full_like(SIGMA, -2.0 * bend)], axis=1)


def hump(height: float) -> Array:
    """Derivatives of what height sigma² (1 - sigma)² adds to a coordinate."""
    first = 2.0 * SIGMA - 6.0 * SIGMA**2 + 4.0 * SIGMA**3
    return height * np.stack([first, 2.0 - 12.0 * SIGMA + 12.0 * SIGMA**2], axis=1)


def wave(bend: float) -> Array:
    """Derivatives of a coordinate that goes from 0 to 1 as sigma + bend sin(2 pi sigma) / (2 pi)."""
    turn = 2.0 * np.pi
    return np.stack([1.0 + bend * np.cos(turn * SIGMA), -turn * bend * np.sin(turn * SIGMA)], axis=1)


def smooth() -> Array:
    """Coefficients of a law from rest to rest."""
    x = np.clip(np.arange(-1.0, INTERVALS + 2.0) / INTERVALS, 0.0, 1.0)
    coefficients: Array = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    coefficients[:3], coefficients[-3:] = 0.0, 1.0
    return coefficients


def fastest(coordinates: list[Array], limits: list[Limits]) -> tuple[float, Array, Array]:
    """Return how long the fastest law takes [s], its coefficients, and the samples of the line (65, m, 2)."""
    samples, rows, law = np.stack(coordinates, axis=1), np.array(limits), smooth()
    step = 1.01 * limit_excess(samples, rows, law, 1.0 / INTERVALS) / INTERVALS
    step = minimise_time(samples, rows, law, step)
    assert limit_excess(samples, rows, law, step) == pytest.approx(1.0, abs=1e-3)
    assert limit_excess(samples, rows, law, step) < 1.0
    return step * INTERVALS, law, samples


@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize(
    ("coordinate", "lost"),
    [
        (parabola(0.0), 0.0035),
        (parabola(0.3), 0.005),
        (parabola(-0.3), 0.005),
        (parabola(0.6), 0.0115),
        (parabola(-0.6), 0.0115),
        (wave(-0.3), 0.0115),
    ],
    ids=["even", "slower", "quicker", "much slower", "much quicker", "there and back"],
)
def test_however_a_line_is_measured_the_fastest_law_takes_as_long_as_ruckigs(
    limits: Limits, coordinate: Array, lost: float
) -> None:
    """What it loses is that its jerk changes at the ends of intervals only, and the barrier's last weight."""
    takes, _, _ = fastest([coordinate], [limits])
    assert 1.0 - 1e-4 < takes / ruckigs(limits) < 1.0 + lost


@pytest.mark.parametrize("binding", range(3))
def test_of_several_coordinates_the_slowest_one_decides(binding: int) -> None:
    limits = [WEAK] * 3
    limits[binding] = LIMITS[2]
    takes, _, _ = fastest([parabola(0.0), parabola(0.3), wave(0.2)], limits)
    assert 1.0 - 1e-4 < takes / ruckigs(LIMITS[2]) < 1.006


def test_what_one_coordinate_may_not_of_velocity_and_another_not_of_acceleration() -> None:
    """Both are the same line: together their limits are those of one."""
    (velocity, acceleration, jerk), line = LIMITS[2], parabola(0.0)
    takes, _, _ = fastest(
        [line, 2.0 * line, -line], [(velocity, 99.0, 999.0), (99.0, 2.0 * acceleration, 999.0), (99.0, 99.0, jerk)]
    )
    assert 1.0 - 1e-4 < takes / ruckigs(LIMITS[2]) < 1.0035


COEFFICIENTS = st.lists(st.floats(0.0, 1.0), min_size=3, max_size=12).map(
    lambda free: np.array([0.0] * 3 + free + [1.0] * 3)
)


@given(COEFFICIENTS, st.floats(0.01, 1.0))
def test_the_states_of_a_law_are_those_of_a_cubic_b_spline(c: Array, h: float) -> None:
    """A textbook's, at its knots; and each interval's cubic ends in the state with which the next one begins."""
    states = np.empty((len(c) - 3, 4))
    spline_states(c, h, states)
    a, b, d, e = c[:-3], c[1:-2], c[2:-1], c[3:]
    expected = (
        (a + 4.0 * b + d) / 6.0,
        (d - a) / (2.0 * h),
        (a - 2.0 * b + d) / h**2,
        (e - 3.0 * d + 3.0 * b - a) / h**3,
    )
    for n, row in enumerate(expected):
        assert states[:, n] == pytest.approx(row, abs=1e-12 / h**n)
    sigma, v, acceleration, j = states.T
    ends = sigma + v * h + acceleration * h**2 / 2.0 + j * h**3 / 6.0
    assert ends == pytest.approx([*sigma[1:], 1.0], abs=1e-9)
    assert (sigma[0], v[0], acceleration[0]) == (0.0, 0.0, 0.0)


@given(
    COEFFICIENTS,
    st.floats(0.01, 1.0),
    st.floats(-0.9, 0.9),
    st.floats(-3.0, 3.0),
    st.tuples(*[st.floats(0.1, 10.0)] * 3),
)
def test_how_many_times_too_fast_a_law_is_by_polynomials(
    c: Array, h: float, bend: float, height: float, limits: Limits
) -> None:
    """Along a quartic the coordinate is a polynomial of time: at both ends of each interval and in its middle."""
    samples = (parabola(bend) + hump(height))[:, None, :].copy()
    states = np.empty((len(c) - 3, 4))
    spline_states(c, h, states)
    most = 0.0
    for state in states:
        sigma = Polynomial(state / (1.0, 1.0, 2.0, 6.0))
        x = sigma + bend * sigma * (1.0 - sigma) + height * sigma**2 * (1.0 - sigma) ** 2
        for order, limit in enumerate(limits, start=1):
            values = x.deriv(order)(np.array([0.0, h / 2.0, h]))
            most = max(most, float(np.abs(values).max() / limit) ** (1.0 / order))
    assert limit_excess(samples, np.array([limits]), c, h) == pytest.approx(most, rel=1e-6)
