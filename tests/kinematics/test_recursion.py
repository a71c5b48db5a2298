"""The recursion for any planar leg, against finite differences and the paper's equations in numpy."""

import math
from typing import Literal

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from kinematics.calculus import differences, theta
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from trirail.kinematics.joints import Joint, serial_leg
from trirail.kinematics.recursion import follow, joint_motion, platform_centre, platform_motion

Array = NDArray[np.float64]
Kind = Literal["prismatic", "revolute"]

THETA_1 = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
U3 = np.array([0.0, 0.0, 1.0])
TIME = 0.7


def tilde(x: Array) -> Array:
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


class Swinging:
    """A leg of random joints whose variables swing, each at its own frequency."""

    def __init__(self, kinds: list[Kind], seed: int) -> None:
        random = np.random.default_rng(seed)
        joints: list[Joint] = []
        q = np.eye(3)
        for kind in kinds:
            offset = q @ [*random.uniform(-0.5, 0.5, 2), 0.0]
            along, about = random.uniform(-math.pi, math.pi, 2)
            u = np.array([math.cos(along), math.sin(along), 0.0])
            z = u if kind == "prismatic" else random.choice([-1.0, 1.0]) * U3
            x = math.cos(about) * np.cross(U3, u) + math.sin(about) * U3 if kind == "prismatic" else u
            turned = np.array([x, np.cross(z, x), z])
            joints.append(Joint(kind, turned @ q.T, offset))
            q = turned
        self.joints = joints
        self.leg = serial_leg(joints, q @ [*random.uniform(-0.5, 0.5, 2), 0.0])
        self.amplitude, self.phase = random.uniform(-0.8, 0.8, (2, len(kinds)))
        self.frequency = random.uniform(0.5, 1.5, len(kinds))

    def rows(self, t: float) -> Array:
        """Return variable, rate and acceleration of each joint."""
        a, w = self.amplitude, self.frequency
        s, c = np.sin(w * t + self.phase), np.cos(w * t + self.phase)
        return np.stack([a * s, a * w * c, -a * w * w * s], axis=1)


legs = st.builds(
    Swinging,
    st.lists(st.sampled_from(["prismatic", "revolute"]), min_size=1, max_size=5),
    st.integers(0, 2**32 - 1),
)


@given(legs)
@settings(max_examples=40, deadline=None)
def test_orientations_and_positions_are_products_and_sums(swinging: Swinging) -> None:
    """(3) and (9), written out."""
    rows = swinging.rows(TIME)
    q: Array = np.eye(3)
    p: Array = np.zeros(3)
    for k, (joint, (variable, _, _)) in enumerate(zip(swinging.joints, rows, strict=True)):
        prismatic = joint.kind == "prismatic"
        a = np.asarray(joint.constant, dtype=np.float64)
        a = a if prismatic else theta(variable) @ a
        r = np.asarray(joint.offset) + (variable * a.T @ U3 if prismatic else 0.0)
        p = p + q.T @ r
        q = a @ q
        place, _ = follow(swinging.leg, rows[: k + 1])
        assert_allclose(place.a, a, atol=1e-14)
        assert_allclose(place.r, r, atol=1e-14)
        assert_allclose(place.q, q, atol=1e-14)
        assert_allclose(place.p, p, atol=1e-14)
    assert_allclose(platform_centre(swinging.leg, place), p + q.T @ swinging.leg[-1, 1:4], atol=1e-14)


@given(legs)
@settings(max_examples=40, deadline=None)
def test_absolute_motions_are_derivatives_of_place(swinging: Swinging) -> None:
    """(12) to (14) and (20) against differences of (3) and (9), for every link."""
    for k in range(1, len(swinging.joints) + 1):
        place, motion = follow(swinging.leg, swinging.rows(TIME)[:k])

        def q_transposed(t: float, k: int = k) -> Array:
            return np.transpose(follow(swinging.leg, swinging.rows(t)[:k])[0].q)

        def position(t: float, k: int = k) -> Array:
            return np.array(follow(swinging.leg, swinging.rows(t)[:k])[0].p)

        q = np.array(place.q)
        omega, epsilon = tilde(np.array(motion.omega)), tilde(np.array(motion.epsilon))
        turning, turning_twice = differences(q_transposed, TIME)
        velocity, acceleration = differences(position, TIME)
        assert_allclose(omega, q @ turning, atol=1e-11)
        assert_allclose(omega @ omega + epsilon, q @ turning_twice, atol=1e-9)
        assert_allclose(motion.v, q @ velocity, atol=1e-11)
        assert_allclose(motion.gamma, q @ acceleration, atol=1e-9)


@given(legs)
@settings(max_examples=40, deadline=None)
def test_matrix_forms_hold(swinging: Swinging) -> None:
    """(12) and the second equation of (20), with skew-symmetric matrices as the paper has them."""
    rows = swinging.rows(TIME)
    omega_before, epsilon_before = np.zeros((3, 3)), np.zeros((3, 3))
    for k, joint in enumerate(swinging.joints):
        place, motion = follow(swinging.leg, rows[: k + 1])
        _, rate, acceleration = rows[k] if joint.kind == "revolute" else (0.0, 0.0, 0.0)
        a, u3 = np.array(place.a), tilde(U3)
        omega, epsilon = tilde(np.array(motion.omega)), tilde(np.array(motion.epsilon))
        carried = a @ omega_before @ a.T
        assert_allclose(omega, carried + rate * u3, atol=1e-14)
        assert_allclose(
            omega @ omega + epsilon,
            a @ (omega_before @ omega_before + epsilon_before) @ a.T
            + rate**2 * u3 @ u3
            + acceleration * u3
            + 2.0 * rate * carried @ u3,
            atol=1e-13,
        )
        omega_before, epsilon_before = omega, epsilon


@given(legs)
@settings(max_examples=40, deadline=None)
def test_the_platform_moves_as_its_centre(swinging: Swinging) -> None:
    def centre(t: float) -> Array:
        place, _ = follow(swinging.leg, swinging.rows(t))
        return np.array(platform_centre(swinging.leg, place))

    velocity, acceleration = platform_motion(swinging.leg, *follow(swinging.leg, swinging.rows(TIME)))
    expected_velocity, expected_acceleration = differences(centre, TIME)
    assert_allclose(velocity[:2], expected_velocity[:2], atol=1e-11)
    assert_allclose(acceleration[:2], expected_acceleration[:2], atol=1e-9)


class Rpr:
    """A leg of a 3-RPR robot: it turns about its anchor, stretches, and turns at the platform's corner."""

    def __init__(self, anchor: Array, corner: Array) -> None:
        self.anchor, self.corner = anchor, corner
        self.leg = serial_leg(
            [
                Joint("revolute", np.eye(3), [*anchor, 0.0]),
                Joint("prismatic", THETA_1),
                Joint("revolute", THETA_1.T),
            ],
            tip=[*-corner, 0.0],
        )

    def variables(self, pose: Array) -> Array:
        along = pose[:2] + theta(pose[2])[:2, :2].T @ self.corner - self.anchor
        angle = math.atan2(along[1], along[0])
        return np.array([angle, math.hypot(*along), pose[2] - angle])


class Prr:
    """A leg of a 3-PRR robot: a slider on a rail, a bar of fixed length, a corner of the platform."""

    bar = 0.5

    def __init__(self, anchor: Array, corner: Array) -> None:
        self.anchor, self.corner, self.rail = anchor, corner, math.atan2(*anchor)
        self.leg = serial_leg(
            [
                Joint("prismatic", THETA_1 @ theta(self.rail), [*anchor, 0.0]),
                Joint("revolute", THETA_1.T),
                Joint("revolute", np.eye(3), [self.bar, 0.0, 0.0]),
            ],
            tip=[*-corner, 0.0],
        )

    def variables(self, pose: Array) -> Array:
        u = np.array([math.cos(self.rail), math.sin(self.rail)])
        to_corner = pose[:2] + theta(pose[2])[:2, :2].T @ self.corner - self.anchor
        along = to_corner @ u
        slider = along - math.sqrt(self.bar**2 - to_corner @ to_corner + along**2)
        x, y = to_corner - slider * u
        angle = math.atan2(y, x)
        return np.array([slider, angle - self.rail, pose[2] - angle])


def platform_pose(t: float) -> Array:
    return np.array([0.04 * math.sin(t), 0.03 * math.cos(1.3 * t), 0.3 * math.sin(0.8 * t + 0.2)])


@pytest.mark.parametrize("robot", [Rpr, Prr])
@pytest.mark.parametrize("turn", [0.0, 2.0 * math.pi / 3, 4.0 * math.pi / 3])
def test_other_robots_are_closed_by_the_same_recursion(robot: type[Rpr | Prr], turn: float) -> None:
    """(15) and (19) for legs unlike the paper's, against differences of their own inverse kinematics."""
    u = np.array([math.cos(turn), math.sin(turn)])
    leg = robot(0.4 * u, 0.1 * u)
    variables = leg.variables(platform_pose(TIME))
    place, _ = follow(leg.leg, np.stack([variables, np.zeros(3), np.zeros(3)], axis=1))
    assert_allclose(platform_centre(leg.leg, place)[:2], platform_pose(TIME)[:2], atol=1e-14)

    velocity, acceleration = differences(platform_pose, TIME)
    rates, accelerations = joint_motion(leg.leg, tuple(variables), tuple(velocity), tuple(acceleration))
    expected_rates, expected_accelerations = differences(lambda t: leg.variables(platform_pose(t)), TIME)
    assert_allclose(rates, expected_rates, atol=1e-10)
    assert_allclose(accelerations, expected_accelerations, atol=1e-8)


@given(
    st.lists(st.sampled_from(["prismatic", "revolute"]), min_size=3, max_size=3).filter(
        lambda kinds: "revolute" in kinds
    ),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_connectivity_inverts_the_recursion(kinds: list[Kind], seed: int) -> None:
    """(15) and (19) give back the rates and accelerations with which (14) and (20) moved the platform."""
    swinging = Swinging(kinds, seed)
    rows = swinging.rows(TIME)
    velocity, acceleration = platform_motion(swinging.leg, *follow(swinging.leg, rows))
    rates, accelerations = joint_motion(swinging.leg, tuple(rows[:, 0]), velocity, acceleration)
    assume(np.abs([rates, accelerations]).max() < 1e3)  # or the leg is next to a singularity of its own
    place, motion = follow(swinging.leg, np.stack([rows[:, 0], rates, accelerations], axis=1))
    again = platform_motion(swinging.leg, place, motion)
    assert_allclose(again[0], velocity, atol=1e-9)
    assert_allclose(again[1], acceleration, atol=1e-9)


def test_a_leg_must_stay_in_its_plane() -> None:
    upright = np.eye(3)
    with pytest.raises(ValueError, match="joint 1: its constant matrix is not orthogonal"):
        serial_leg([Joint("revolute", 1.1 * upright)], np.zeros(3))
    with pytest.raises(ValueError, match="joint 1: with this axis and offset a prismatic joint"):
        serial_leg([Joint("prismatic", upright)], np.zeros(3))
    with pytest.raises(ValueError, match=r"joint 2: .* a revolute joint leaves the plane"):
        serial_leg([Joint("prismatic", THETA_1), Joint("revolute", upright)], np.zeros(3))
    with pytest.raises(ValueError, match=r"joint 1: .* leaves the plane"):
        serial_leg([Joint("revolute", upright, (0.0, 0.0, 0.1))], np.zeros(3))
