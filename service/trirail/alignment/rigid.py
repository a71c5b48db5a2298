"""The rigid motion that takes marks to their targets, by weighted least squares with the exact rotation.

    to_i = m + s + R(delta) (at_i - m) + r_i,   minimal sum of r_i' W_i r_i

m is the middle of the marks, so that s is the way of the middle and delta the turn about it. It starts from the closed
solution for equal weights (Kabsch 1976, in the plane one arc tangent) and goes on by Gauss-Newton.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
ROUNDS = 8
MOST_MARKS = 6
"""Up to which all ways to name them are tried."""
SWAPPED = 0.25
"""Marks are named wrongly where other names have less than this share of the sum of squared distances."""


class RigidError(NamedTuple):
    """How a part lies away from its targets."""

    middle: Floats
    """Of the marks as they are, (2,) [m]."""
    shift: Floats
    """How far the middle has to go, (2,) [m]."""
    turn: float
    """By what angle the part has to turn, counterclockwise [rad]."""
    misfit: Floats
    """What no rigid motion takes away, of each mark, (n, 2) [m]."""
    chi_squared: float
    """Weighted sum of squares of the misfit; of 2n - 3 degrees of freedom where the weights are right."""
    covariance: Floats
    """Of shift and turn, (3, 3) [m, rad]."""

    def displacements(self, at: Floats) -> Floats:
        """Return how far the motion takes points, (n, 2) both [m]."""
        arms = at - self.middle
        return np.asarray(self.shift + arms @ turned(self.turn).T - arms)


def turned(angle: float) -> Floats:
    """Return the matrix that turns by an angle [rad], counterclockwise."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def rigid_error(at: Floats, to: Floats, weights: Floats | None = None) -> RigidError:
    """Return the motion that takes marks from `at` to `to`, (n, 2) both [m], n >= 2 at different places.

    `weights` are the inverse covariances of to - at, (n, 2, 2) [1/m²]; equal where there are none.
    """
    w = np.broadcast_to(np.eye(2), (len(at), 2, 2)) if weights is None else weights
    middle = at.mean(axis=0)
    arms, goals = at - middle, to - to.mean(axis=0)
    turn = float(np.arctan2((arms[:, 0] * goals[:, 1] - arms[:, 1] * goals[:, 0]).sum(), (arms * goals).sum()))
    shift = to.mean(axis=0) - middle
    for _ in range(ROUNDS):
        rotated = arms @ turned(turn).T
        residuals = to - middle - shift - rotated
        jacobian = np.zeros((len(at), 2, 3))
        jacobian[:, :, :2] = np.eye(2)
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -rotated[:, 1], rotated[:, 0]
        normal = np.einsum("nai,nab,nbj->ij", jacobian, w, jacobian)
        step = np.linalg.solve(normal, np.einsum("nai,nab,nb->i", jacobian, w, residuals))
        shift, turn = shift + step[:2], turn + float(step[2])
    misfit = to - middle - shift - arms @ turned(turn).T
    chi_squared = float(np.einsum("na,nab,nb->", misfit, w, misfit))
    return RigidError(middle, shift, turn, misfit, chi_squared, np.linalg.inv(normal))


def distance_error(at: Floats, to: Floats) -> float:
    """Return by how much the distance of two marks differs from that of their targets [1], of the worst pair."""
    pairs = list(itertools.combinations(range(len(at)), 2))
    errors = [np.linalg.norm(at[i] - at[j]) / np.linalg.norm(to[i] - to[j]) - 1.0 for i, j in pairs]
    return float(max(errors, key=abs))


def swapped(at: Floats, to: Floats) -> tuple[int, ...] | None:
    """Return the order of the marks in which they are much nearer to their targets, None where it is theirs.

    Marks of a part that is turned by less than 90° are nearest in their own order.
    """
    if len(at) > MOST_MARKS:
        return None
    own = ((at - to) ** 2).sum()
    orders = itertools.permutations(range(len(at)))
    best = min(orders, key=lambda order: float(((at[list(order)] - to) ** 2).sum()))
    return best if ((at[list(best)] - to) ** 2).sum() < SWAPPED * own else None
