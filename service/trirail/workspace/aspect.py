"""What bounds the poses in which the robot works: where an edge is parallel to its rail, and where det J2 is zero.

Plain numpy, for who draws a workspace and has no use for the compiled kinematics.
"""

from __future__ import annotations

import math

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry, det_j2

__all__ = ["det_j2_rows", "parallel_angles", "range_of_j1"]


def range_of_j1(geometry: Geometry) -> tuple[float, float]:
    """Return the angles phi [rad] on either side of zero at which the edge of some leg is parallel to its rail."""
    ahead = parallel_angles(geometry) % math.pi
    return float(ahead.max()) - math.pi, float(ahead.min())


def det_j2_rows(geometry: Geometry, phi: Array) -> Array:
    """Return rows d, (K, 3), for angles phi, (K,): at these det J2 = d @ (1, x, y), in metres.

    Only the third column of J2, (18), depends on G, and at one phi it does so linearly.
    """
    rows = np.stack([det_j2(geometry, centre, phi) for centre in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))], axis=1)
    rows[:, 1:] -= rows[:, :1]
    return rows


def parallel_angles(geometry: Geometry) -> Array:
    """Return for each leg an angle phi [rad] at which its edge is parallel to its rail; others are pi apart."""
    return np.array([leg.rail_angle - leg.edge_angle for leg in geometry.legs])
