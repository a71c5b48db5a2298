"""Bounds of the aspect (the region without singular poses) in which the robot works.

The bounds are angles that are singular for any centre G, and zeros of det J2. This module uses numpy only. Plots of the
workspace therefore do not need the compiled kinematics.
"""

from __future__ import annotations

import math

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry, det_j2, singular_angles

__all__ = ["det_j2_rows", "phi_range", "wall_angles"]


def phi_range(geometry: Geometry) -> tuple[float, float]:
    """Return the nearest angles phi [rad] below and above zero that are singular for any G."""
    ahead = wall_angles(geometry) % math.pi
    return float(ahead.max()) - math.pi, float(ahead.min())


def det_j2_rows(geometry: Geometry, phi: Array) -> Array:
    """Return rows d (K, 3) for angles phi (K,), such that det J2 = d @ (1, x, y) [m] at each angle.

    Only the third column of J2 (18) depends on G. At a fixed phi, this column is linear in G or constant.
    """
    rows = np.stack([det_j2(geometry, centre, phi) for centre in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))], axis=1)
    rows[:, 1:] -= rows[:, :1]
    return rows


def wall_angles(geometry: Geometry) -> Array:
    """Return the angles phi, modulo pi, at which the robot is singular for any G [rad]. These angles are called walls.

    A 3-PRP robot has one wall per leg, at which the cross slide is parallel to the rail. A 3-PPR robot has a single
    wall. It is a zero of det J2, which does not depend on G.
    """
    parallel = [leg.parallel_angle for leg in geometry.each]
    known = [phi for phi in parallel if phi is not None]
    return np.array(known or singular_angles(geometry)[:1])
