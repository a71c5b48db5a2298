"""Distance of a pose from a singularity, and conditioning of the Jacobian.

A pose (x, y, phi) consists of the platform's centre G [m] and the angle of the platform [rad]. An array holds one pose,
shape (3,), or N poses, shape (N, 3). Singular poses divide all other poses into regions, which are called aspects.
Every motion from one aspect to another passes a singular pose. The robot works in the aspect of the pose (0, 0, 0). In
this aspect, each delta_i of J1 and det J2 have the same signs as at the pose (0, 0, 0).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import jacobians
from trirail.workspace.aspect import det_j2_rows, wall_angles

__all__ = [
    "characteristic_length",
    "conditioning",
    "distance_to_singularity",
    "sensitivity",
]

HOME = np.zeros(3)
DET_SAMPLES = 255  # number of samples of det J2 between two walls
COINCIDENT_WALLS_RAD = 1e-4  # if two walls are closer together, there are no poses between them


def sensitivity(geometry: Geometry, pose: ArrayLike) -> Array:
    """Return J1⁻¹ J2, shape (3, 3) or (N, 3, 3), which maps platform velocity to slider velocity (16).

    The rows are the sliders A, B and C. The columns for x and y are dimensionless, and the column for phi is in m/rad.
    Raises KinematicsError in the same cases as inverse.
    """
    j1, j2 = jacobians(geometry, pose)
    return j2 / np.diagonal(j1, axis1=-2, axis2=-1)[..., np.newaxis]


def characteristic_length(geometry: Geometry) -> float:
    """Return the length [m] that makes rotations comparable with translations.

    A rotation by an angle is treated like a translation by this length times the angle. At the pose (0, 0, 0), both
    cause the same root-mean-square motion of the sliders, averaged over sliders and directions. A symmetric robot is
    therefore isotropic at the pose (0, 0, 0), and its characteristic length is l0/√6. The length does not depend on the
    zeros of the joints, or on the choice of points along rails and edges.
    """
    at_home = sensitivity(geometry, HOME)
    return float(math.sqrt(2.0) * np.linalg.norm(at_home[:, 2]) / np.linalg.norm(at_home[:, :2]))


def conditioning(geometry: Geometry, pose: ArrayLike, length: float | None = None) -> NDArray[np.float64]:
    """Return the ratio of the smallest to the largest singular value of J1⁻¹ J2, shape () or (N,), dimensionless.

    The ratio is 1 at an isotropic pose and 0 at a singular pose. The column of J1⁻¹ J2 for phi is divided by `length`
    [m]; the default is the characteristic length. Raises KinematicsError in the same cases as inverse.
    """
    scale = [1.0, 1.0, 1.0 / (characteristic_length(geometry) if length is None else length)]
    values = np.linalg.svd(sensitivity(geometry, pose) * scale, compute_uv=False)
    return np.asarray(values[..., -1] / values[..., 0], dtype=np.float64)


def distance_to_singularity(geometry: Geometry, pose: ArrayLike) -> NDArray[np.float64]:
    """Return the angle by which the platform can rotate in both directions before it is singular, () or (N,) [rad].

    This angle is the distance of phi from the nearest of the singular_angles for the G of the pose. The result is
    negative if the pose is not in the aspect of (0, 0, 0). Like singular_angles, this function can miss two zeros of
    det J2 that are closer together than the samples of det J2, which have a distance of at most 1.2°.

    Raises
    ------
    KinematicsError
        J1 is singular, or a number is not finite.
    """
    at_home, _ = jacobians(geometry, HOME)
    j1, j2 = jacobians(geometry, pose)
    inside = (np.diagonal(j1 * np.sign(at_home), axis1=-2, axis2=-1) > 0.0).all(axis=-1)
    inside &= np.linalg.det(j2) * _det_j2(geometry, HOME) > 0.0

    poses = np.array(pose, dtype=np.float64).reshape(-1, 3)
    turn = 2.0 * math.pi
    poses[:, 2] -= turn * np.round(poses[:, 2] / turn)
    at_walls = np.sort(np.concatenate([wall_angles(geometry) % math.pi + k * math.pi for k in (-2, -1, 0, 1)]))
    above = np.searchsorted(at_walls, poses[:, 2])
    distance = np.minimum(poses[:, 2] - at_walls[above - 1], at_walls[above] - poses[:, 2])
    for k in np.unique(above):  # the nearest singular angle is a wall or between the neighbouring walls
        if at_walls[k] - at_walls[k - 1] > COINCIDENT_WALLS_RAD:
            rows = np.flatnonzero(above == k)
            indices, zeros = _zeros_of_det_j2(geometry, poses[rows], at_walls[k - 1], at_walls[k])
            np.minimum.at(distance, rows[indices], np.abs(zeros - poses[rows[indices], 2]))
    distance = distance.reshape(inside.shape)
    return np.asarray(np.where(inside, distance, -distance), dtype=np.float64)


def _zeros_of_det_j2(geometry: Geometry, poses: Array, low: float, high: float) -> tuple[NDArray[np.intp], Array]:
    """Find the zeros of det J2 between two neighbouring walls, for the G of each pose.

    Returns the index of the pose and the angle phi [rad] for each zero.
    """
    # zeros of det J2 are most frequent near the walls, and the samples are therefore denser there
    phi = (low + high) / 2.0 - (high - low) / 2.0 * np.cos(np.linspace(0.0, math.pi, DET_SAMPLES + 2)[1:-1])
    ones = np.ones(len(poses))
    negative = np.column_stack([ones, poses[:, :2]]) @ det_j2_rows(geometry, phi).T < 0.0
    rows, columns = np.nonzero(negative[:, 1:] != negative[:, :-1])
    start, end = phi[columns], phi[columns + 1]
    middle = poses[rows]
    for _ in range(52):  # bisection, with one step for each bit of a float64
        middle[:, 2] = (start + end) / 2.0
        as_at_start = (_det_j2(geometry, middle) < 0.0) == negative[rows, columns]
        start, end = np.where(as_at_start, middle[:, 2], start), np.where(as_at_start, end, middle[:, 2])
    return rows, (start + end) / 2.0


def _det_j2(geometry: Geometry, poses: Array) -> Array:
    return np.asarray(np.linalg.det(jacobians(geometry, poses)[1]), dtype=np.float64)
