"""Description of a planar serial leg by its joints, and conversion to the array of trirail.kinematics.recursion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from trirail.kinematics.arrays import Array

__all__ = ["Joint", "serial_leg"]


class Joint(NamedTuple):
    """Joint k of a leg. `constant` (3, 3) and `offset` (3,) [m] are the constant parts of q_{k,k-1} and r_{k,k-1}."""

    kind: Literal["prismatic", "revolute"]
    constant: ArrayLike
    offset: ArrayLike = (0.0, 0.0, 0.0)


def serial_leg(joints: Sequence[Joint], tip: ArrayLike) -> Array:
    """Return the packed leg (n + 1, 13) with n joints and r_n^G = tip [m].

    Raises ValueError if a constant matrix is not orthogonal or the motion of the leg is not planar.
    """
    leg = np.zeros((len(joints) + 1, 13))
    q_k0 = np.eye(3)  # for joint variables of zero: the variables do not change which axes are normal to the plane
    for k, (kind, constant, offset) in enumerate(joints):
        leg[k, 0] = kind == "revolute"
        leg[k, 1:4] = offset
        leg[k, 4:13] = np.ravel(constant)
        q = leg[k, 4:13].reshape(3, 3)
        if not np.allclose(q @ q.T, np.eye(3), atol=1e-12):
            raise ValueError(f"joint {k + 1}: its constant matrix is not orthogonal")
        out_of_plane = leg[k, 1:4] @ q_k0[:, 2]
        q_k0 = q @ q_k0
        if abs(abs(q_k0[2, 2]) - leg[k, 0]) > 1e-12 or abs(out_of_plane) > 1e-12:
            raise ValueError(f"joint {k + 1}: with this axis and offset a {kind} joint leaves the plane")
    leg[-1, 1:4] = tip
    return leg
