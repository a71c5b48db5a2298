"""The rigid error: against exact truth, by its covariance, and against marks that are named wrongly."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.alignment.rigid_motion import find_swap, fit_rigid_motion, rotation_matrix, worst_distance_error

SEEDS = st.integers(0, 2**32 - 1)


def part(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return n marks of which no two are near each other [m]."""
    angles = np.sort(rng.uniform(0, 2 * math.pi / n * 0.6, n)) + 2 * math.pi / n * np.arange(n)
    return 0.06 * rng.uniform(0.5, 1.5) * np.stack([np.cos(angles), np.sin(angles)], axis=1)


@given(SEEDS, st.integers(2, 6), st.floats(-1.5, 1.5))
def test_it_is_the_motion_that_was_made_whatever_the_weights(seed: int, n: int, turn: float) -> None:
    rng = np.random.default_rng(seed)
    at = part(rng, n) + rng.uniform(-0.1, 0.1, 2)
    shift = rng.uniform(-0.01, 0.01, 2)
    middle = at.mean(axis=0)
    to = middle + shift + (at - middle) @ rotation_matrix(turn).T
    halves = rng.uniform(-1, 1, (n, 2, 2))
    weights = halves @ halves.transpose(0, 2, 1) + 0.1 * np.eye(2)
    for w in (None, weights):
        found = fit_rigid_motion(at, to, w)
        assert found.turn == pytest.approx(turn, abs=1e-12)
        assert found.shift == pytest.approx(shift, abs=1e-13)
        assert found.displacements(at) == pytest.approx(to - at, abs=1e-13)
        assert np.abs(found.misfit).max() < 1e-13


@pytest.mark.parametrize("n", [2, 3, 5])
@pytest.mark.long
def test_its_misfit_and_its_errors_are_as_large_as_the_weights_say(n: int) -> None:
    rng = np.random.default_rng(n)
    at, trials = part(rng, n), 3000
    halves = rng.uniform(-1, 1, (n, 2, 2)) * 1e-6
    covariances = halves @ halves.transpose(0, 2, 1) + 1e-14 * np.eye(2)
    roots, weights = np.linalg.cholesky(covariances), np.asarray(np.linalg.inv(covariances), np.float64)
    chi, errors = [], []
    for _ in range(trials):
        noise = np.einsum("nij,nj->ni", roots, rng.standard_normal((n, 2)))
        found = fit_rigid_motion(at, at + noise, weights)
        e = np.append(found.shift, found.turn)
        chi.append(found.chi_squared)
        errors.append(e @ np.linalg.solve(found.covariance, e))
    freedom = 2 * n - 3
    assert np.mean(chi) == pytest.approx(freedom, abs=5 * math.sqrt(2 * freedom / trials))
    assert np.mean(errors) == pytest.approx(3.0, abs=5 * math.sqrt(6 / trials))


@given(SEEDS, st.integers(2, 5), st.floats(-0.01, 0.01))
def test_a_wrong_distance_is_told_with_its_share(seed: int, n: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    to = part(rng, n)
    at = to * (1.0 + share) @ rotation_matrix(rng.uniform(-1, 1)).T + rng.uniform(-0.01, 0.01, 2)
    assert worst_distance_error(at, to) == pytest.approx(share, abs=1e-12)


@given(SEEDS, st.integers(2, 5), st.floats(-0.3, 0.3))
def test_exchanged_names_are_seen_and_right_ones_are_not_suspected(seed: int, n: int, turn: float) -> None:
    rng = np.random.default_rng(seed)
    to = part(rng, n)
    at = to @ rotation_matrix(turn).T + rng.uniform(-0.002, 0.002, 2)
    assert find_swap(at, to) is None
    first = rng.permutation(n)[:2]
    at[first] = at[first[::-1]]
    order = find_swap(at, to)
    if n == 2:
        assert order == (1, 0)
    elif order is not None:
        assert {k for k, m in enumerate(order) if k != m} == set(first.tolist())


@given(st.sampled_from([(2, 90.0), (3, 80.0), (4, 61.0), (5, 48.0), (6, 40.0)]), st.floats(-1.0, 1.0))
def test_corners_of_a_regular_polygon_are_not_suspected_within_the_angle_that_is_promised(
    polygon: tuple[int, float], share: float
) -> None:
    number, most = polygon
    angles = 2.0 * np.pi / number * np.arange(number)
    to = 0.05 * np.column_stack([np.cos(angles), np.sin(angles)])
    assert find_swap(to @ rotation_matrix(np.radians(share * most)).T, to) is None
