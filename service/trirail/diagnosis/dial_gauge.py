"""Report of the slider travels for small motions of a stage's table, with which a dial gauge can identify its kind."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from trirail.config import Config, geometry
from trirail.config.impossible import ROUNDING
from trirail.diagnosis.check import Check, ConfigCheck
from trirail.errors import KinematicsError
from trirail.kinematics.geometry import Geometry, other_kind, travels

MOTIONS = (
    ("1 mm in x", (0.001, 0.0, 0.0)),
    ("1 mm in y", (0.0, 0.001, 0.0)),
    ("1° in φ", (0.0, 0.0, math.radians(1.0))),
)
"""Motions of the table that start at x = y = φ = 0 [m, m, rad]."""
GAUGE_RESOLUTION_M = 1e-6
"""Difference between the slider travels of the two kinds that a dial gauge can resolve [m]."""
_KINDS = {"3-PRP": "pivots on the carriages", "3-PPR": "cross slides on the carriages"}


def _travel(robot: Geometry, pose: tuple[float, float, float]) -> list[float]:
    at_zero, there = travels(robot, [(0.0, 0.0, 0.0), pose])[0]
    distances: list[float] = (there - at_zero).tolist()
    return distances


def _format(robot: Geometry, distances: list[float]) -> str:
    return ", ".join(f"{leg} {length * 1e3:+.4f} mm" for leg, length in zip(robot.labels, distances, strict=True))


def _kind(config: Config) -> Iterator[Check]:
    """Report the slider travels of the configured kind of mechanism, and of the other kind if they differ."""
    robot = geometry(config.geometry)
    motions = [f"{name} moves {_format(robot, _travel(robot, pose))}" for name, pose in MOTIONS]
    turned = MOTIONS[-1][1]
    try:
        other = other_kind(robot)
    except KinematicsError:
        other = None
    remedy = ""
    if other is not None:
        moved = _travel(other, turned)
        if np.abs(np.subtract(moved, _travel(robot, turned))).max() > GAUGE_RESOLUTION_M:
            remedy = f"of kind {other.kind}, {_KINDS[other.kind]}, {MOTIONS[-1][0]} would move {_format(robot, moved)}"
    yield Check("kind", "ok", f"{robot.kind}, {_KINDS[robot.kind]}: {'; '.join(motions)}", remedy, "geometry.kind")


def _zero(config: Config) -> Iterator[Check]:
    """Check that no slider exceeds its travel at x = y = φ = 0, if this pose is within the platform's limits."""
    platform = config.limits.platform
    if not all(low <= 0.0 <= high for low, high in (platform.x, platform.y, platform.phi)):
        return
    robot = geometry(config.geometry)
    at_zero = travels(robot, (0.0, 0.0, 0.0))[0].tolist()
    for leg, at, (low, high) in zip(robot.labels, at_zero, config.limits.slider.positions, strict=True):
        if not low - ROUNDING <= at <= high + ROUNDING:
            finding = f"at x = y = φ = 0 slider {leg} would be at {at:.4g} m, beyond its travel, [{low:g}, {high:g}]"
            yield Check(
                "reach",
                "warning",
                finding,
                "check home, anchor and limits.slider.position of that leg: metres?",
                "geometry",
            )


CONFIG_CHECKS = (
    ConfigCheck(("geometry",), _kind),
    ConfigCheck(("geometry", "limits.platform", "limits.slider"), _zero),
)
