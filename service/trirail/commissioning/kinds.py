"""Which of the two kinds a stage is: a way along which their platforms part, and what a third measurement says; pure.

Turned by phi, a 3-PRP platform that is sent along x by the sliders of a 3-PPR leaves its line by sin phi cos phi of the
way, and the other way round by tan phi. That is of first order, where a turn alone parts them by its square.
"""

from __future__ import annotations

import itertools
import math
from typing import Final, NamedTuple

import numpy as np

from trirail.commissioning.judgement import Judged, in_mm
from trirail.config import Config, room
from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry, travels
from trirail.kinematics.robot import forward, inverse

DISTINCT: Final = 8.0
"""So many times what the instrument is read to, the two kinds must be apart at least."""
AMPLE: Final = 24.0
"""So many times are enough: no larger way is taken."""
NEAR: Final = 0.005
"""How far from the platform's centre the mark may be [m]."""
SHARES: Final = tuple(np.linspace(0.05, 1.0, 20).tolist())
"""Of the platform's limits, that the way goes to."""
LOOKS: Final = 33
"""Places of each part of the way at which it is looked whether either kind is within its limits."""
AXES: Final = ("x", "y")


class KindWay(NamedTuple):
    """Where the sliders are to go, (3,) each [m], and along which axis, 0 for x and 1 for y, the mark is measured."""

    first: Array
    second: Array
    axis: int
    turn: float
    """By which the platform is turned at both [rad]."""
    along: int
    """The axis along which the configured kind goes from the first to the second, and by how much [m]."""
    distance: float


class KindPredicted(NamedTuple):
    """How far the mark goes along the axis [m]."""

    configured: float
    other: float
    unsure: float
    """By so much, as nobody knows where on the platform the mark is."""

    @property
    def apart(self) -> float:
        """By how much the kinds differ at least [m]."""
        return abs(self.other - self.configured) - 2.0 * self.unsure


def predicted(robot: Geometry, other: Geometry, first: Array, second: Array, axis: int) -> KindPredicted:
    """Return how far the centre of either kind goes, by where its sliders are. Raises KinematicsError."""
    ways = []
    for each in (robot, other):
        start = forward(each, first)
        ways.append(forward(each, second, near=start) - start)
    unsure = NEAR * max(abs(way[2]) for way in ways)
    return KindPredicted(float(ways[0][axis]), float(ways[1][axis]), float(unsure))


def way_apart(
    config: Config, robot: Geometry, other: Geometry, sliders: Array, read_to: float
) -> tuple[KindWay, KindPredicted] | None:
    """Return the smallest way that tells the kinds apart with ease, else the one that does so best; None for no way.

    It begins and ends where the sliders are. Whichever kind it is, the platform stays within all limits.
    """
    best: tuple[KindWay, KindPredicted] | None = None
    for share, along, turn in itertools.product(SHARES, (0, 1), (1, 0)):
        try:
            way = _way(config, robot, sliders, share, along, config.limits.platform.phi[turn])
            found = [(way._replace(axis=axis), predicted(robot, other, way.first, way.second, axis)) for axis in (0, 1)]
        except KinematicsError:
            continue
        better = max(found, key=lambda each: each[1].apart)
        if (best is None or better[1].apart > best[1].apart) and _within(config, (robot, other), sliders, way):
            best = better
            if better[1].apart >= AMPLE * read_to:
                break
    return best


def _way(config: Config, robot: Geometry, sliders: Array, share: float, along: int, phi: float) -> KindWay:
    platform = config.limits.platform
    start = forward(robot, sliders)
    ends = []
    for end in (platform.x, platform.y)[along]:
        pose = start.copy()
        pose[along] += share * (end - start[along])
        pose[2] += share * (phi - start[2])
        ends.append(pose)
    first, second = inverse(robot, np.array(ends)).position
    return KindWay(first, second, along, float(ends[0][2]), along, float(ends[1][along] - ends[0][along]))


def _within(config: Config, robots: tuple[Geometry, Geometry], sliders: Array, way: KindWay) -> bool:
    """Whether either kind stays within sliders, cross slides and platform all the way, there and back."""
    platform, shares = config.limits.platform, np.linspace(0.0, 1.0, LOOKS)[:, None]
    corners = (sliders, way.first, way.second, sliders)
    path = np.concatenate([a + shares * (b - a) for a, b in itertools.pairwise(corners)])
    box = np.array([platform.x, platform.y, platform.phi])
    for robot in robots:
        try:
            poses = forward(robot, path)
            held = room(config.limits).holds(travels(robot, poses))
        except KinematicsError:
            return False
        if not (held.all() and (poses >= box[:, 0]).all() and (poses <= box[:, 1]).all()):
            return False
    return True


def judge_kind(
    kinds: tuple[str, str], way: KindWay, expected: KindPredicted, moved: float | None, read_to: float
) -> Judged:
    """Judge how far the mark moved [m], None where the way is not worth going, as is read to `read_to` [m].

    `kinds` are the configured one and the other.
    """
    configured, other = kinds
    axis, line = AXES[way.axis], AXES[way.along]
    planned = (
        f"turned by {math.degrees(way.turn):+.2f}° and sent {in_mm(way.distance)} along {line}, the mark goes "
        f"{in_mm(expected.configured)} along {axis} as a {configured}, {in_mm(expected.other)} as a {other}"
    )
    if moved is None or expected.apart < DISTINCT * read_to:
        told = f"that is not apart by {DISTINCT:g} times {read_to * 1e3:g} mm: the kinds cannot be told at this travel"
        remedy = "an instrument that is read more finely, or a start nearer to the middle of the travel"
        return Judged("skipped", (planned, told), remedy)
    measured = f"it went {in_mm(moved)}"
    allowed = expected.apart / 4.0 + expected.unsure
    if abs(moved - expected.configured) <= allowed:
        return Judged("ok", (planned, f"{measured}: it is a {configured}, as configured"))
    if abs(moved - expected.other) <= allowed:
        remedy = f'[geometry] kind = "{other}", and its keys for each leg: configs/stages.md; then begin again with it'
        return Judged("wrong", (planned, f"{measured}: it is a {other}, not a {configured}"), remedy)
    remedy = (
        f"see that the instrument reads a mark near the centre, and rises towards +{axis}; then compare [geometry] "
        "with the robot: angles, anchors and directions of the rails"
    )
    return Judged("wrong", (planned, f"{measured}: it is neither"), remedy)
