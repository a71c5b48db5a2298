"""Along timed points."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta, Struct, structs

from trirail.wire.goal_kind import (
    Acceleration,
    Coordinate,
    Coordinates,
    GoalKind,
    OwnId,
    ValidFor,
    check_fields,
)
from trirail.wire.sizes import MAX_PART, MAX_POINTS

SHORTEST_PIECE = 1e-4
"""Least time between two points of a trajectory [s]: below, its derivatives lose their digits."""


LONGEST = 86_400.0
"""Most that a trajectory lasts [s]."""
Time = Annotated[float, Meta(ge=-1e10, le=1e10)]
"""By any clock [s]."""

Stretch = Annotated[
    bool, Meta(description="slow a trajectory that is too fast for a slider or the platform, instead of refusing it")
]


class TrajectoryPoint(Struct, frozen=True, forbid_unknown_fields=True):
    """Where the platform is at a time [s]: x, y [m], phi [rad]; how fast and how accelerated, where given."""

    t: Time
    """[s]; it counts from the first point, whatever that has: zero, or seconds since 1970."""
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


class TrajectoryPart(Struct, frozen=True, forbid_unknown_fields=True):
    """Number of a message of a trajectory that is sent in several."""

    number: Annotated[int, Meta(ge=1, le=MAX_POINTS // 2)]
    """Counted from 1."""
    of: Annotated[int, Meta(ge=1, le=MAX_POINTS // 2)]
    """Number of parts."""

    def __post_init__(self) -> None:
        if self.number > self.of:
            raise ValueError(f"part: number is {self.number} of {self.of}")


class TrajectoryGoal(GoalKind, frozen=True, tag="trajectory"):
    """Follow timed points, quintic between them, from where the robot stands."""

    points: Annotated[tuple[TrajectoryPoint, ...], Meta(min_length=2, max_length=MAX_PART)]
    """By rising time; the first is where the robot stands, the last at rest."""
    id: OwnId = None
    stretch: Stretch = False
    settle: bool = True
    """Whether it is done only when the robot is measured to be in position, as any other goal; else when its path has
    ended."""
    valid_for: ValidFor = None
    part: TrajectoryPart | None = None
    """Number of this message if the points are sent in several, each with the same `id` and options. Each is answered
    as the whole goal is."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.part is not None and self.id is None:
            raise ValueError("id: the parts of a trajectory need the same one")
        check_times([point.t for point in self.points])

    @property
    def lengthy(self) -> bool:
        """Whether it has more points than a message holds."""
        return len(self.points) > MAX_PART


def check_times(times: Sequence[float]) -> None:
    """Raise ValueError where times of points [s] do not rise, or last too long."""
    lasts = times[-1] - times[0] if times else 0.0
    if lasts > LONGEST:
        raise ValueError(f"points: they last {lasts:g} s, a trajectory {LONGEST:g} s at most; are times in seconds?")
    for before, after in itertools.pairwise(times):
        if not after - before > 0.999 * SHORTEST_PIECE:  # not a matter of the last digit
            raise ValueError(
                f"points: t = {after} follows t = {before}: times must rise, by {SHORTEST_PIECE:g} s at least"
            )


def parts(goal: TrajectoryGoal) -> list[TrajectoryGoal]:
    """Return a trajectory as it is sent: itself where one message holds it, else in parts of about the same size."""
    points = goal.points
    number = -(-len(points) // MAX_PART)
    if number < 2:
        return [goal]
    bounds = [len(points) * k // number for k in range(number + 1)]
    return [
        structs.replace(goal, points=points[begin:end], part=TrajectoryPart(k, number))
        for k, (begin, end) in enumerate(itertools.pairwise(bounds), start=1)
    ]
