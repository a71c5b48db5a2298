"""The 3-PPR mechanism: 60-digit truth on random robots, numbers of other people's stages, properties, refusals."""

import math
from typing import Any

import exact
import numpy as np
import pytest
from hypothesis import assume, given, reject
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from trirail.errors import KinematicsError
from trirail.kinematics.geometry import CrossLeg, Geometry, Leg, gains, singular_angles, travels
from trirail.kinematics.robot import forward, inverse, jacobians

RIGHT = math.pi / 2.0
P = 0.0575


def stage(*carriages: tuple[float, float, float]) -> Geometry:
    """A stage with its carriages at (x, y) on rails at an angle, cross slides across them."""
    a, b, c = (CrossLeg((x, y), angle, 0.0, (x, y), angle + RIGHT) for x, y, angle in carriages)
    return Geometry((a, b, c))


UVW = stage((P, -P, 0.0), (P, P, 0.0), (-P, P, RIGHT))


def of_kind_1(robot: Geometry) -> Geometry:
    """The 3-PRP stage whose carriages, rails and cross slides are in the same places."""
    legs = [Leg(leg.anchor, leg.rail_angle, leg.home, leg.anchor, leg.cross_angle) for leg in robot.legs]
    return Geometry((legs[0], legs[1], legs[2]))


def test_a_cross_slide_is_square_to_its_rail_where_nobody_says_otherwise() -> None:
    legs = [CrossLeg(leg.anchor, leg.rail_angle, leg.home, leg.pivot) for leg in UVW.legs]
    assert Geometry(kind="3-PPR", legs=(legs[0], legs[1], legs[2])) == UVW
    assert UVW.kind == "3-PPR"
    with pytest.raises(KinematicsError, match=r"kind is '3-PRP', but the legs are those of a 3-PPR robot"):
        Geometry(kind="3-PRP", legs=UVW.legs)


lengths = st.floats(-0.3, 0.3)
angles = st.floats(-math.pi, math.pi)


@st.composite
def robots(draw: st.DrawFn) -> Geometry:
    legs = []
    for _ in range(3):
        rail, points = draw(angles), st.tuples(lengths, lengths)
        cross = rail + draw(st.sampled_from((-1.0, 1.0))) * draw(st.floats(0.5, 2.6))
        legs.append(CrossLeg(draw(points), rail, draw(lengths), draw(points), cross))
    try:
        robot = Geometry((legs[0], legs[1], legs[2]))
    except KinematicsError:
        reject()
    assume(regular(robot, (0.0, 0.0, 0.0)))
    return robot


def regular(robot: Geometry, pose: Any) -> bool:
    return bool(abs(np.linalg.det(jacobians(robot, pose)[1])) > 0.02)


poses = st.tuples(lengths, lengths, st.floats(-1.5, 1.5))


def truth(leg: CrossLeg, pose: tuple[float, float, float]) -> tuple[float, float]:
    slider, passive = exact.travels(leg.anchor, leg.rail_angle, leg.home, leg.pivot, leg.cross_angle, False, pose)
    return float(slider), float(passive)


@given(robots(), poses)
def test_positions_are_those_of_60_digits(robot: Geometry, pose: tuple[float, float, float]) -> None:
    expected = np.array([truth(leg, pose) for leg in robot.legs if isinstance(leg, CrossLeg)]).T
    motion = inverse(robot, pose)
    assert_allclose(np.array(motion[::3]), expected, rtol=0.0, atol=1e-12)
    assert_allclose(travels(robot, pose), expected, rtol=0.0, atol=1e-12)
    assume(regular(robot, pose))
    assert_allclose(forward(robot, expected[0], near=pose), pose, rtol=0.0, atol=1e-12)


@given(robots(), poses)
def test_both_poses_that_close_the_loops_are_found(robot: Geometry, pose: tuple[float, float, float]) -> None:
    """With det J2 = A sin phi - B cos phi they lie on either side of a singular angle, as far from it."""
    assume(regular(robot, pose))
    sliders = inverse(robot, pose).position
    middle = min(singular_angles(robot), key=lambda at: abs(math.remainder(at - pose[2], math.tau)))
    other = forward(robot, sliders, near=(0.0, 0.0, 2.0 * middle - pose[2]))
    assert_allclose(inverse(robot, other).position, sliders, atol=1e-10)
    assert math.remainder(other[2] - (2.0 * middle - pose[2]), math.tau) == pytest.approx(0.0, abs=1e-10)


@given(robots(), poses, poses, poses)
def test_rates_are_derivatives(robot: Geometry, pose: Any, velocity: Any, acceleration: Any) -> None:
    """By central differences of the 60-digit truth along p + v t + a t² / 2."""
    h, p, v, a = 1e-4, np.array(pose), np.array(velocity), np.array(acceleration)
    motion = inverse(robot, p, v, a)
    for i, leg in enumerate(robot.legs):
        assert isinstance(leg, CrossLeg)
        before, now, after = (np.array(truth(leg, tuple(p + v * t + a * t * t / 2.0))) for t in (-h, 0.0, h))
        rates = motion.velocity[i], motion.passive_velocity[i]
        assert_allclose(rates, (after - before) / (2.0 * h), atol=1e-7)
        changes = motion.acceleration[i], motion.passive_acceleration[i]
        assert_allclose(changes, (after - 2.0 * now + before) / h**2, atol=1e-6)


@given(robots(), poses, poses)
def test_jacobians_connect_the_rates(robot: Geometry, pose: Any, velocity: Any) -> None:
    j1, j2 = jacobians(robot, pose)
    assert_allclose(j1 @ inverse(robot, pose, velocity).velocity, j2 @ np.array(velocity), atol=1e-12)
    assume(regular(robot, pose))
    assert_allclose(j2 @ gains(robot, pose), j1, atol=1e-10)


@given(robots(), st.tuples(lengths, lengths))
def test_the_determinant_changes_sign_at_two_angles_wherever_the_centre_is(robot: Geometry, centre: Any) -> None:
    low, high = singular_angles(robot, centre)
    assert high - low == pytest.approx(math.pi)
    assert singular_angles(robot) == (low, high)
    for phi in (low, high):
        signs = [np.sign(np.linalg.det(jacobians(robot, (*centre, phi + by))[1])) for by in (-1e-6, 1e-6)]
        assert signs[0] == -signs[1] != 0.0


DEGREE = math.radians(1.0)


@pytest.mark.parametrize(
    ("pose", "kind_1", "kind_2"),
    [
        ((0.0, 0.0, DEGREE), (1.012425, -0.994907, -0.994907), (0.994756, -1.012271, -1.012271)),
        ((3e-3, -2e-3, 5 * DEGREE), (8.075261, -1.985935, -7.073423), (7.792650, -2.230260, -7.230260)),
    ],
)
def test_the_two_kinds_of_a_uvw_stage_in_numbers(pose: Any, kind_1: Any, kind_2: Any) -> None:
    assert_allclose(inverse(UVW, pose).position * 1e3, kind_2, atol=5.1e-7)
    assert_allclose(inverse(of_kind_1(UVW), pose).position * 1e3, kind_1, atol=5.1e-7)


@given(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.floats(-0.09, 0.09), st.tuples(lengths, lengths))
def test_the_equations_of_drives_along_x_and_y(x: float, y: float, phi: float, at: tuple[float, float]) -> None:
    px, py = at
    assume(abs(py) > 0.01)
    robot = stage((px, py, 0.0), (px, py, RIGHT), (px, -py, 0.0))
    along_x = x + px * (math.cos(phi) - 1.0) - py * math.sin(phi)
    along_y = y + px * math.sin(phi) + py * (math.cos(phi) - 1.0)
    assert_allclose(inverse(robot, (x, y, phi)).position[:2], (along_x, along_y), atol=1e-15)
    tan, less = math.tan(phi), 1.0 / math.cos(phi) - 1.0
    along_x, along_y = x + (y - py) * tan + px * less, y - (x - px) * tan + py * less
    assert_allclose(inverse(of_kind_1(robot), (x, y, phi)).position[:2], (along_x, along_y), atol=1e-15)


def test_the_numbers_of_a_public_program_for_kind_2() -> None:
    """UVWTrans: U at (-180, 180) along y, V at (180, 180) and W at (-180, -180) along x, in mm, at (1, 2, 1°)."""
    robot = stage((-0.18, 0.18, RIGHT), (0.18, 0.18, 0.0), (-0.18, -0.18, 0.0))
    expected = (-1.168848, -2.168848, 4.168848)
    assert_allclose(inverse(robot, (1e-3, 2e-3, DEGREE)).position * 1e3, expected, atol=5.1e-7)


def test_the_default_of_a_wafer_aligner() -> None:
    """70 mm and 1° are 1.2216684 mm."""
    robot = stage((0.0, -0.07, 0.0), (0.07, 0.0, RIGHT), (0.0, 0.07, 0.0))
    assert inverse(robot, (0.0, 0.0, DEGREE)).position[0] * 1e3 == pytest.approx(1.2216684, abs=1e-7)


def test_what_cannot_be_is_refused() -> None:
    a, b, c = UVW.legs
    along = CrossLeg((0.0, 0.0), 0.3, 0.0, (0.1, 0.0), 0.3 - math.pi)
    with pytest.raises(KinematicsError, match="leg B: slide_angle is parallel to rail_angle") as refused:
        Geometry((a, along, c))
    assert refused.value.leg == "B"
    with pytest.raises(KinematicsError, match=r"leg C: pivot is .* it must be finite"):
        Geometry((a, b, CrossLeg((0.0, 0.0), 0.3, 0.0, (math.nan, 0.0), 1.0)))
    with pytest.raises(KinematicsError, match="cannot hold the platform"):
        stage((P, -P, 0.0), (P, P, 0.0), (-P, P, 0.0))  # nothing holds it along y
    with pytest.raises(KinematicsError, match="different mechanisms: 3-PPR, 3-PPR, 3-PRP"):
        Geometry((a, b, of_kind_1(UVW).legs[2]))


def test_sliders_that_no_pose_closes_are_refused() -> None:
    with pytest.raises(KinematicsError, match="no pose closes the loops, which reach 115"):
        forward(UVW, (0.1, -0.1, 0.0))
    with pytest.raises(KinematicsError, match="singular"):
        forward(UVW, (0.0, 0.0, 0.0), near=(0.0, 0.0, RIGHT))
