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
    """Time relative to the first point's `t`, which is arbitrary, such as zero or seconds since 1970 [s]."""
    x: Coordinate
    """x of the platform's centre in the base frame [m]."""
    y: Coordinate
    """y of the platform's centre in the base frame [m]."""
    phi: Coordinate
    """Angle of the platform in the base frame, counterclockwise [rad]."""
    velocity: Coordinates | None = None
    """Velocity of x, y and phi [m/s, m/s, rad/s]. The default is the mean velocity between the neighbouring points, and
    zero at both ends."""
    acceleration: tuple[Acceleration, Acceleration, Acceleration] | None = None
    """Acceleration of x, y and phi [m/s², m/s², rad/s²]; its default is computed like that of the velocity."""

    def __post_init__(self) -> None:
        check_fields(self)


class TrajectoryPart(Struct, frozen=True, forbid_unknown_fields=True):
    """Number of a message in a trajectory that is sent in parts."""

    number: Annotated[int, Meta(ge=1, le=MAX_POINTS // 2)]
    """Number of this part, from 1."""
    of: Annotated[int, Meta(ge=1, le=MAX_POINTS // 2)]
    """Total number of parts."""

    def __post_init__(self) -> None:
        if self.number > self.of:
            raise ValueError(f"part: number {self.number} exceeds the number of parts, {self.of}")


class TrajectoryGoal(GoalKind, frozen=True, tag="trajectory"):
    """Follow timed points from the robot's pose; quintic polynomials join the points."""

    points: Annotated[tuple[TrajectoryPoint, ...], Meta(min_length=2, max_length=MAX_PART)]
    """Points in order of time; the first is the robot's pose, and the robot is at rest at the last."""
    id: OwnId = None
    stretch: Stretch = False
    settle: bool = True
    """Whether the goal is done only when the robot is measured to be in position, as other goals are. Otherwise it is
    done at the end of its path."""
    valid_for: ValidFor = None
    part: TrajectoryPart | None = None
    """Number of this message if the points are sent in parts, each with the same `id` and options. The reply to each
    part is the reply to the whole goal."""
    marks: Marks = ()
    stop_at: StopAtEdge = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.part is not None and self.id is None:
            raise ValueError("id is missing; all parts of a trajectory need the same id")
        check_times([point.t for point in self.points])

    @property
    def lengthy(self) -> bool:
        """Whether the goal has more points than fit into one message."""
        return len(self.points) > MAX_PART


def check_times(times: Sequence[float]) -> None:
    """Raise ValueError if the times of the points [s] do not increase, or if the trajectory is too long."""
    duration = times[-1] - times[0] if times else 0.0
    if duration > MAX_DURATION_S:
        raise ValueError(
            f"points: the trajectory lasts {duration:g} s, the maximum is {MAX_DURATION_S:g} s; check that times are "
            "in seconds"
        )
    for before, after in itertools.pairwise(times):
        if not after - before > 0.999 * SHORTEST_PIECE:  # tolerate rounding of the last digit
            raise ValueError(
                f"points: t = {after} follows t = {before}: times must rise by at least {SHORTEST_PIECE:g} s"
            )


def parts(goal: TrajectoryGoal) -> list[TrajectoryGoal]:
    """Split a trajectory into messages of similar size; return the goal alone if it fits into one message."""
    points = goal.points
    number = -(-len(points) // MAX_PART)
    if number < 2:
        return [goal]
    bounds = [len(points) * k // number for k in range(number + 1)]
    return [
        structs.replace(goal, points=points[begin:end], part=TrajectoryPart(k, number))
        for k, (begin, end) in enumerate(itertools.pairwise(bounds), start=1)
    ]
