"""Trajectories of timed points."""

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
from trirail.wire.marks import Marks, StopAtEdge
from trirail.wire.sizes import MAX_PART, MAX_POINTS

SHORTEST_PIECE = 1e-4
"""Minimum time between two points of a trajectory [s]; below it the derivatives lose precision."""
MAX_DURATION_S = 86_400.0
"""Maximum duration of a trajectory [s]."""
Time = Annotated[float, Meta(ge=-1e10, le=1e10)]
"""Time of any clock [s]."""

Stretch = Annotated[
    bool,
    Meta(description="slow down a trajectory that exceeds a limit of a slider or the platform, instead of refusing it"),
]


class TrajectoryPoint(Struct, frozen=True, forbid_unknown_fields=True):
    """Pose of the platform at a time, with optional velocity and acceleration."""

    t: Time
    """Time relative to that of the first point, which is arbitrary, such as zero or seconds since 1970 [s]."""
    x: Coordinate
    """x of the platform's centre in the base frame [m]."""
    y: Coordinate
    """y of the platform's centre in the base frame [m]."""
    phi: Coordinate
    """Angle of the platform in the base frame, counterclockwise [rad]."""
    velocity: Coordinates | None = None
    """Velocity of x, y and phi [m/s, m/s, rad/s]; by default the mean between the neighbours, and zero at both ends."""
    acceleration: tuple[Acceleration, Acceleration, Acceleration] | None = None
    """Acceleration of x, y and phi [m/s², m/s², rad/s²]; the default is derived as for the velocity."""

    def __post_init__(self) -> None:
        check_fields(self)


class TrajectoryPart(Struct, frozen=True, forbid_unknown_fields=True):
    """Number of one message of a trajectory that is sent in parts."""

    number: Annotated[int, Meta(ge=1, le=MAX_POINTS // 2)]
    """Counted from 1."""
    of: Annotated[int, Meta(ge=1, le=MAX_POINTS // 2)]
    """Number of parts."""

    def __post_init__(self) -> None:
        if self.number > self.of:
            raise ValueError(f"part: number {self.number} exceeds the number of parts, {self.of}")


class TrajectoryGoal(GoalKind, frozen=True, tag="trajectory"):
    """Follow timed points, joined by quintic polynomials, from the robot's pose."""

    points: Annotated[tuple[TrajectoryPoint, ...], Meta(min_length=2, max_length=MAX_PART)]
    """Points in order of time; the first is the robot's pose, the last is at rest."""
    id: OwnId = None
    stretch: Stretch = False
    settle: bool = True
    """Whether the goal is done when the robot is measured to be in position, as for other goals; otherwise at the end
    of its path."""
    valid_for: ValidFor = None
    part: TrajectoryPart | None = None
    """Number of this message if the points are sent in parts, each with the same `id` and options. Each part receives
    the reply to the whole goal."""
    marks: Marks = ()
    stop_at: StopAtEdge = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.part is not None and self.id is None:
            raise ValueError("id is missing; all parts of a trajectory need the same id")
        check_times([point.t for point in self.points])

    @property
    def lengthy(self) -> bool:
        """Whether it has more points than fit into one message."""
        return len(self.points) > MAX_PART


def check_times(times: Sequence[float]) -> None:
    """Raise ValueError if the times of points [s] do not increase, or if the duration is too long."""
    duration = times[-1] - times[0] if times else 0.0
    if duration > MAX_DURATION_S:
        raise ValueError(
            f"points: they last {duration:g} s, a trajectory {MAX_DURATION_S:g} s at most; are times in seconds?"
        )
    for before, after in itertools.pairwise(times):
        if not after - before > 0.999 * SHORTEST_PIECE:  # not a matter of the last digit
            raise ValueError(
                f"points: t = {after} follows t = {before}: times must rise, by {SHORTEST_PIECE:g} s at least"
            )


def parts(goal: TrajectoryGoal) -> list[TrajectoryGoal]:
    """Return a trajectory as a list of messages: itself if it fits into one, otherwise parts of about equal size."""
    points = goal.points
    number = -(-len(points) // MAX_PART)
    if number < 2:
        return [goal]
    bounds = [len(points) * k // number for k in range(number + 1)]
    return [
        structs.replace(goal, points=points[begin:end], part=TrajectoryPart(k, number))
        for k, (begin, end) in enumerate(itertools.pairwise(bounds), start=1)
    ]
