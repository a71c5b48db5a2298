"""Singularity and workspace: closed forms of the symmetric robot, and random robots against brute force."""

import math
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from trirail.config import SIM, Limits, corrected_geometry, load
from trirail.errors import KinematicsError
from trirail.kinematics.correction import Correction
from trirail.kinematics.geometry import Geometry, Leg, singular_angles
from trirail.kinematics.robot import inverse, jacobians
from trirail.workspace.aspect import phi_range
from trirail.workspace.reach import ANGLE_STEP_RAD, Reach
from trirail.workspace.singularity import (
    characteristic_length,
    conditioning,
    distance_to_singularity,
    sensitivity,
)
from trirail.workspace.violations import violations
from trirail.workspace.workspace import measure_extent, permitted_slice, polygon_area, reachable_slice

Array = NDArray[np.float64]

L0 = 0.3
PAPER = Geometry.symmetric(L0)
LIMITS = load(SIM).limits


def limited(position: tuple[float, float], passive: tuple[float, float], margin: float = 0.15) -> Limits:
    slider = msgspec.structs.replace(LIMITS.slider, position=position, passive=passive)
    return msgspec.structs.replace(LIMITS, slider=slider, singularity_margin=margin)


def as_built(seed: int, share: float) -> Geometry:
    """Displace every number of the symmetric robot by up to a share of l0, or so many radians."""
    random = np.random.default_rng(seed)
    a, b, c = (
        Leg(
            anchor=(leg.anchor[0] + L0 * u[0], leg.anchor[1] + L0 * u[1]),
            rail_angle=leg.rail_angle + u[2],
            home=leg.home + L0 * u[3],
            edge_point=(leg.edge_point[0] + L0 * u[4], leg.edge_point[1] + L0 * u[5]),
            edge_angle=leg.edge_angle + u[6],
        )
        for leg, u in zip(PAPER.legs, random.uniform(-share, share, (3, 7)).tolist(), strict=True)
    )
    return Geometry(legs=(a, b, c))


def any_robot(seed: int) -> Geometry:
    """Draw three legs that have nothing in common."""
    random = np.random.default_rng(seed)
    while True:
        a, b, c = (
            Leg(anchor=(u[0], u[1]), rail_angle=4 * u[2], home=u[3], edge_point=(u[4], u[5]), edge_angle=4 * u[6])
            for u in random.uniform(-0.5, 0.5, (3, 7)).tolist()
        )
        try:
            return Geometry(legs=(a, b, c))
        except KinematicsError:
            continue


seeds = st.integers(0, 2**32 - 1)
near_robots = st.builds(as_built, seeds, st.sampled_from([0.003, 0.03, 0.1]))
robots = st.just(PAPER) | near_robots | st.builds(any_robot, seeds)
some_limits = st.builds(
    lambda low, high, inner, outer, margin: limited((-low, high), (-inner, outer), margin),
    *[st.floats(0.05, 0.6)] * 4,
    st.floats(0.01, 0.4),
)


# ---- singularity


@given(robots, seeds)
@settings(deadline=None)
def test_sensitivities_are_the_sliders_velocities(robot: Geometry, seed: int) -> None:
    random = np.random.default_rng(seed)
    pose, velocity = random.uniform(-0.3, 0.3, (2, 5, 3))
    try:
        found = sensitivity(robot, pose)
    except KinematicsError:
        assume(False)
    expected = inverse(robot, pose, velocity).velocity
    assert_allclose(np.einsum("nij,nj->ni", found, velocity), expected, rtol=1e-9, atol=1e-9 * np.abs(found).max())


@pytest.mark.parametrize("l0", [0.05, 0.3, 4.0])
def test_the_symmetric_robot_is_isotropic_at_home(l0: float) -> None:
    """With G at the origin the three sliders differ by turns of 120°, and turning moves them all alike."""
    robot = Geometry.symmetric(l0)
    assert_allclose(characteristic_length(robot), l0 / math.sqrt(6), rtol=1e-12)
    assert_allclose(conditioning(robot, [0.0, 0.0, 0.0]), 1.0, rtol=1e-12)
    phi = np.linspace(-2.0, 1.0, 31)
    turning = np.tan(math.pi / 6 - phi / 2) / math.tan(math.pi / 6)
    poses = np.column_stack([np.zeros((31, 2)), phi])
    assert_allclose(conditioning(robot, poses), np.minimum(turning, 1 / turning), rtol=1e-10)


@given(near_robots, seeds, st.floats(0.01, 100.0), st.floats(-3.0, 3.0))
@settings(deadline=None)
def test_conditioning_does_not_depend_on_the_units_or_frames(
    robot: Geometry, seed: int, size: float, turn: float
) -> None:
    """The same robot in other units of length and turned as a whole, with other zeros of its joints."""
    c, s = size * math.cos(turn), size * math.sin(turn)

    def moved(x: float, y: float) -> tuple[float, float]:
        return c * x - s * y, s * x + c * y

    a, b, d = (
        replace(
            leg,
            anchor=moved(*leg.anchor),
            rail_angle=leg.rail_angle + turn,
            home=leg.home * size - 0.1,
            edge_point=moved(
                leg.edge_point[0] + 0.02 * math.cos(leg.edge_angle), leg.edge_point[1] + 0.02 * math.sin(leg.edge_angle)
            ),
            edge_angle=leg.edge_angle + turn,
        )
        for leg in robot.legs
    )
    other = Geometry(legs=(a, b, d))
    x, y, phi = np.random.default_rng(seed).uniform(-0.1, 0.1, 3).tolist()
    assert_allclose(characteristic_length(other), size * characteristic_length(robot), rtol=1e-9)
    assert_allclose(conditioning(other, [*moved(x, y), phi]), conditioning(robot, [x, y, phi]), rtol=1e-8)


def test_conditioning_with_a_length_of_ones_own() -> None:
    pose, length = [0.02, -0.03, 0.2], 0.5
    scaled = sensitivity(PAPER, pose) @ np.diag([1.0, 1.0, 1.0 / length])
    assert_allclose(conditioning(PAPER, pose, length), 1.0 / np.linalg.cond(scaled), rtol=1e-12)


@given(robots, seeds)
@settings(deadline=None)
def test_the_distance_is_to_the_nearest_singular_angle(robot: Geometry, seed: int) -> None:
    poses = np.random.default_rng(seed).uniform([-0.3, -0.3, -7.0], [0.3, 0.3, 7.0], (6, 3))
    of_j1 = np.sort([(leg.rail_angle - leg.edge_angle) % math.pi for leg in robot.legs])
    gaps = np.diff([*of_j1, of_j1[0] + math.pi])
    assume(all(gap < 1e-12 or gap > 1e-3 for gap in gaps))
    try:
        distances = distance_to_singularity(robot, poses)
    except KinematicsError:
        assume(False)
    for (x, y, phi), distance in zip(poses.tolist(), distances, strict=True):
        away = [abs(math.remainder(phi - angle, 2 * math.pi)) for angle in singular_angles(robot, (x, y))]
        assert_allclose(abs(distance), min(away), atol=1e-9)
        assert_allclose(distance_to_singularity(robot, (x, y, phi)), distance, atol=1e-12)


def test_the_distance_is_negative_in_another_aspect() -> None:
    poses = np.column_stack([np.full((5, 2), 0.04), [0.0, 1.0, 1.1, -2.0, -2.2]])
    low, high = -2 * math.pi / 3, math.pi / 3
    expected = [high, high - 1.0, high - 1.1, -2.0 - low, -2.2 - low]
    assert_allclose(distance_to_singularity(PAPER, poses), expected, atol=1e-12)
    assert_allclose(phi_range(PAPER), [low, high], atol=1e-12)


def test_beyond_a_singularity_of_j2_alone_the_distance_is_negative_too() -> None:
    robot = next(
        robot
        for robot in (as_built(seed, 0.01) for seed in range(100))
        if min(angle for angle in singular_angles(robot) if angle > 0.0) < phi_range(robot)[1] - 0.1
    )
    nearest = min(angle for angle in singular_angles(robot) if angle > 0.0)
    for step in (0.02, -0.02):
        assert_allclose(distance_to_singularity(robot, [0.0, 0.0, nearest - step]), step, atol=1e-9)


@pytest.mark.parametrize("function", [conditioning, distance_to_singularity, sensitivity])
def test_singular_and_senseless_poses_are_refused(function: Callable[[Geometry, list[float]], Array]) -> None:
    with pytest.raises(KinematicsError, match="leg A: edge parallel to its rail"):
        function(PAPER, [0.0, 0.0, math.pi / 3])
    with pytest.raises(KinematicsError, match="pose y is nan: it must be finite"):
        function(PAPER, [0.0, math.nan, 0.0])


# ---- slices


def slack(robot: Geometry, limits: Limits, poses: Array) -> Array:
    """Return by how much all limits of the robot's own reach are kept, (N, 13): of joints, then of the margin.

    For the margin it is the least distance of any leg's angle from singular, or the least |det J2|, as the
    platform turns so far either way; negative beyond.
    """
    motion = inverse(robot, poses)
    position, passive = motion.position, motion.passive_position
    (low, high), (inner, outer) = limits.slider.positions[0], limits.slider.passive
    start, end = phi_range(robot)
    phi, margin = poses[:, 2], limits.singularity_margin
    left = np.minimum(phi - start, end - phi) - margin
    for turn in np.linspace(-margin, margin, 257):
        det = np.linalg.det(jacobians(robot, poses + np.array([0.0, 0.0, turn]))[1])
        left = np.minimum(left, det * np.sign(np.linalg.det(jacobians(robot, np.zeros(3))[1])))
    return np.column_stack([position - low, high - position, passive - inner, outer - passive, left])


def contains(polygon: Array, points: Array) -> NDArray[np.bool_]:
    """Return which points lie to the left of every side."""
    if len(polygon) == 0:
        return np.zeros(len(points), dtype=np.bool_)
    sides = np.roll(polygon, -1, axis=0) - polygon
    arms = points[:, np.newaxis] - polygon
    return np.asarray((sides[:, 0] * arms[..., 1] - sides[:, 1] * arms[..., 0] >= 0.0).all(axis=1))


@given(robots, some_limits, st.floats(-2.2, 1.5))
@settings(max_examples=300, deadline=None)
def test_a_slice_is_where_every_limit_is_kept(robot: Geometry, limits: Limits, phi: float) -> None:
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 11), np.linspace(-0.5, 0.5, 11))
    poses = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, phi)])
    try:
        least = slack(robot, limits, poses).min(axis=1)
    except KinematicsError:
        assume(False)
    clear = np.abs(least) > 1e-4
    inside = contains(reachable_slice(robot, limits, phi), poses[:, :2])
    assert_allclose(inside[clear], least[clear] > 0.0)


@given(robots, some_limits, st.floats(-1.0, 0.8))
@settings(max_examples=300, deadline=None)
def test_at_every_vertex_two_limits_are_reached(robot: Geometry, limits: Limits, phi: float) -> None:
    polygon = reachable_slice(robot, limits, phi)
    assume(len(polygon) > 0)
    assert polygon_area(polygon) > 0.0
    poses = np.column_stack([polygon, np.full(len(polygon), phi)])
    kept = slack(robot, limits, poses)
    rounding = 1e-12 * (1.0 + np.abs(sensitivity(robot, poses)).max())
    assert kept[:, :-1].min() > -rounding
    cut_by_margin = kept[:, -1] < 1e-6
    assert (np.count_nonzero(kept[:, :-1] < rounding, axis=1)[~cut_by_margin] >= 2).all()


def test_vertices_are_exact() -> None:
    for phi in np.linspace(-1.0, 0.85, 41):
        polygon = reachable_slice(PAPER, LIMITS, phi)
        kept = slack(PAPER, LIMITS, np.column_stack([polygon, np.full(len(polygon), phi)]))[:, :-1]
        assert kept.min() > -1e-12
        assert (np.count_nonzero(kept < 1e-12, axis=1) >= 2).all()


@given(st.floats(-5e-4, 5e-4), st.floats(-5e-4, 5e-4), st.floats(0.5, 3.0), st.floats(-0.9, 0.7))
@settings(deadline=None)
def test_with_as_built_errors_a_slice_is_as_far_off_as_they_are_curved(
    x: float, y: float, curvature: float, phi: float
) -> None:
    nodes, along = np.zeros((7, 7, 7, 3)), np.linspace(-1.25, 1.25, 7)
    nodes[..., 0], nodes[..., 1] = x * np.sin(curvature * along)[:, None, None], y * np.sin(curvature * along)[:, None]
    robot = replace(PAPER, correction=Correction((-0.15, -0.15, -1.2), (0.15, 0.15, 0.85), nodes))
    polygon = reachable_slice(robot, LIMITS, phi)
    kept = slack(robot, LIMITS, np.column_stack([polygon, np.full(len(polygon), phi)]))[:, :-1]
    # A linear function differs from x * sin(curvature * along) by at most x, and both errors move every slider.
    assert np.abs(kept).min(axis=1).max() <= 1.1 * (abs(x) + abs(y)) + 1e-12


@given(robots, some_limits, st.floats(-1.0, 0.8))
@settings(deadline=None)
def test_slices_are_convex_and_anticlockwise(robot: Geometry, limits: Limits, phi: float) -> None:
    polygon = permitted_slice(robot, limits, phi)
    assume(len(polygon) > 0)
    assert len(polygon) >= 3
    sides = np.roll(polygon, -1, axis=0) - polygon
    following = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    assert turns.min() > -1e-12
    (left, right), (bottom, top) = LIMITS.platform.x, LIMITS.platform.y
    assert (polygon >= np.array([left, bottom]) - 1e-12).all()
    assert (polygon <= np.array([right, top]) + 1e-12).all()


@pytest.mark.parametrize(("low", "high"), [(0.17, 0.34), (0.1, 0.3), (0.15, 0.2), (0.1, 0.1), (0.17, 0.12)])
def test_the_area_at_zero_by_hand(low: float, high: float) -> None:
    """At phi = 0 the three sliders sum to zero, and the passive joints are the same numbers in other order.

    lambda >= -low leaves an equilateral triangle of height 3 low in lambda, the distance times 2/√3: its area is
    9√3/4 low². lambda <= high takes off three corners, alike and of height 2 low - high.
    """
    corner = max(2 * low - high, 0.0)
    expected = math.sqrt(3) / 4 * ((3 * low) ** 2 - 3 * corner**2)
    polygon = reachable_slice(PAPER, limited((-low, high), (-low, high)), 0.0)
    assert_allclose(polygon_area(polygon), expected, rtol=1e-12)
    assert len(polygon) == (3 if corner == 0.0 else 6)


def test_the_window_at_zero_by_hand() -> None:
    """The triangle of sim.toml, y >= -0.17 √3/2 with its tip at y = 0.17 √3, cut to |x|, |y| <= 0.15."""
    bottom, tip, half = -0.17 * math.sqrt(3) / 2, 0.17 * math.sqrt(3), 0.15
    bend = tip - half * math.sqrt(3)  # up to here the window is narrower than the triangle
    above = ((tip - bend) ** 2 - (tip - half) ** 2) / math.sqrt(3)
    assert_allclose(polygon_area(permitted_slice(PAPER, LIMITS, 0.0)), 2 * half * (bend - bottom) + above, rtol=1e-12)


def test_outside_of_the_window_and_beyond_the_margin_nothing_is_left() -> None:
    low, high = phi_range(PAPER)
    everything = limited((-9.0, 9.0), (-9.0, 9.0), margin=0.2)
    for end, inwards in ((low, 0.2), (high, -0.2)):
        assert len(reachable_slice(PAPER, everything, end + inwards * 1.0001)) > 0
        assert len(reachable_slice(PAPER, everything, end + inwards * 0.9999)) == 0
        # as near to a singular angle as the margin lets slices come, rounding leaves them whole
        at_end, before = (
            polygon_area(reachable_slice(PAPER, everything, end + inwards * part)) for part in (1 + 1e-9, 1.0001)
        )
        assert_allclose(at_end, before, rtol=1e-3)
    assert len(reachable_slice(PAPER, everything, 2.0)) == 0  # another aspect
    assert_allclose(
        reachable_slice(PAPER, everything, 0.3 - 2 * math.pi), reachable_slice(PAPER, everything, 0.3), atol=1e-9
    )
    assert len(permitted_slice(PAPER, LIMITS, 0.8499)) > 0
    assert len(permitted_slice(PAPER, LIMITS, 0.8501)) == 0 < len(reachable_slice(PAPER, LIMITS, 0.8501))


@pytest.mark.parametrize("seed", [4, 5, 10])
def test_the_margin_cuts_a_slice_of_a_robot_as_built(seed: int) -> None:
    """There det J2 depends on G: at the same angle one part of a slice keeps the margin and another does not."""
    robot = as_built(seed, 0.01)
    nearest = min(angle for angle in singular_angles(robot) if angle > 0.0)
    assert nearest < phi_range(robot)[1] - 0.1
    origin = np.zeros((1, 2))
    wide, narrow = (
        reachable_slice(robot, limited((-0.5, 0.5), (-0.5, 0.5), m), nearest - 0.1) for m in (0.0999, 0.1001)
    )
    assert contains(wide, origin)
    assert not contains(narrow, origin)
    assert 0.0 < polygon_area(narrow) < polygon_area(wide)


# ---- violations


def test_violations_name_leg_value_and_limit() -> None:
    assert violations(PAPER, LIMITS, [0.0, 0.0, 0.0]) == []
    found = violations(PAPER, LIMITS, [0.3, 0.0, 0.0])  # by hand: lambda = 0, -x, x; the passive ones x, 0, -x
    assert [(v.axis, v.quantity, v.limit) for v in found] == [
        ("B", "position", -0.17),
        ("C", "passive position", -0.17),
    ]
    assert_allclose([v.value for v in found], -0.3, atol=1e-12)
    (near,) = violations(PAPER, LIMITS, [0.0, 0.0, 1.0])
    assert (near.axis, near.quantity, near.limit, near.unit) == ("phi", "distance to singularity", 0.15, "rad")
    assert_allclose(near.value, math.pi / 3 - 1.0, atol=1e-12)


@given(robots, some_limits, seeds)
@settings(deadline=None)
def test_a_pose_in_the_slice_violates_nothing(robot: Geometry, limits: Limits, seed: int) -> None:
    x, y, phi = np.random.default_rng(seed).uniform(-0.3, 0.3, 3).tolist()
    least = slack(robot, limits, np.array([[x, y, phi]])).min()
    assume(abs(least) > 1e-3)
    inside = contains(reachable_slice(robot, limits, phi), np.array([[x, y]]))[0]
    assert inside == (violations(robot, limits, [x, y, phi]) == [])


# ---- over all phi


def test_extents_by_hand() -> None:
    """The slice at zero is the widest; a platform at the origin turns until all three sliders meet an end."""
    found = measure_extent(PAPER, LIMITS, reachable_slice)
    assert_allclose(found.x, [-0.255, 0.255], atol=1e-9)
    assert_allclose(found.y[1], 0.17 * math.sqrt(3), atol=1e-9)
    sliders = 3 * -0.17
    turned = 2 * math.atan2(math.sqrt(3) * sliders, 2 * math.sqrt(3) * L0 - sliders)
    assert_allclose(found.phi, [turned, math.pi / 3 - 0.15], atol=1e-6)
    assert_allclose([found.best_phi, found.best_area], [0.0, 9 * math.sqrt(3) / 4 * 0.17**2], atol=1e-8)
    assert found.areas.shape == found.angles.shape
    assert (np.diff(found.angles) > 0.0).all()


@given(near_robots, st.floats(-0.3, 0.3), st.floats(1e-5, 0.02))
@settings(max_examples=20, deadline=None)
def test_a_narrow_window_of_phi_is_found(robot: Geometry, middle: float, half: float) -> None:
    phi = middle - half, middle + half
    limits = msgspec.structs.replace(LIMITS, platform=msgspec.structs.replace(LIMITS.platform, phi=phi))
    assert_allclose(measure_extent(robot, limits, permitted_slice).phi, phi, atol=1e-9)


@pytest.mark.parametrize("travel", [1e-2, 1e-3, 1e-4, 5e-5])
@pytest.mark.parametrize("phi", [(-0.05, 0.1), (-1.2, 0.85), (-0.01, 0.02)])
def test_the_range_that_short_sliders_allow_is_found(travel: float, phi: tuple[float, float]) -> None:
    """It is narrower than the samples between the limits of the platform."""
    config = load(SIM)
    sliders = msgspec.structs.replace(config.limits.slider, position=(-travel, travel), passive=(-travel, travel))
    platform = msgspec.structs.replace(config.limits.platform, phi=phi)
    limits = msgspec.structs.replace(config.limits, slider=sliders, platform=platform)
    low, high = measure_extent(corrected_geometry(config), limits, permitted_slice).phi
    assert low < 0.0 < high


@pytest.mark.parametrize("robot", [PAPER, as_built(1, 0.01)])
@pytest.mark.long
def test_the_volume_by_chance(robot: Geometry) -> None:
    """Poses drawn at random in a box around the window, against the joints' limits."""
    found = measure_extent(robot, LIMITS, permitted_slice)
    window = LIMITS.platform
    low, high = np.array([window.x, window.y, window.phi]).T
    poses = np.random.default_rng(0).uniform(low, high, (10_000, 3))
    hit = slack(robot, LIMITS, poses).min(axis=1) > 0.0
    box, share = float(np.prod(high - low)), float(hit.mean())
    assert_allclose(found.volume, box * share, atol=5 * box * math.sqrt(share * (1 - share) / len(poses)))
    inside = poses[hit]
    for k, (start, end) in enumerate((found.x, found.y, found.phi)):
        assert start - 1e-9 <= inside[:, k].min() < start + 0.1
        assert end - 0.1 < inside[:, k].max() <= end + 1e-9


def test_limits_that_leave_nothing_are_refused() -> None:
    with pytest.raises(KinematicsError, match="no pose is within the limits"):
        measure_extent(PAPER, limited((0.2, 0.3), (-0.3, -0.2)), reachable_slice)


@pytest.mark.parametrize("name", ["sim.toml", "uvw.toml", "uvw-ppr.toml", "xxy.toml", "socketcan.toml"])
@example(low=0.0, width=1.0, place=0.0, beyond=1e-6)
@example(low=0.5, width=1e-3, place=0.5, beyond=1e-6)
@given(low=st.floats(0.0, 0.9), width=st.floats(1e-4, 1.0), place=st.floats(0.0, 1.0), beyond=st.floats(1e-6, 0.1))
def test_the_workspace_has_an_outline_exactly_where_phi_is_permitted(
    name: str, low: float, width: float, place: float, beyond: float
) -> None:
    """The limits of φ are a part of the configured range: `low` and `width` are shares of that range."""
    config = load(SIM.with_name(name))
    robot, limits = corrected_geometry(config), config.limits
    first, last = limits.platform.phi
    begin = first + low * (last - first)
    end = begin + min(width, 1.0 - low) * (last - first)
    platform = msgspec.structs.replace(limits.platform, phi=(begin, end))
    limits = msgspec.structs.replace(limits, platform=platform)
    reach, tolerance = Reach(robot, limits), limits.in_position.pose[2]
    angles = np.array([begin + place * (end - begin), begin - tolerance - beyond, end + tolerance + beyond])
    inside, below, above = (len(reach.outline(step)) > 0 for step in reach.outline_indices(angles))
    assert (below, above) == (False, False)
    near = np.clip(angles[0] + ANGLE_STEP_RAD * np.linspace(-0.5, 0.5, 5), begin, end)
    permitted = {len(permitted_slice(robot, limits, phi)) > 0 for phi in near.tolist()}
    assert inside in permitted
