"""Test of the mechanism's kind, 3-PRP or 3-PPR: a motion on which both kinds differ, and its judgement; pure functions.

A 3-PRP platform at angle phi that receives the slider motion of a 3-PPR along x leaves its line by sin phi cos phi of
the distance; in the opposite case by tan phi. That is of first order in phi; a turn alone differs in second order.
"""

from __future__ import annotations

import itertools
import math
from typing import Final, NamedTuple

import numpy as np

from trirail.commissioning.judgement import Judgement, format_mm
from trirail.config import Config, room
from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry, travels
from trirail.kinematics.robot import forward, inverse

MIN_SEPARATION: Final = 8.0
"""Minimum separation of both predictions, in multiples of the instrument's resolution."""
AMPLE_SEPARATION: Final = 24.0
"""Separation at which the search for a larger motion ends, in the same multiples."""
MARK_RADIUS_M: Final = 0.005
"""Maximum distance of the mark from the platform's centre [m]."""
SHARES: Final = tuple(np.linspace(0.05, 1.0, 20).tolist())
"""Candidate ends of the motion, as shares of the platform's limits."""
LIMIT_SAMPLES: Final = 33
"""Points of each part of the motion at which the limits are checked."""
AXES: Final = ("x", "y")


class KindTestMove(NamedTuple):
    """Slider positions of the test, (3,) each [m], and the axis of the measurement: 0 for x, 1 for y."""

    first: Array
    second: Array
    axis: int
    turn: float
    """Platform angle at both positions [rad]."""
    along: int
    """Axis along which the configured kind moves from the first to the second position."""
    distance: float
    """Length of that motion [m]."""


class MarkPrediction(NamedTuple):
    """Predicted travel of the mark along the axis [m]."""

    configured: float
    other: float
    uncertainty: float
    """Uncertainty, because the position of the mark on the platform is unknown."""

    @property
    def separation(self) -> float:
        """Minimum difference of the two kinds [m]."""
        return abs(self.other - self.configured) - 2.0 * self.uncertainty


def predict_mark(robot: Geometry, other: Geometry, first: Array, second: Array, axis: int) -> MarkPrediction:
    """Return the travel of both kinds' centres between two slider positions. Raises KinematicsError."""
    travels = []
    for each in (robot, other):
        start = forward(each, first)
        travels.append(forward(each, second, near=start) - start)
    uncertainty = MARK_RADIUS_M * max(abs(travel[2]) for travel in travels)
    return MarkPrediction(float(travels[0][axis]), float(travels[1][axis]), float(uncertainty))


def find_test_move(
    config: Config, robot: Geometry, other: Geometry, sliders: Array, resolution: float
) -> tuple[KindTestMove, MarkPrediction] | None:
    """Return the smallest test motion with ample separation, else the one with the largest; None if there is none.

    The motion starts and ends at `sliders`. Both kinds stay within all limits.
    """
    best: tuple[KindTestMove, MarkPrediction] | None = None
    # Shares ascend, so the first motion with ample separation is the smallest.
    for share, along, turn in itertools.product(SHARES, (0, 1), (1, 0)):
        try:
            move = _make_move(config, robot, sliders, share, along, config.limits.platform.phi[turn])
            candidates = [
                (move._replace(axis=axis), predict_mark(robot, other, move.first, move.second, axis)) for axis in (0, 1)
            ]
        except KinematicsError:
            continue
        better = max(candidates, key=lambda each: each[1].separation)
        if (best is None or better[1].separation > best[1].separation) and _stays_within_limits(
            config, (robot, other), sliders, move
        ):
            best = better
            if better[1].separation >= AMPLE_SEPARATION * resolution:
                break
    return best


def _make_move(config: Config, robot: Geometry, sliders: Array, share: float, along: int, phi: float) -> KindTestMove:
    platform = config.limits.platform
    start = forward(robot, sliders)
    ends = []
    for end in (platform.x, platform.y)[along]:
        pose = start.copy()
        pose[along] += share * (end - start[along])
        pose[2] += share * (phi - start[2])
        ends.append(pose)
    first, second = inverse(robot, np.array(ends)).position
    return KindTestMove(first, second, along, float(ends[0][2]), along, float(ends[1][along] - ends[0][along]))


def _stays_within_limits(config: Config, robots: tuple[Geometry, Geometry], sliders: Array, move: KindTestMove) -> bool:
    """Return True if sliders, cross slides and platform of both kinds stay within their limits, out and back."""
    platform, shares = config.limits.platform, np.linspace(0.0, 1.0, LIMIT_SAMPLES)[:, None]
    corners = (sliders, move.first, move.second, sliders)
    path = np.concatenate([a + shares * (b - a) for a, b in itertools.pairwise(corners)])
    box = np.array([platform.x, platform.y, platform.phi])
    for robot in robots:
        try:
            poses = forward(robot, path)
            in_travel = room(config.limits).holds(travels(robot, poses))
        except KinematicsError:
            return False
        if not (in_travel.all() and (poses >= box[:, 0]).all() and (poses <= box[:, 1]).all()):
            return False
    return True


def judge_kind(
    kinds: tuple[str, str], move: KindTestMove, expected: MarkPrediction, moved: float | None, resolution: float
) -> Judgement:
    """Determine the kind of mechanism from the travel of the mark.

    Parameters
    ----------
    kinds
        Configured kind and the other kind.
    moved
        Measured travel of the mark [m]; None if the motion was not run because the separation is too small.
    resolution
        Resolution of the instrument [m].
    """
    configured, other = kinds
    axis, line = AXES[move.axis], AXES[move.along]
    planned = (
        f"turned by {math.degrees(move.turn):+.2f}° and sent {format_mm(move.distance)} along {line}, the mark moves "
        f"{format_mm(expected.configured)} along {axis} as a {configured}, {format_mm(expected.other)} as a {other}"
    )
    if moved is None or expected.separation < MIN_SEPARATION * resolution:
        reason = (
            f"that difference is less than {MIN_SEPARATION:g} times {resolution * 1e3:g} mm: the travel is too "
            "short to distinguish the kinds"
        )
        remedy = "use an instrument with a finer resolution, or start nearer to the middle of the travel"
        return Judgement("skipped", (planned, reason), remedy)
    measured = f"it moved {format_mm(moved)}"
    # A quarter on either side leaves half of the separation as a gap in which the answer is "neither".
    allowed = expected.separation / 4.0 + expected.uncertainty
    if abs(moved - expected.configured) <= allowed:
        return Judgement("ok", (planned, f"{measured}: it is a {configured}, as configured"))
    if abs(moved - expected.other) <= allowed:
        remedy = f'[geometry] kind = "{other}", and its keys for each leg: configs/stages.md; then start again with it'
        return Judgement("wrong", (planned, f"{measured}: it is a {other}, not a {configured}"), remedy)
    remedy = (
        f"check that the instrument reads a mark near the centre, and rises towards +{axis}; then compare [geometry] "
        "with the robot: angles, anchors and directions of the rails"
    )
    return Judgement("wrong", (planned, f"{measured}: it is neither"), remedy)
