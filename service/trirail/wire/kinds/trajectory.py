"""Along timed points."""

from __future__ import annotations

import itertools
from typing import Annotated

from msgspec import Meta, Struct

from trirail.wire.goal_kind import (
    Acceleration,
    Coordinate,
    Coordinates,
    GoalKind,
    Identifier,
    Moment,
    Validity,
    check_fields,
)
from trirail.wire.sizes import MAX_POINTS

SHORTEST_PIECE = 1e-4
"""Least time between two points of a trajectory [s]: below, its derivatives lose their digits."""


class TrajectoryPoint(Struct, frozen=True, forbid_unknown_fields=True):
    """Where the platform is at a time [s]: x, y [m], phi [rad]; how fast and how accelerated, where given."""

    t: Moment
    """[s]; only differences between points count."""
    x: Coordinate
    """Of the platform's centre, in the base frame [m]."""
    y: Coordinate
    """Likewise [m]."""
    phi: Coordinate
    """The platform's angle in the base frame, counterclockwise [rad]."""
    velocity: Coordinates | None = None
    """Of x, y and phi [m/s, m/s, rad/s]; where it is not given, that between the neighbours, zero at both ends."""
    acceleration: tuple[Acceleration, Acceleration, Acceleration] | None = None
    """Of x, y and phi [m/s², m/s², rad/s²]; where it is not given, as the velocity."""

    def __post_init__(self) -> None:
        check_fields(self)


class TrajectoryGoal(GoalKind, frozen=True, tag="trajectory"):
    """Follow timed points, quintic between them, from where the robot stands."""

    points: Annotated[tuple[TrajectoryPoint, ...], Meta(min_length=2, max_length=MAX_POINTS)]
    """By rising time; the first is where the robot stands, the last at rest."""
    id: Identifier | None = None
    """As of a pose goal."""
    stretch: bool = False
    """Slow a trajectory that is too fast for a slider or the platform, instead of refusing it."""
    settle: bool = True
    """Whether it is done only when the robot is measured to be in position, as any other goal; else when its path has
    ended."""
    valid_for: Validity | None = None
    """As of a pose goal [s]."""

    def __post_init__(self) -> None:
        check_fields(self)
        for before, after in itertools.pairwise(self.points):
            if not after.t - before.t > 0.999 * SHORTEST_PIECE:  # not a matter of the last digit
                raise ValueError(
                    f"points: t = {after.t} follows t = {before.t}: times must rise, by {SHORTEST_PIECE:g} s at least"
                )
