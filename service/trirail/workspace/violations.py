"""Check of a pose against the limits of the robot's own reach."""

from __future__ import annotations

from numpy.typing import ArrayLike

from trirail.config import Limits
from trirail.kinematics.geometry import LEGS, Geometry
from trirail.kinematics.robot import inverse
from trirail.motion.limits import Violation
from trirail.workspace.singularity import distance_to_singularity

__all__ = ["violations"]


def violations(geometry: Geometry, limits: Limits, pose: ArrayLike) -> list[Violation]:
    """Return every limit of the robot's own reach that a pose (3,) exceeds, with the value at that pose.

    The limits are those of `reachable_slice`. Raises KinematicsError in the same cases as inverse.
    """
    motion = inverse(geometry, pose)
    exceeded = []
    for quantity, values, ends in (
        ("position", motion.position, limits.slider.positions),
        ("passive position", motion.passive_position, [limits.slider.passive] * 3),
    ):
        for leg, label, value, (low, high) in zip(LEGS, geometry.labels, values.tolist(), ends, strict=True):
            if not low <= value <= high:
                exceeded.append(Violation(leg, quantity, value, low if value < low else high, "m", label))
    distance = float(distance_to_singularity(geometry, pose))
    if distance < limits.singularity_margin:
        exceeded.append(Violation("phi", "distance to singularity", distance, limits.singularity_margin, "rad"))
    return exceeded
