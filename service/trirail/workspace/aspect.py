"""What bounds the poses in which the robot works: angles that are singular wherever G is, and where det J2 is zero.

Plain numpy, for who draws a workspace and has no use for the compiled kinematics.
"""

from __future__ import annotations

import math

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry, det_j2, singular_angles

__all__ = ["det_j2_rows", "range_of_phi", "walls"]


def range_of_phi(geometry: Geometry) -> tuple[float, float]:
    """Return the angles phi [rad] on either side of zero that are singular wherever G is."""
    ahead = walls(geometry) % math.pi
    return float(ahead.max()) - math.pi, float(ahead.min())


def det_j2_rows(geometry: Geometry, phi: Array) -> Array:
    """Return rows d, (K, 3), for angles phi, (K,): at these det J2 = d @ (1, x, y), in metres.

    Only the third column of J2, (18), depends on G, and at one phi it does so linearly, or not at all.
    """
    rows = np.stack([det_j2(geometry, centre, phi) for centre in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))], axis=1)
    rows[:, 1:] -= rows[:, :1]
    return rows


def walls(geometry: Geometry) -> Array:
    """Return angles phi [rad] that are singular wherever G is; others are pi apart.

    On a 3-PRP robot one for each leg, at which its cross slide is parallel to its rail. A 3-PPR robot has none of
    these, but det J2 does not depend on G: one.
    """
    parallel = [leg.parallel_angle for leg in geometry.each]
    known = [phi for phi in parallel if phi is not None]
    return np.array(known or singular_angles(geometry)[:1])
