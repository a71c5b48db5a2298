"""Test of the mechanism's kind, 3-PRP or 3-PPR, with a motion that differs between the kinds. All functions are pure.

Consider the slider motion with which a 3-PPR platform at angle phi moves along x. The same slider motion makes a 3-PRP
platform leave the line by sin phi cos phi times the distance. In the opposite case, the factor is tan phi. The two
kinds thus differ in first order of phi; for a pure rotation, they differ only in second order.
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
"""Minimum separation of the predictions for the two kinds, in multiples of the instrument's resolution."""
AMPLE_SEPARATION: Final = 24.0
"""Separation that is large enough to end the search for a motion, in multiples of the instrument's resolution."""
MARK_RADIUS_M: Final = 0.005
"""Maximum distance of the mark from the platform's centre [m]."""
SHARES: Final = tuple(np.geomspace(0.001, 1.0, 100).tolist())
"""Candidates for the size of the motion, as fractions of the way from the start to the platform's limits."""
MIN_TURN_SHARE: Final = 0.05
"""Minimum size of the turn, as SHARES. A smaller angle is comparable with unknown errors of the rails' angles."""
LIMIT_SAMPLES: Final = 33
"""Number of points in each part of the motion at which the limits are checked."""
AXES: Final = ("x", "y")


class KindTestMove(NamedTuple):
    """Motion that distinguishes the two kinds. The travel of the mark is measured from `first` to `second`."""

    first: Array
    """Slider positions at the start of the measurement, (3,) [m]."""
    second: Array
    """Slider positions at the end of the measurement, (3,) [m]."""
    axis: int
    """Axis along which the travel of the mark is measured: 0 for x, 1 for y."""
    turn: float
    """Platform angle at both positions [rad]."""
    along: int
    """Axis along which a platform of the configured kind moves from `first` to `second`: 0 for x, 1 for y."""
    distance: float
    """Distance of the motion from `first` to `second`, with its sign [m]."""


class MarkPrediction(NamedTuple):
    """Predicted travel of the mark along the axis of the measurement, for both kinds of mechanism."""

    configured: float
    """Travel for the configured kind [m]."""
    other: float
    """Travel for the other kind [m]."""
    uncertainty: float
    """Uncertainty of both predictions, since the position of the mark on the platform is unknown [m]."""

    @property
    def separation(self) -> float:
        """Minimum difference between the predictions for the two kinds [m]."""
        return abs(self.other - self.configured) - 2.0 * self.uncertainty


def predict_mark(robot: Geometry, other: Geometry, first: Array, second: Array, axis: int) -> MarkPrediction:
    """Predict the travel of the mark along `axis` between the slider positions `first` and `second`, for both kinds.

    Raises KinematicsError if the positions are out of reach for one of the kinds.
    """
    travels = []
    for each in (robot, other):
        start = forward(each, first)
        travels.append(forward(each, second, near=start) - start)
    uncertainty = MARK_RADIUS_M * max(abs(travel[2]) for travel in travels)
    return MarkPrediction(float(travels[0][axis]), float(travels[1][axis]), float(uncertainty))


def find_test_move(
    config: Config, robot: Geometry, other: Geometry, sliders: Array, resolution: float
) -> tuple[KindTestMove, MarkPrediction] | None:
    """Return the smallest test motion with ample separation, and the prediction for this motion.

    If no motion has ample separation, return the motion with the largest separation. Return None if there is no
    suitable motion. The motion starts and ends at the slider positions `sliders`, and stays within all limits for both
    kinds.
    """
    best: tuple[KindTestMove, MarkPrediction] | None = None
    # The shares ascend, so the first motion with ample separation is the smallest of these.
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
        pose[2] += max(share, MIN_TURN_SHARE) * (phi - start[2])
        ends.append(pose)
    first, second = inverse(robot, np.array(ends)).position
    return KindTestMove(first, second, along, float(ends[0][2]), along, float(ends[1][along] - ends[0][along]))


def _stays_within_limits(config: Config, robots: tuple[Geometry, Geometry], sliders: Array, move: KindTestMove) -> bool:
    """Return True if the sliders, cross slides and platforms of both kinds stay within their limits during a motion."""
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
    """Judge from the travel of the mark if the mechanism is of the configured kind.

    Parameters
    ----------
    kinds
        Configured kind and the other kind.
    moved
        Measured travel of the mark [m]; None if the motion was not run because the separation was too small.
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
    # With a tolerance of a quarter of the separation around each prediction, half of the separation remains as a gap in
    # which the answer is "neither".
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
