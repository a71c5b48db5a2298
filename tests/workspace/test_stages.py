"""Alignment stages: their workspace against brute force, and how they are drawn."""

import math

import msgspec
import numpy as np
import pytest
from numpy.testing import assert_allclose
from trirail.config import SIM, Config, geometry, load
from trirail.kinematics.geometry import singular_angles
from trirail.kinematics.robot import inverse, jacobians
from trirail.workspace import part_positions
from trirail.workspace.part_positions import RobotParts
from trirail.workspace.singularity import conditioning, distance_to_singularity
from trirail.workspace.violations import violations
from trirail.workspace.workspace import measure_extent, permitted_slice, reachable_slice


@pytest.fixture(params=["uvw", "xxy", "uvw-ppr"])
def stage(request: pytest.FixtureRequest) -> Config:
    return load(SIM.with_name(f"{request.param}.toml"))


@pytest.mark.generated(0, 1, 2, 3)
def test_each_sliders_own_stroke_bounds_the_workspace(stage: Config, seed: int) -> None:
    """By brute force: of many poses those are within that no slider's own travel forbids."""
    random = np.random.default_rng(seed)
    low, high = random.uniform((-0.01, 0.002), (-0.002, 0.01), (3, 2)).T
    slider = msgspec.structs.replace(stage.limits.slider, position=tuple(zip(low.tolist(), high.tolist(), strict=True)))
    robot, limits = geometry(stage.geometry), msgspec.structs.replace(stage.limits, slider=slider)
    phi = random.uniform(-0.05, 0.05)
    poses = random.uniform((-0.01, -0.01, phi), (0.01, 0.01, phi), (200, 3))
    motion = inverse(robot, poses)
    inside = ((motion.position >= low) & (motion.position <= high)).all(axis=1)
    inside &= (np.abs(motion.passive_position) <= 0.018).all(axis=1)
    assert [not violations(robot, limits, pose) for pose in poses] == inside.tolist()
    polygon = permitted_slice(robot, limits, phi)
    sides = np.roll(polygon, -1, axis=0) - polygon
    arms = poses[:, None, :2] - polygon
    cross = sides[:, 0] * arms[..., 1] - sides[:, 1] * arms[..., 0]
    assert ((cross >= 0.0).all(axis=1) & (len(polygon) > 0)).tolist() == inside.tolist()
    travel = RobotParts.from_geometry(robot, slider).travel
    assert [np.linalg.norm(end - start) for start, end in travel] == pytest.approx(high - low)


@pytest.mark.parametrize("phi", [0.0, 0.04, -0.087])
def test_a_slice_is_where_no_limit_is_exceeded(stage: Config, phi: float) -> None:
    robot, limits = geometry(stage.geometry), stage.limits
    polygon = reachable_slice(robot, limits, phi)
    sides = np.roll(polygon, -1, axis=0) - polygon
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    for x, y in np.random.default_rng(0).uniform(-0.016, 0.016, (60, 2)):
        arms = (x, y) - polygon
        depth = float((sides[:, 0] * arms[:, 1] - sides[:, 1] * arms[:, 0]).min())
        if abs(depth) > 1e-6:
            assert (depth > 0.0) == (not violations(robot, limits, (x, y, phi))), (x, y, depth)
    for vertex in polygon:  # exact: beyond no limit, and on two
        motion = inverse(robot, (*vertex, phi))
        spare = [0.01 - np.abs(motion.position), 0.018 - np.abs(motion.passive_position)]
        assert np.sort(np.abs(np.concatenate(spare)))[1] < 1e-12


def test_the_extent_is_that_of_the_strokes(stage: Config) -> None:
    found = measure_extent(geometry(stage.geometry), stage.limits, permitted_slice)
    assert_allclose((*found.x, *found.y), (-0.01, 0.01, -0.01, 0.01), atol=1e-9)
    assert_allclose(found.phi, stage.limits.platform.phi, atol=1e-9)
    assert found.volume > 0.0


def test_the_distance_to_a_singularity_is_that_to_the_nearest_singular_angle(stage: Config) -> None:
    robot = geometry(stage.geometry)
    poses = np.random.default_rng(1).uniform((-0.01, -0.01, -1.2), (0.01, 0.01, 1.2), (50, 3))
    for pose, distance in zip(poses, distance_to_singularity(robot, poses), strict=True):
        if distance > 0.0:
            nearest = min(abs(angle - pose[2]) for angle in singular_angles(robot, (pose[0], pose[1])))
            assert distance == pytest.approx(nearest, abs=1e-9)
    singular = max(angle for angle in singular_angles(robot) if angle < 0.0)
    assert min(abs(np.linalg.det(each)) for each in jacobians(robot, (0.0, 0.0, singular + 1e-9))) < 1e-6
    assert 0.2 < conditioning(robot, (0.0, 0.0, 0.0)) <= 1.0


def test_rails_carriages_cross_slides_and_table_are_drawn_where_they_are(stage: Config) -> None:
    robot = geometry(stage.geometry)
    parts = RobotParts.from_geometry(robot, stage.limits.slider)
    pose = np.array([[0.003, -0.002, 0.06]])
    motion = inverse(robot, pose)
    carriages = part_positions.slider_points(robot, motion.position)
    pivots = part_positions.pivot_points(robot, carriages, pose)
    lines = part_positions.cross_slide_lines(robot, parts, carriages, pose[:, 2])
    for k, leg in enumerate(robot.each):
        rail = carriages[0, k] - leg.anchor
        assert rail @ (-math.sin(leg.rail_angle), math.cos(leg.rail_angle)) == pytest.approx(0.0, abs=1e-12)
        start, end = lines[0, k]
        along, across = end - start, pivots[0, k] - start
        assert along[0] * across[1] - along[1] * across[0] == pytest.approx(0.0, abs=1e-12)  # the pivot is on it
        apart = float(np.linalg.norm(pivots[0, k] - carriages[0, k]))
        assert apart == pytest.approx(abs(motion.passive_position[0, k]) if robot.kind == "3-PPR" else 0.0, abs=1e-12)
    table = parts.outline[-1]
    held = [leg.crossing.point for leg in robot.each]
    assert np.all(table.min(axis=0) < np.min(held, axis=0))
    assert np.all(table.max(axis=0) > np.max(held, axis=0))
    assert all(np.linalg.norm(rail[1] - rail[0]) == pytest.approx(0.03) for rail in parts.rails)
