"""The correction by as-built errors: the same mathematics with and without it, smooth, bounded, undone to 1e-12."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline  # type: ignore[import-untyped]
from trirail.errors import KinematicsError
from trirail.kinematics.correction import Correction
from trirail.kinematics.geometry import Geometry, travels
from trirail.kinematics.robot import forward, inverse, jacobians

Array = NDArray[np.float64]

PLAIN = Geometry.symmetric(0.3)
LOW, HIGH = (-0.16, -0.15, -1.2), (0.15, 0.16, 0.85)
SIZES = st.tuples(*[st.integers(1, 5)] * 3)
SEEDS = st.integers(0, 10_000)
STEP = 1e-5
"""Of difference quotients [s]."""


def random_map(cells: tuple[int, int, int], seed: int, size: float = 1e-4) -> Correction:
    nodes = np.random.default_rng(seed).uniform(-size, size, (*(n + 3 for n in cells), 3))
    return Correction(LOW, HIGH, nodes)


def places(seed: int, number: int = 20) -> Array:
    """Poses within reach, some of them outside the map's box."""
    return np.random.default_rng(seed + 1).uniform((-0.1, -0.1, -0.7), (0.1, 0.1, 0.6), (number, 3))


@given(cells=SIZES, seed=SEEDS)
def test_forward_undoes_inverse(cells: tuple[int, int, int], seed: int) -> None:
    robot = Geometry(PLAIN.legs, random_map(cells, seed))
    poses = places(seed)
    assert_allclose(forward(robot, inverse(robot, poses).position, near=poses), poses, rtol=0.0, atol=1e-12)
    assert np.abs(inverse(robot, poses).position - inverse(PLAIN, poses).position).max() > 1e-7


@given(cells=SIZES, seed=SEEDS)
def test_the_legs_are_told_the_pose_and_the_map_there(cells: tuple[int, int, int], seed: int) -> None:
    """Against scipy's splines, and the plain robot."""
    made, poses = random_map(cells, seed), places(seed)
    told = poses + told_more(made, poses)
    assert_allclose(inverse(Geometry(PLAIN.legs, made), poses).position, inverse(PLAIN, told).position, atol=1e-15)


@given(cells=SIZES, seed=SEEDS)
def test_velocities_and_accelerations_are_derivatives(cells: tuple[int, int, int], seed: int) -> None:
    robot = Geometry(PLAIN.legs, random_map(cells, seed))
    random = np.random.default_rng(seed)
    pose, (v, a) = places(seed, 1)[0], random.uniform(-0.3, 0.3, (2, 3))
    now = inverse(robot, pose, v, a)
    sides = [inverse(robot, pose + t * v + t * t / 2.0 * a, v + t * a, a) for t in (-STEP, STEP)]
    assert_allclose(now.velocity, (sides[1].position - sides[0].position) / (2.0 * STEP), atol=1e-7)
    assert_allclose(now.acceleration, (sides[1].velocity - sides[0].velocity) / (2.0 * STEP), atol=1e-4)


@given(cells=SIZES, seed=SEEDS)
def test_the_jacobians_are_those_of_the_corrected_robot(cells: tuple[int, int, int], seed: int) -> None:
    robot = Geometry(PLAIN.legs, random_map(cells, seed))
    poses, velocity = places(seed), np.random.default_rng(seed).uniform(-1.0, 1.0, 3)
    j1, j2 = jacobians(robot, poses)
    sliders = inverse(robot, poses, velocity).velocity
    assert_allclose(np.einsum("nij,nj->ni", j1, sliders), j2 @ velocity, atol=1e-12)


@given(cells=SIZES, seed=SEEDS, rates=st.tuples(*[st.floats(0.0, 2.0)] * 3))
def test_what_it_adds_is_bounded_in_every_cell(
    cells: tuple[int, int, int], seed: int, rates: tuple[float, float, float]
) -> None:
    """The velocity of c on the way through a cell stays within what `adds` says of that cell."""
    made, random = random_map(cells, seed), np.random.default_rng(seed)
    cell = random.integers(0, made.cells)
    place = np.array(made.low) + (cell + random.uniform(0.05, 0.95, 3)) * made.size
    way = 1e-4 * np.array(rates) * random.choice((-1.0, 1.0), 3)
    before, after = told_more(made, np.array([place - way, place + way]))
    assert (np.abs(after - before) / 2e-4 <= made.adds(rates)[tuple(cell)] + 1e-9).all()
    assert (np.abs([before, after]) <= made.bound).all()


@given(cells=SIZES, seed=SEEDS)
def test_travels_are_those_of_the_corrected_robot(cells: tuple[int, int, int], seed: int) -> None:
    robot, poses = Geometry(PLAIN.legs, random_map(cells, seed)), places(seed)
    joints = inverse(robot, poses)
    assert_allclose(travels(robot, poses), [joints.position, joints.passive_position], rtol=0.0, atol=1e-12)


@given(cells=SIZES, seed=SEEDS)
def test_its_splines_are_those_of_scipy(cells: tuple[int, int, int], seed: int) -> None:
    made, poses = random_map(cells, seed), places(seed)
    assert_allclose(made.at(poses), told_more(made, poses), rtol=0.0, atol=1e-17)


def told_more(made: Correction, poses: Array) -> Array:
    knots = tuple(
        low + (high - low) / n * np.arange(-3, n + 4)
        for low, high, n in zip(made.low, made.high, made.cells, strict=True)
    )
    more: Array = NdBSpline(knots, made.nodes, 3)(poses)
    return more


def test_the_greatest_correction_is_that_at_the_corners_of_cells() -> None:
    made = random_map((3, 2, 4), 5)
    axes = [np.linspace(low, high, n + 1) for low, high, n in zip(LOW, HIGH, made.cells, strict=True)]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    assert_allclose(made.greatest, np.abs(told_more(made, corners * (1.0 - 1e-12))).max(axis=0), rtol=1e-6)


def small_map(cells: tuple[int, int, int], seed: int) -> Correction:
    """A map of a part of what is within reach."""
    return replace(random_map(cells, seed), low=(-0.02, -0.03, -0.1), high=(0.03, 0.02, 0.2))


def test_far_beyond_its_box_it_does_not_change() -> None:
    robot = Geometry(PLAIN.legs, replace(random_map((2, 2, 2), 3), low=(-0.02,) * 3, high=(0.02,) * 3))
    inside, outside = (0.01, 0.0, 0.02), (0.01, 0.0, 0.3)
    bare = inverse(PLAIN, [inside, outside]).position
    more = inverse(robot, [inside, outside]).position - bare
    assert (np.abs(more) > 1e-7).all()
    pose = forward(robot, inverse(robot, outside).position)
    assert_allclose(pose, outside, rtol=0.0, atol=1e-12)
    still = inverse(robot, outside, (0.0, 0.0, 1.0)).velocity  # c does not change along phi any more
    told = forward(PLAIN, inverse(robot, outside).position)
    assert_allclose(still, inverse(PLAIN, told, (0.0, 0.0, 1.0)).velocity, atol=1e-12)


@given(cells=SIZES, seed=SEEDS, axis=st.integers(0, 2), upper=st.booleans(), outside=st.integers(0, 4))
def test_neither_velocity_nor_acceleration_jumps_at_the_border_or_beyond(
    cells: tuple[int, int, int], seed: int, axis: int, upper: bool, outside: int
) -> None:
    made = small_map(cells, seed)
    robot, random = Geometry(PLAIN.legs, made), np.random.default_rng(seed)
    pose = random.uniform(made.low, made.high)
    border = made.high[axis] + outside * made.size[axis] if upper else made.low[axis] - outside * made.size[axis]
    pose[axis] = np.clip(border, 0.7 * LOW[axis], 0.7 * HIGH[axis])
    v, a = random.uniform(-0.3, 0.3, (2, 3))
    before, after = (inverse(robot, pose + side * np.eye(3)[axis], v, a) for side in (-1e-9, 1e-9))
    assert_allclose(before.velocity, after.velocity, rtol=0.0, atol=1e-7)
    assert_allclose(before.acceleration, after.acceleration, rtol=0.0, atol=1e-5)


@given(cells=SIZES, seed=SEEDS)
def test_beyond_its_box_it_adds_no_more_than_inside(cells: tuple[int, int, int], seed: int) -> None:
    made, random = small_map(cells, seed), np.random.default_rng(seed)
    poses, way = places(seed), 1e-6 * random.uniform(-1.0, 1.0, 3)
    added = (made.at(poses + way) - made.at(poses - way)) / 2.0
    assert (np.abs(added) <= made.adds(np.abs(way).tolist()).max(axis=(0, 1, 2)) + 1e-15).all()
    assert (np.abs(made.at(poses)) <= made.bound * (1.0 + 1e-12)).all()


@given(cells=SIZES, seed=SEEDS)
def test_beyond_its_box_it_is_the_same_for_the_legs_and_in_numpy(cells: tuple[int, int, int], seed: int) -> None:
    made, poses = small_map(cells, seed), places(seed)
    told = poses + made.at(poses)
    assert_allclose(inverse(Geometry(PLAIN.legs, made), poses).position, inverse(PLAIN, told).position, atol=1e-15)


@pytest.mark.parametrize("cells", [(1, 1, 1), (3, 2, 5)])
def test_a_correction_of_zero_is_none_to_the_last_bit(cells: tuple[int, int, int]) -> None:
    robot = Geometry(PLAIN.legs, random_map(cells, 1, 0.0))
    random = np.random.default_rng(7)
    poses, v, a = places(7), *random.uniform(-1.0, 1.0, (2, 20, 3))
    for ours, plain in zip(inverse(robot, poses, v, a), inverse(PLAIN, poses, v, a), strict=True):
        assert ours.tolist() == plain.tolist()
    sliders = inverse(PLAIN, poses).position
    assert forward(robot, sliders).tolist() == forward(PLAIN, sliders).tolist()


def test_what_is_no_number_is_refused_as_ever() -> None:
    robot = Geometry(PLAIN.legs, random_map((2, 2, 2), 3))
    for bad in (np.nan, np.inf, -np.inf):
        for axis in range(3):
            pose = np.zeros(3)
            pose[axis] = bad
            with pytest.raises(KinematicsError, match="it must be finite"):
                inverse(robot, pose)


@pytest.mark.parametrize(
    ("low", "high", "nodes", "said"),
    [
        (LOW, HIGH, np.zeros((3, 4, 4, 3)), "expected"),
        (LOW, HIGH, np.zeros((4, 4, 4)), "expected"),
        (LOW, HIGH, np.full((4, 4, 4, 3), np.nan), "not finite"),
        (LOW, (0.1, np.inf, 0.1), np.zeros((4, 4, 4, 3)), "not finite"),
        (LOW, (0.1, -0.15, 0.1), np.zeros((4, 4, 4, 3)), "is empty"),
    ],
)
def test_what_is_no_map_is_refused(low: object, high: object, nodes: Array, said: str) -> None:
    with pytest.raises(KinematicsError, match=said):
        Correction(low, high, nodes)  # type: ignore[arg-type]
