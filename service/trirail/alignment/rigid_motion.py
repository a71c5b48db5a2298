"""Fit of the rigid motion that moves points to their targets, by weighted least squares with an exact rotation.

    q_i = m + s + R(delta) (p_i - m) + r_i,   minimal sum of r_i' W_i r_i

p_i are the points, q_i are their targets, m is the centroid of the points, s is the shift of the centroid, and delta is
the rotation about the centroid. For equal weights, there is a closed solution (Kabsch 1976; an arc tangent in the
plane). It is the initial value of a Gauss-Newton iteration.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
ITERATIONS = 8
MAX_PERMUTED_MARKS = 6
"""Greatest number of marks for which find_swap tries all permutations."""
MAX_SWAP_SHARE = 0.25
"""A permutation counts as a swap if it reduces the sum of squared distances to less than this fraction."""


class RigidMotion(NamedTuple):
    """Rigid motion that moves points to their targets, with residuals and covariance."""

    centroid: Floats
    """Centroid of the points before the motion, (2,) [m]."""
    shift: Floats
    """Shift of the centroid, (2,) [m]."""
    turn: float
    """Rotation about the centroid, counterclockwise [rad]."""
    misfit: Floats
    """Residual of each point, (n, 2) [m]."""
    chi_squared: float
    """Weighted sum of squares of the residuals. If the weights are correct, it is chi-squared distributed with 2n - 3
    degrees of freedom."""
    covariance: Floats
    """Covariance of shift and rotation, (3, 3) [m, rad]."""

    def displacements(self, points: Floats) -> Floats:
        """Return the displacements (n, 2) of points (n, 2) in this motion [m]."""
        arms = points - self.centroid
        return np.asarray(self.shift + arms @ rotation_matrix(self.turn).T - arms)


def rotation_matrix(angle: float) -> Floats:
    """Return the (2, 2) matrix that rotates by an angle [rad], counterclockwise."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def fit_rigid_motion(points: Floats, targets: Floats, weights: Floats | None = None) -> RigidMotion:
    """Return the rigid motion that moves points as close as possible to their targets.

    Parameters
    ----------
    points, targets
        Positions of at least two different points and of their targets, (n, 2) each [m].
    weights
        Inverse covariances of targets - points, (n, 2, 2) [1/m²]; if None, all weights are equal.
    """
    w = np.broadcast_to(np.eye(2), (len(points), 2, 2)) if weights is None else weights
    centroid = points.mean(axis=0)
    arms, goals = points - centroid, targets - targets.mean(axis=0)
    turn = float(np.arctan2((arms[:, 0] * goals[:, 1] - arms[:, 1] * goals[:, 0]).sum(), (arms * goals).sum()))
    shift = targets.mean(axis=0) - centroid
    # The closed solution is the minimum only for equal weights. Gauss-Newton takes the full covariances into account.
    for _ in range(ITERATIONS):
        rotated = arms @ rotation_matrix(turn).T
        residuals = targets - centroid - shift - rotated
        jacobian = np.zeros((len(points), 2, 3))
        jacobian[:, :, :2] = np.eye(2)
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -rotated[:, 1], rotated[:, 0]
        normal = np.einsum("nai,nab,nbj->ij", jacobian, w, jacobian)
        step = np.linalg.solve(normal, np.einsum("nai,nab,nb->i", jacobian, w, residuals))
        shift, turn = shift + step[:2], turn + float(step[2])
    misfit = targets - centroid - shift - arms @ rotation_matrix(turn).T
    chi_squared = float(np.einsum("na,nab,nb->", misfit, w, misfit))
    return RigidMotion(centroid, shift, turn, misfit, chi_squared, np.linalg.inv(normal))


def worst_distance_error(points: Floats, targets: Floats) -> float:
    """Return the relative error of the distance between two points, for the pair with the greatest error."""
    pairs = list(itertools.combinations(range(len(points)), 2))
    errors = [np.linalg.norm(points[i] - points[j]) / np.linalg.norm(targets[i] - targets[j]) - 1.0 for i, j in pairs]
    return float(max(errors, key=abs))


def find_swap(points: Floats, targets: Floats) -> tuple[int, ...] | None:
    """Return an order of the points that fits the targets much better than the given order; None if there is none.

    The correct order can be mistaken for a swap if the marks form a regular polygon and the part is rotated far: four
    marks by more than 61°, six by more than 40°.
    """
    if len(points) > MAX_PERMUTED_MARKS:
        return None
    own = ((points - targets) ** 2).sum()
    orders = itertools.permutations(range(len(points)))
    best = min(orders, key=lambda order: float(((points[list(order)] - targets) ** 2).sum()))
    return best if ((points[list(best)] - targets) ** 2).sum() < MAX_SWAP_SHARE * own else None
