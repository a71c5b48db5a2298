"""Check of a pose against the travel of the joints and the singularity margin."""

from __future__ import annotations

from numpy.typing import ArrayLike

from trirail.config import Limits
from trirail.kinematics.geometry import LEGS, Geometry
from trirail.kinematics.robot import inverse
from trirail.motion.limits import Violation
from trirail.motion.paths import ROUNDING
from trirail.workspace.singularity import distance_to_singularity

__all__ = ["violations"]


def violations(geometry: Geometry, limits: Limits, pose: ArrayLike) -> list[Violation]:
    """Return a description of every limit that a pose (3,) exceeds, except the limits in limits.platform.

    These are the limits that bound `reachable_slice`. As in plans, a pose at a limit may exceed it by ROUNDING. Raises
    KinematicsError in the same cases as inverse.
    """
    motion = inverse(geometry, pose)
    exceeded = []
    for quantity, values, ends in (
        ("position", motion.position, limits.slider.positions),
        ("passive position", motion.passive_position, [limits.slider.passive] * 3),
    ):
        for leg, label, value, (low, high) in zip(LEGS, geometry.labels, values.tolist(), ends, strict=True):
            if not low - ROUNDING <= value <= high + ROUNDING:
                exceeded.append(Violation(leg, quantity, value, low if value < low else high, "m", label))
    distance = float(distance_to_singularity(geometry, pose))
    if distance < limits.singularity_margin:
        exceeded.append(Violation("phi", "distance to singularity", distance, limits.singularity_margin, "rad"))
    return exceeded
