"""What each slider of a stage moves for a small motion of its table: so that a dial gauge tells which kind it is."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from trirail.config import Config, geometry
from trirail.diagnosis.check import Check, Judgement
from trirail.errors import KinematicsError
from trirail.kinematics.geometry import Geometry, other_kind, travels

MOTIONS = (
    ("1 mm in x", (0.001, 0.0, 0.0)),
    ("1 mm in y", (0.0, 0.001, 0.0)),
    ("1° in φ", (0.0, 0.0, math.radians(1.0))),
)
"""From x = y = φ = 0 [m, rad]."""
APART = 1e-6
"""Sliders of the two kinds that differ by less are the same to a dial gauge [m]."""
_KINDS = {"3-PRP": "pivots on the carriages", "3-PPR": "cross slides on the carriages"}


def _moved(robot: Geometry, pose: tuple[float, float, float]) -> list[float]:
    at_zero, there = travels(robot, [(0.0, 0.0, 0.0), pose])[0]
    moved: list[float] = (there - at_zero).tolist()
    return moved


def _words(robot: Geometry, moved: list[float]) -> str:
    return ", ".join(f"{leg} {way * 1e3:+.4f} mm" for leg, way in zip(robot.labels, moved, strict=True))


def _kind(config: Config) -> Iterator[Check]:
    """What the configured mechanism does, and what the other kind would do with carriages in the same places."""
    robot = geometry(config.geometry)
    said = [f"{name} moves {_words(robot, _moved(robot, pose))}" for name, pose in MOTIONS]
    turned = MOTIONS[-1][1]
    try:
        other = other_kind(robot)
    except KinematicsError:
        other = None
    remedy = ""
    if other is not None:
        moved = _moved(other, turned)
        if np.abs(np.subtract(moved, _moved(robot, turned))).max() > APART:
            remedy = f"of kind {other.kind}, {_KINDS[other.kind]}, {MOTIONS[-1][0]} would move {_words(robot, moved)}"
    yield Check("kind", "ok", f"{robot.kind}, {_KINDS[robot.kind]}: {'; '.join(said)}", remedy, "geometry.kind")


def _zero(config: Config) -> Iterator[Check]:
    """At x = y = φ = 0, if the robot may be there, no slider is beyond its travel."""
    platform = config.limits.platform
    if not all(low <= 0.0 <= high for low, high in (platform.x, platform.y, platform.phi)):
        return
    robot = geometry(config.geometry)
    at_zero = travels(robot, (0.0, 0.0, 0.0))[0].tolist()
    for leg, at, (low, high) in zip(robot.labels, at_zero, config.limits.slider.positions, strict=True):
        if not low <= at <= high:
            found = f"at x = y = φ = 0 slider {leg} would be at {at:.4g} m, beyond its travel, [{low:g}, {high:g}]"
            yield Check(
                "reach", "warning", found, "home, anchor and limits.slider.position of that leg: metres?", "geometry"
            )


JUDGEMENTS = (
    Judgement(("geometry",), _kind),
    Judgement(("geometry", "limits.platform", "limits.slider"), _zero),
)
