"""A 3-PPR stage as built: calibration and correction as of every mechanism."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from trirail.config import SIM, geometry, load, room
from trirail.kinematics.calibration import corrected, identify, pose_derivatives
from trirail.kinematics.correction import Correction
from trirail.kinematics.correction_fit import fit
from trirail.kinematics.geometry import CrossLeg, Geometry
from trirail.kinematics.robot import forward, inverse, jacobians

CONFIG = load(SIM.with_name("uvw-ppr.toml"))
START = geometry(CONFIG.geometry)
ROOM = room(CONFIG.limits)
LOW, HIGH = (-0.01, -0.01, -0.0873), (0.01, 0.01, 0.0873)
NOISE = np.array([0.5e-6, 0.5e-6, 5e-6])
SMALL = np.array([0.01, 2e-4, 2e-4, 2e-4, 0.01])
"""Errors of a stage [m, rad], in the order of CrossLeg.PARAMETERS."""


def poses(random: np.random.Generator, number: int, share: float = 1.0) -> NDArray[np.float64]:
    return random.uniform(np.multiply(ROOM.low, share), np.multiply(ROOM.high, share), (number, 3))


def as_built(random: np.random.Generator) -> Geometry:
    return corrected(START, random.uniform(-SMALL, SMALL, (3, 5)))


@pytest.mark.generated(*range(5))
def test_data_with_noise_gives_poses_better_than_it_has(seed: int) -> None:
    random = np.random.default_rng(seed)
    robot, seen, unseen = as_built(random), poses(random, 80), poses(random, 200)
    measured = seen + NOISE * random.standard_normal(seen.shape)
    found = identify(START, measured, inverse(robot, seen).position, position_noise=NOISE[0], angle_noise=NOISE[2])
    sliders = inverse(robot, unseen).position
    assert np.max(np.std((forward(found.geometry, sliders) - unseen) / NOISE, axis=0)) < 1.0
    assert np.std((forward(START, sliders) - unseen) / NOISE) > 20.0
    assert 0.8 < found.misfit < 1.2
    for leg, names, _ in found.open:
        assert leg in "ABC"
        assert set(names) <= set(CrossLeg.PARAMETERS)


@pytest.mark.generated(*range(5))
def test_derivatives_of_a_pose_are_quotients_of_differences(seed: int) -> None:
    random = np.random.default_rng(seed)
    robot, seen, step = as_built(random), poses(random, 10), 1e-7
    sliders = inverse(robot, seen).position
    derivatives = pose_derivatives(robot, robot, seen)
    for leg in range(3):
        for parameter in range(5):
            change = np.zeros((3, 5))
            change[leg, parameter] = step
            ends = [forward(corrected(robot, sign * change), sliders) for sign in (1.0, -1.0)]
            assert_allclose((ends[0] - ends[1]) / (2.0 * step), derivatives[:, :, leg, parameter], atol=1e-6)


@pytest.mark.generated(*range(5))
def test_a_correction_is_undone_and_its_jacobians_are_derivatives(seed: int) -> None:
    random = np.random.default_rng(seed)
    nodes = random.uniform(-1e-5, 1e-5, (5, 6, 7, 3))
    robot = Geometry(START.legs, Correction(LOW, HIGH, nodes))
    seen, v = poses(random, 20), random.uniform(-0.3, 0.3, 3)
    motion = inverse(robot, seen, v)
    assert_allclose(forward(robot, motion.position, near=seen), seen, rtol=0.0, atol=1e-12)
    j1, j2 = jacobians(robot, seen)
    assert_allclose(np.einsum("nij,nj->ni", j1, motion.velocity), j2 @ v, atol=1e-12)
    step = 1e-6
    quotient = (inverse(robot, seen + step * v).position - inverse(robot, seen - step * v).position) / (2.0 * step)
    assert_allclose(quotient, motion.velocity, atol=1e-7)


def test_a_map_from_measured_poses_takes_out_most_of_what_was_built_otherwise() -> None:
    random = np.random.default_rng(7)
    robot = as_built(random)
    reach = poses(random, 2000)
    joints = inverse(START, reach)
    within = (np.abs(joints.position) <= 0.01).all(axis=1) & (np.abs(joints.passive_position) <= 0.018).all(axis=1)
    seen = reach[within][:300]
    made = fit(START, seen[:250], inverse(robot, seen[:250]).position, ROOM, (2, 2, 2))
    mapped = Geometry(START.legs, made.correction)
    left = forward(mapped, inverse(robot, seen[250:]).position, near=seen[250:]) - seen[250:]
    before = forward(START, inverse(robot, seen[250:]).position, near=seen[250:]) - seen[250:]
    assert np.all(np.abs(left).max(axis=0) < 0.05 * np.abs(before).max(axis=0))


def test_a_rail_across_its_cross_slide_is_named_as_open() -> None:
    """Its angle has no effect of the first order: what the data cannot tell stays as in the starting geometry."""
    random = np.random.default_rng(3)
    seen = poses(random, 60)
    found = identify(START, seen, inverse(START, seen).position)
    assert [leg for leg, names, _ in found.open if "rail_angle" in names] == ["A", "B", "C"]
    errors = found.standard_errors[:, CrossLeg.PARAMETERS.index("rail_angle")]
    assert np.all(np.isinf(errors))
    assert math.isfinite(found.misfit)
