"""Geometries: the paper's robot, what is refused, and singular angles."""

import math
import pickle
from dataclasses import FrozenInstanceError, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from trirail.errors import KinematicsError
from trirail.kinematics.geometry import Geometry, Leg, gains, singular_angles
from trirail.kinematics.robot import jacobians

L0 = 0.3
SYMMETRIC = Geometry.symmetric(L0)
AS_BUILT = Geometry(
    legs=(
        Leg((0.001, -0.299), math.pi / 3 + 0.002, 0.174, (0.087, -0.151), 0.001),
        Leg((0.261, 0.149), math.pi - 0.001, 0.172, (0.086, 0.151), 2 * math.pi / 3 - 0.002),
        Leg((-0.26, 0.151), -math.pi / 3 + 0.003, 0.173, (-0.174, 0.001), -2 * math.pi / 3 + 0.001),
    )
)


def test_symmetric_is_the_papers_robot() -> None:
    """(1) to (3) and (10), with theta_2 a turn by -pi/3."""
    theta_1 = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    theta_2 = np.array([[1.0, -math.sqrt(3), 0.0], [math.sqrt(3), 1.0, 0.0], [0.0, 0.0, 2.0]]) / 2.0
    starts = L0 * np.array([[0.0, -1.0], [math.sqrt(3) / 2, 0.5], [-math.sqrt(3) / 2, 0.5]])
    alphas = math.pi / 3, math.pi, -math.pi / 3
    for packed, start, alpha in zip(SYMMETRIC.packed(), starts, alphas, strict=True):
        c, s = math.cos(alpha), math.sin(alpha)
        theta_alpha = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        assert packed[:, 0].tolist() == [0.0, 1.0, 0.0, 0.0]
        assert_allclose(packed[0, 4:].reshape(3, 3), theta_1 @ theta_alpha, atol=1e-15)
        assert_allclose(packed[1, 4:].reshape(3, 3), theta_1.T, atol=1e-15)
        assert_allclose(packed[2, 4:].reshape(3, 3), theta_1 @ theta_2, atol=1e-15)
        assert_allclose(packed[0, 1:4], [*(start + L0 / math.sqrt(3) * np.array([c, s])), 0.0], atol=1e-15)
        assert_allclose(packed[1:3, 1:4], 0.0)
        assert_allclose(packed[3, 1:4], L0 / 2 * np.array([0.0, 1.0, -math.sqrt(3) / 3]), atol=1e-15)


def test_a_geometry_is_a_value() -> None:
    assert Geometry.symmetric(L0) == SYMMETRIC != AS_BUILT
    assert hash(Geometry.symmetric(L0)) == hash(SYMMETRIC)
    assert "packed" not in repr(SYMMETRIC)
    copied = pickle.loads(pickle.dumps(AS_BUILT))
    assert copied == AS_BUILT
    assert_allclose(copied.packed(), AS_BUILT.packed(), rtol=0.0)
    with pytest.raises(FrozenInstanceError):
        SYMMETRIC.legs = AS_BUILT.legs  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        SYMMETRIC.packed()[0, 0, 0] = 1.0


@pytest.mark.parametrize("l0", [0.0, -0.3, math.nan, math.inf])
def test_l0_must_be_a_length(l0: float) -> None:
    with pytest.raises(KinematicsError, match=r"l0 is .* m: it must be finite and positive"):
        Geometry.symmetric(l0)


@pytest.mark.parametrize("leg", [0, 1, 2])
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("anchor", (0.0, math.nan)),
        ("rail_angle", math.inf),
        ("home", math.nan),
        ("edge_point", (math.inf, 0.0)),
        ("edge_angle", -math.inf),
    ],
)
def test_every_number_must_be_finite(leg: int, key: str, value: Any) -> None:
    a, b, c = AS_BUILT.legs
    legs = [a, b, c]
    legs[leg] = replace(legs[leg], **{key: value})
    with pytest.raises(KinematicsError, match=f"leg {'ABC'[leg]}: {key} is .*: it must be finite") as refused:
        Geometry(legs=(legs[0], legs[1], legs[2]))
    assert refused.value.leg == "ABC"[leg]


def test_home_must_be_regular() -> None:
    a, b, c = AS_BUILT.legs
    with pytest.raises(KinematicsError, match="leg B: edge_angle is parallel to rail_angle") as refused:
        Geometry(legs=(a, replace(b, edge_angle=b.rail_angle - math.pi), c))
    assert refused.value.leg == "B"
    with pytest.raises(KinematicsError, match="cannot hold the platform"):
        Geometry(legs=(a, a, c))  # twice the same leg
    with pytest.raises(KinematicsError, match="cannot hold the platform"):
        Geometry(legs=(a, replace(b, edge_angle=a.edge_angle), replace(c, edge_angle=a.edge_angle)))


@pytest.mark.parametrize("l0", [0.05, 0.3, 2.0])
@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.04, -0.03)])
def test_singular_angles_of_the_symmetric_robot(l0: float, centre: tuple[float, float]) -> None:
    assert_allclose(singular_angles(Geometry.symmetric(l0), centre), [-2 * math.pi / 3, math.pi / 3], atol=1e-12)


@pytest.mark.parametrize("robot", [Geometry.symmetric(0.3), AS_BUILT])
@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.05, -0.02, 0.3), (-0.08, 0.06, -0.7)])
def test_what_a_slider_changes_is_by_the_jacobians(robot: Geometry, pose: tuple[float, float, float]) -> None:
    j1, j2 = jacobians(robot, pose)
    assert_allclose(j2 @ gains(robot, pose), j1, atol=1e-12)


@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.05, 0.02)])
def test_a_determinant_changes_sign_at_every_singular_angle(centre: tuple[float, float]) -> None:
    angles = singular_angles(AS_BUILT, centre)
    assert list(angles) == sorted(angles)
    assert len(angles) > 6  # J1 in each leg twice, J2 between them

    def signs(phi: float) -> list[float]:
        j1, j2 = jacobians(AS_BUILT, (*centre, phi))
        return [*np.sign(np.diag(j1)), float(np.sign(np.linalg.det(j2)))]

    for phi in angles:
        assert signs(phi - 1e-7) != signs(phi + 1e-7)
    for low, high in pairwise(angles):
        between = [signs(phi) for phi in np.linspace(low, high, 50)[1:-1]]
        assert all(each == between[0] for each in between)


def test_millimetres_move_the_singularity_of_j2_by_degrees() -> None:
    nearest = min(phi for phi in singular_angles(AS_BUILT) if phi > 0.0)
    assert nearest < math.pi / 3 - math.radians(1.0)
