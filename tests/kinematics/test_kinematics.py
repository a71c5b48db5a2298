"""The robot: the paper's tables and closed forms, properties of random robots, and every error."""

import csv
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, reject, settings
from hypothesis import strategies as st
from kinematics.calculus import differences, theta
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from trirail.errors import KinematicsError
from trirail.kinematics.geometry import Geometry, Leg, singular_angles
from trirail.kinematics.robot import forward, forward_into, inverse, inverse_into, jacobians, warm_up

Array = NDArray[np.float64]

L0 = 0.3
PAPER = Geometry.symmetric(L0)
ALPHA = np.array([math.pi / 3, math.pi, -math.pi / 3])  # (1)
FINAL = {
    "rotation": (0.0, 0.0, math.pi / 12),
    "translation_x": (0.025, 0.0, 0.0),
    "translation_y": (0.0, 0.025, 0.0),
}
FIELDS = {
    "position": "lambda10",
    "velocity": "v10",
    "acceleration": "gamma10",
    "passive_position": "lambda32",
    "passive_velocity": "v32",
    "passive_acceleration": "gamma32",
}


def table(example: str) -> dict[str, Array]:
    with (Path(__file__).parents[1] / "data" / f"paper_{example}.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}


def papers_motion(example: str, t: Array) -> tuple[Array, Array, Array]:
    """(5) and its derivatives."""
    w = math.pi / 3
    final = np.array(FINAL[example])
    return (
        np.outer(1.0 - np.cos(w * t), final),
        np.outer(w * np.sin(w * t), final),
        np.outer(w * w * np.cos(w * t), final),
    )


# ---- the paper's robot


@pytest.mark.parametrize("example", FINAL)
def test_the_papers_tables(example: str) -> None:
    reference = table(example)
    motion = inverse(PAPER, *papers_motion(example, reference["t"]))
    for field, name in FIELDS.items():
        expected = np.stack([reference[f"{name}_{leg}"] for leg in "ABC"], axis=1)
        tolerance = 1e-12 if field.endswith("position") else 1e-10
        assert_allclose(getattr(motion, field), expected, rtol=tolerance, atol=1e-15, err_msg=field)


@pytest.mark.parametrize(
    ("example", "final", "fastest", "start"),
    [
        ("rotation", [0.046410] * 3, [0.024237] * 3, [0.028710] * 3),
        ("translation_x", [0.0, -0.05, 0.05], [0.0, 0.026180, 0.026180], [0.0, -0.027416, 0.027416]),
        (
            "translation_y",
            [0.057735, -0.028868, -0.028868],
            [0.030230, 0.015115, 0.015115],
            [0.031657, -0.015828, -0.015828],
        ),
    ],
)
def test_the_papers_figures_in_numbers(
    example: str, final: list[float], fastest: list[float], start: list[float]
) -> None:
    motion = inverse(PAPER, *papers_motion(example, np.linspace(0.0, 3.0, 3001)))
    assert_allclose(motion.position[-1], final, atol=1e-6)
    assert_allclose(np.abs(motion.velocity).max(axis=0), fastest, atol=1e-6)
    assert_allclose(motion.acceleration[0], start, atol=1e-6)


symmetric_poses = st.tuples(
    st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-2 * math.pi / 3 + 0.02, math.pi / 3 - 0.02)
)


@given(symmetric_poses)
@settings(deadline=None)
def test_closed_forms_of_the_symmetric_robot(pose: tuple[float, float, float]) -> None:
    x, y, phi = pose
    psi = phi - math.pi / 3 + ALPHA
    n_g = np.sin(psi) * x - np.cos(psi) * y
    expected = (L0 * (0.5 - math.cos(phi)) + n_g) / math.sin(phi - math.pi / 3) - L0 / math.sqrt(3)
    sliders = inverse(PAPER, pose).position
    assert_allclose(sliders, expected, rtol=1e-10, atol=1e-13)

    total = math.sqrt(3) * float(sliders.sum())
    assert_allclose(
        forward(PAPER, sliders)[2],
        2.0 * math.atan2(total, 2.0 * math.sqrt(3) * L0 - total / math.sqrt(3)),
        atol=1e-10,
    )
    _, j2 = jacobians(PAPER, pose)
    det = 0.75 * math.sqrt(3) * L0 * math.tan(phi / 2.0 - math.pi / 6)
    assert_allclose(np.linalg.det(j2), det, rtol=1e-9, atol=1e-12)


@given(symmetric_poses)
@settings(deadline=None)
def test_jacobians_are_the_papers(pose: tuple[float, float, float]) -> None:
    """(17) and (18), as printed."""
    x, y, phi = pose
    x_00 = L0 * np.array([0.0, math.sqrt(3) / 2, -math.sqrt(3) / 2])
    y_00 = L0 * np.array([-1.0, 0.5, 0.5])
    psi = phi - math.pi / 3 + ALPHA
    reach = L0 / math.sqrt(3) + inverse(PAPER, pose).position
    beta_3 = (x - x_00) * np.cos(psi) + (y - y_00) * np.sin(psi) - reach * math.cos(phi - math.pi / 3)
    j1, j2 = jacobians(PAPER, pose)
    assert_allclose(j1, math.sin(phi - math.pi / 3) * np.eye(3), atol=1e-15)
    assert_allclose(j2, np.stack([np.sin(psi), -np.cos(psi), beta_3], axis=1), atol=1e-12)


@given(symmetric_poses, st.tuples(*[st.floats(-1.0, 1.0)] * 6))
@settings(deadline=None)
def test_connectivity_conditions_are_the_papers(pose: tuple[float, float, float], rates: tuple[float, ...]) -> None:
    """(15) and (19) for each leg, in the paper's matrices and with its misprints corrected."""
    theta_1 = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    u3 = np.array([0.0, 0.0, 1.0])
    u3_tilde = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    r_3 = L0 / 2 * np.array([0.0, 1.0, -math.sqrt(3) / 3])

    velocity, acceleration = np.array(rates[:3]), np.array(rates[3:])
    motion = inverse(PAPER, pose, velocity, acceleration)
    omega, epsilon = velocity[2], acceleration[2]
    for i, alpha in enumerate(ALPHA):
        a_10 = theta_1 @ theta(alpha)
        a_32 = theta_1 @ theta(-math.pi / 3)
        a_20 = theta(pose[2]) @ theta_1.T @ a_10
        a_30 = a_32 @ a_20
        arm = a_32.T @ u3 * motion.passive_position[i] + a_32.T @ r_3
        moved = motion.velocity[i] * a_10.T @ u3 + motion.passive_velocity[i] * a_30.T @ u3
        assert_allclose(moved[:2], velocity[:2] - omega * (a_20.T @ u3_tilde @ arm)[:2], atol=1e-10)
        pushed = motion.acceleration[i] * a_10.T @ u3 + motion.passive_acceleration[i] * a_30.T @ u3
        right = omega**2 * a_20.T @ u3_tilde @ u3_tilde @ arm + epsilon * a_20.T @ u3_tilde @ arm
        right = right + 2.0 * omega * motion.passive_velocity[i] * a_20.T @ u3_tilde @ a_32.T @ u3
        size = 1.0 + np.abs(right).max()
        assert_allclose(pushed[:2] / size, (acceleration[:2] - right[:2]) / size, atol=1e-10)


# ---- random robots


def nearly_symmetric(values: list[float]) -> Geometry:
    """Displace every number of the symmetric robot by up to a tenth of l0, or a tenth of a radian."""
    d = np.array(values).reshape(3, 7)
    a, b, c = (
        Leg(
            (leg.anchor[0] + 0.1 * L0 * u[0], leg.anchor[1] + 0.1 * L0 * u[1]),
            leg.rail_angle + 0.1 * u[2],
            leg.home + 0.1 * L0 * u[3],
            (leg.edge_point[0] + 0.1 * L0 * u[4], leg.edge_point[1] + 0.1 * L0 * u[5]),
            leg.edge_angle + 0.1 * u[6],
        )
        for leg, u in zip(PAPER.legs, d, strict=True)
    )
    return Geometry(legs=(a, b, c))


def any_robot(seed: int) -> Geometry:
    """Draw three legs that have nothing in common."""
    random = np.random.default_rng(seed)
    while True:
        a, b, c = (
            Leg(
                anchor=(float(u[0]), float(u[1])),
                rail_angle=float(4.0 * u[2]),
                home=float(u[3]),
                edge_point=(float(u[4] / 2), float(u[5] / 2)),
                edge_angle=float(4.0 * u[6]),
            )
            for u in random.uniform(-1.0, 1.0, (3, 7))
        )
        try:
            return Geometry(legs=(a, b, c))
        except KinematicsError:
            continue


unit = st.floats(-1.0, 1.0)
near_robots = st.builds(nearly_symmetric, st.lists(unit, min_size=21, max_size=21))
robots = near_robots | st.builds(any_robot, st.integers(0, 2**32 - 1))


def regular(geometry: Geometry, pose: Array) -> bool:
    """Whether a pose is well away from every singularity."""
    try:
        j1, j2 = jacobians(geometry, pose)
    except KinematicsError:
        return False
    sizes = np.abs(j2[:, 2]).max()
    return bool(np.abs(np.diag(j1)).min() > 0.05 and abs(np.linalg.det(j2)) > 0.02 * sizes and sizes > 0.02)


poses = st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-3.0, 3.0)).map(np.array)


@given(robots, poses)
@settings(max_examples=200, deadline=None)
def test_loops_are_closed(geometry: Geometry, pose: Array) -> None:
    """The definition of a Leg, which is (11) for any geometry."""
    assume(regular(geometry, pose))
    motion = inverse(geometry, pose)
    x, y, phi = pose
    for i, leg in enumerate(geometry.legs):
        along_rail = leg.home + motion.position[i]
        psi = phi + leg.edge_angle
        px, py = leg.edge_point
        left_x = leg.anchor[0] + along_rail * math.cos(leg.rail_angle) + motion.passive_position[i] * math.cos(psi)
        left_y = leg.anchor[1] + along_rail * math.sin(leg.rail_angle) + motion.passive_position[i] * math.sin(psi)
        assert_allclose(left_x, x + px * math.cos(phi) - py * math.sin(phi), atol=1e-12)
        assert_allclose(left_y, y + px * math.sin(phi) + py * math.cos(phi), atol=1e-12)


@given(robots, poses)
@settings(max_examples=200, deadline=None)
def test_forward_undoes_inverse(geometry: Geometry, pose: Array) -> None:
    assume(regular(geometry, pose))
    assert_allclose(forward(geometry, inverse(geometry, pose).position, near=pose), pose, atol=1e-10)


@given(near_robots, poses)
@settings(max_examples=200, deadline=None)
def test_forward_finds_the_branch_from_afar(geometry: Geometry, pose: Array) -> None:
    """Between the singular angles about zero no hint of the angle is needed, only the side it lies on."""
    angles = singular_angles(geometry, (float(pose[0]), float(pose[1])))
    low, high = max(a for a in angles if a < 0.0), min(a for a in angles if a > 0.0)
    assume(low < pose[2] < high and regular(geometry, pose))
    start = np.array([pose[0], pose[1], 0.0])
    sliders = inverse(geometry, pose).position
    assert_allclose(forward(geometry, sliders, near=start), pose, atol=1e-10)
    _, at_start = jacobians(geometry, start)
    _, at_home = jacobians(geometry, np.zeros(3))
    assume(np.linalg.det(at_start) * np.linalg.det(at_home) > 0.0)
    assert_allclose(forward(geometry, sliders), pose, atol=1e-10)


@given(robots, poses, st.floats(-3.0, 3.0))
@settings(max_examples=100, deadline=None)
def test_the_other_branch_is_a_solution_too(geometry: Geometry, pose: Array, angle: float) -> None:
    """A start on the other side of a singularity of J2 leads to the other pose that closes the loops."""
    start = np.array([pose[0], pose[1], angle])
    assume(regular(geometry, pose) and regular(geometry, start))
    side, other_side = (np.sign(np.linalg.det(jacobians(geometry, each)[1])) for each in (pose, start))
    assume(side != other_side)
    sliders = inverse(geometry, pose).position
    try:
        other = forward(geometry, sliders, near=start)
    except KinematicsError:
        reject()  # on the symmetric robot the other solution is the singular pi/3
    assume(regular(geometry, other))
    assert np.abs(other - pose).max() > 1e-6
    assert np.sign(np.linalg.det(jacobians(geometry, other)[1])) == other_side
    assert_allclose(inverse(geometry, other).position, sliders, atol=1e-9)


@given(robots, poses, st.tuples(*[unit] * 3))
@settings(max_examples=200, deadline=None)
def test_jacobians_relate_the_velocities(geometry: Geometry, pose: Array, velocity: tuple[float, float, float]) -> None:
    """(16)."""
    assume(regular(geometry, pose))
    j1, j2 = jacobians(geometry, pose)
    assert np.count_nonzero(j1 - np.diag(np.diag(j1))) == 0
    assert_allclose(j1 @ inverse(geometry, pose, velocity).velocity, j2 @ velocity, atol=1e-10)


@given(robots, poses, st.lists(st.floats(-0.2, 0.2), min_size=9, max_size=9))
@settings(max_examples=150, deadline=None)
def test_velocities_and_accelerations_are_derivatives(geometry: Geometry, middle: Array, swing: list[float]) -> None:
    """Along a random smooth motion of the platform, against differences of the positions."""
    a, b, c = np.array(swing).reshape(3, 3)

    def pose(t: float) -> Array:
        return middle + a * math.sin(t) + b * math.sin(1.4 * t) + c * (math.cos(t) - 1.0)

    assume(all(regular(geometry, pose(t)) for t in np.linspace(-0.05, 0.05, 3)))
    velocity = a + 1.4 * b
    motion = inverse(geometry, pose(0.0), velocity, -c)
    slider = differences(lambda t: inverse(geometry, pose(t)).position, 0.0, h=4e-3)
    passive = differences(lambda t: inverse(geometry, pose(t)).passive_position, 0.0, h=4e-3)
    size = 1.0 + max(np.abs(motion.acceleration).max(), np.abs(motion.passive_acceleration).max())
    assert_allclose(motion.velocity / size, slider[0] / size, atol=1e-9)
    assert_allclose(motion.acceleration / size, slider[1] / size, atol=1e-7)
    assert_allclose(motion.passive_velocity / size, passive[0] / size, atol=1e-9)
    assert_allclose(motion.passive_acceleration / size, passive[1] / size, atol=1e-7)


# ---- shapes, and the functions for the loop


@given(robots, st.lists(poses, min_size=1, max_size=4))
@settings(max_examples=50, deadline=None)
def test_batches_are_rows_of_single_poses(geometry: Geometry, rows: list[Array]) -> None:
    assume(all(regular(geometry, row) for row in rows))
    pose = np.array(rows)
    velocity, acceleration = 2.0 * pose, -3.0 * pose
    batch = inverse(geometry, pose, velocity, acceleration)
    j1, j2 = jacobians(geometry, pose)
    back = forward(geometry, batch.position, near=pose)
    for k in range(len(pose)):
        single = inverse(geometry, pose[k], velocity[k], acceleration[k])
        for field in FIELDS:
            assert getattr(single, field).shape == (3,)
            assert_allclose(getattr(single, field), getattr(batch, field)[k], rtol=0.0)
        assert_allclose(jacobians(geometry, pose[k]), (j1[k], j2[k]), rtol=0.0)
        assert_allclose(forward(geometry, batch.position[k], near=pose[k]), back[k], rtol=0.0)

        out, found = np.empty((6, 3)), np.array(pose[k])
        assert inverse_into(geometry.packed(), np.stack([pose[k], velocity[k], acceleration[k]]), out) == 0
        assert_allclose(out, [getattr(single, field) for field in FIELDS], rtol=0.0)
        assert forward_into(geometry.packed(), out[0], found, found) == 0
        assert_allclose(found, back[k], rtol=0.0)


def test_anything_like_an_array_will_do() -> None:
    expected = inverse(PAPER, np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.0]])).position
    frozen = np.zeros((2, 3))
    frozen[1] = 1.0, 2.0, 0.0
    frozen.setflags(write=False)
    for pose in ([[0, 0, 0], [1, 2, 0]], frozen, np.asfortranarray(frozen), frozen.astype(np.float32)):
        assert_allclose(inverse(PAPER, pose).position, expected, rtol=0.0)
        jacobians(PAPER, pose)
    assert_allclose(forward(PAPER, np.asfortranarray(expected)), frozen, atol=1e-12)
    assert inverse(PAPER, frozen, velocity=(0.1, 0.0, 0.0)).velocity.shape == (2, 3)
    assert inverse(PAPER, np.empty((0, 3))).position.shape == (0, 3)
    assert forward(PAPER, np.empty((0, 3))).shape == (0, 3)


def test_warm_up_leaves_nothing_to_compile() -> None:
    warm_up()
    legs: Any = inverse_into
    assert len(legs.signatures) == 1


# ---- errors


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_numbers_must_be_finite(value: float) -> None:
    good, bad = (0.0, 0.0, 0.0), (0.0, value, 0.0)
    for call, message in (
        (lambda: inverse(PAPER, bad), f"pose y is {value}: it must be finite"),
        (lambda: inverse(PAPER, good, bad), f"velocity y is {value}: it must be finite"),
        (
            lambda: inverse(PAPER, [good, good], 0.0, [good, bad]),
            f"row 1: acceleration y is {value}: it must be",
        ),
        (lambda: jacobians(PAPER, [good, bad]), f"row 1: pose y is {value}: it must be finite"),
        (lambda: forward(PAPER, bad), f"slider B is {value}: it must be finite"),
        (lambda: forward(PAPER, [good, bad]), f"row 1: slider B is {value}: it must be finite"),
        (lambda: forward(PAPER, good, near=bad), "near = "),
    ):
        with pytest.raises(KinematicsError, match=message):
            call()
    with pytest.raises(KinematicsError) as refused:
        forward(PAPER, bad)
    assert refused.value.leg == "B"
    assert inverse_into(PAPER.packed(), np.array([bad, good, good]), np.empty((6, 3))) == 1
    assert inverse_into(PAPER.packed(), np.array([good, good, bad]), np.empty((6, 3))) == 1
    assert forward_into(PAPER.packed(), np.array(bad), np.zeros(3), np.empty(3)) == 2
    assert forward_into(PAPER.packed(), np.zeros(3), np.array(bad), np.empty(3)) == 5


def test_what_overflows_is_refused() -> None:
    with pytest.raises(KinematicsError, match=r"leg .: out of reach"):
        inverse(PAPER, (1e308, 1e308, 0.5))
    with pytest.raises(KinematicsError, match="leg A: out of reach"):
        inverse(PAPER, (0.0, 0.0, 0.0), (0.0, 0.0, 1e200))


@pytest.mark.parametrize("phi", [math.pi / 3, -2 * math.pi / 3, math.pi / 3 + 1e-10])
def test_an_edge_along_its_rail_is_singular(phi: float) -> None:
    for call in (inverse, jacobians):
        with pytest.raises(KinematicsError, match="leg A: edge parallel to its rail") as refused:
            call(PAPER, (0.01, 0.0, phi))
        assert refused.value.leg == "A"
        assert refused.value.value == phi
        assert refused.value.limit == pytest.approx(phi, abs=1e-9)
        with pytest.raises(KinematicsError, match="row 2: leg A"):
            call(PAPER, [(0.0, 0.0, 0.0), (0.0, 0.0, 0.1), (0.01, 0.0, phi)])
    assert inverse_into(PAPER.packed(), np.array([[0.01, 0.0, phi], [0.0] * 3, [0.0] * 3]), np.empty((6, 3))) == 1


def test_the_singular_leg_is_named() -> None:
    a, b, c = PAPER.legs
    geometry = Geometry(legs=(a, replace(b, edge_angle=b.edge_angle + 0.1), c))
    pose = 0.0, 0.0, math.pi / 3 - 0.1
    with pytest.raises(KinematicsError, match=r"leg B: edge parallel to its rail at phi = 54.2704°"):
        inverse(geometry, pose)
    assert inverse_into(geometry.packed(), np.array([pose, (0, 0, 0), (0, 0, 0)]), np.empty((6, 3))) == 2


def test_sliders_can_leave_the_loops_open() -> None:
    """Rails from the centre outwards: with all pins near the centre the edges cannot pass through them."""
    a, b, c = (
        Leg((0.3 * math.cos(t), 0.3 * math.sin(t)), t, 0.0, (0.3 * math.cos(t), 0.3 * math.sin(t)), t + 1.9)
        for t in (0.0, 2.0 * math.pi / 3, 4.0 * math.pi / 3)
    )
    geometry = Geometry(legs=(a, b, c))
    sliders = np.full(3, -0.25)
    with pytest.raises(KinematicsError, match=r"no pose closes the loops, which reach 129.904 mm of the") as refused:
        forward(geometry, sliders)
    assert refused.value.value == pytest.approx(3 * math.sqrt(3) / 2 * 0.05)
    assert refused.value.limit == pytest.approx(3 * math.sqrt(3) / 2 * 0.3 * math.sin(1.9))
    assert forward_into(geometry.packed(), sliders, np.zeros(3), np.empty(3)) == 4
    with pytest.raises(KinematicsError, match="row 1: sliders"):
        forward(geometry, np.stack([np.zeros(3), sliders]))


def test_sliders_can_bring_the_symmetric_robot_to_its_singularity() -> None:
    at = np.full(3, math.sqrt(3) * L0 / 6)  # their sum, sqrt(3) l0 / 2, is that of phi = pi/3
    with pytest.raises(KinematicsError, match=r"singular at these positions \(.det J2. = "):
        forward(PAPER, at)
    assert forward_into(PAPER.packed(), at, np.zeros(3), np.empty(3)) == 5
    with pytest.raises(KinematicsError, match=r"leg .: edge parallel to its rail at phi = 60° "):
        forward(PAPER, 1.2 * at)
    assert forward_into(PAPER.packed(), 1.2 * at, np.zeros(3), np.empty(3)) in {1, 2, 3}


@pytest.mark.parametrize("phi", [math.pi / 3, math.pi / 3 + 1e-11, -2 * math.pi / 3])
def test_near_must_be_regular(phi: float) -> None:
    with pytest.raises(KinematicsError, match=r"near = \(100 mm, 0 mm, .*°\) is a singular pose"):
        forward(PAPER, np.zeros(3), near=(0.1, 0.0, phi))


def test_shapes_are_checked() -> None:
    for call, message in (
        (lambda: inverse(PAPER, (0.0, 0.0)), r"pose has shape \(2,\): expected \(3,\) or \(N, 3\)"),
        (lambda: inverse(PAPER, 0.0), r"pose has shape \(\): expected"),
        (lambda: inverse(PAPER, np.zeros((2, 2, 3))), r"pose has shape \(2, 2, 3\)"),
        (lambda: inverse(PAPER, np.zeros(3), np.zeros(2)), r"velocity has shape \(2,\)"),
        (lambda: inverse(PAPER, np.zeros((2, 3)), 0.0, np.zeros((3, 3))), r"acceleration has shape \(3, 3\)"),
        (lambda: jacobians(PAPER, np.zeros(4)), r"pose has shape \(4,\)"),
        (lambda: forward(PAPER, np.zeros(4)), r"sliders has shape \(4,\)"),
        (lambda: forward(PAPER, np.zeros(3), near=np.zeros((2, 3))), r"near has shape \(2, 3\)"),
    ):
        with pytest.raises(KinematicsError, match=message):
            call()
