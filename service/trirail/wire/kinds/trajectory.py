"""Goal kind for trajectories of timed points."""

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
"""Minimum time between two points of a trajectory [s]; with shorter times, the derivatives lose precision."""
MAX_DURATION_S = 86_400.0
"""Maximum duration of a trajectory [s]."""
Time = Annotated[float, Meta(ge=-1e10, le=1e10)]
"""Time on a clock of the client's choice [s]."""

Stretch = Annotated[
    bool,
    Meta(description="slow down a trajectory that exceeds a limit of a slider or the platform, instead of refusing it"),
]


class TrajectoryPoint(Struct, frozen=True, forbid_unknown_fields=True):
    """Pose of the platform at a time, with optional velocity and acceleration."""

    t: Time
    """Time of the point [s]. Only differences matter, so the first point may have any time, such as 0 or the time since
    1970."""
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
    """Acceleration of x, y and phi [m/s², m/s², rad/s²]. The default is the mean acceleration between the neighbouring
    points, and zero at both ends."""

    def __post_init__(self) -> None:
        check_fields(self)


class TrajectoryPart(Struct, frozen=True, forbid_unknown_fields=True):
    """Position of a message in the sequence of messages that together contain a trajectory."""

    number: Annotated[int, Meta(ge=1, le=MAX_POINTS // 2)]
    """Number of this part, from 1."""
    of: Annotated[int, Meta(ge=1, le=MAX_POINTS // 2)]
    """Total number of parts."""

    def __post_init__(self) -> None:
        if self.number > self.of:
            raise ValueError(f"part: number {self.number} exceeds the number of parts, {self.of}")


class TrajectoryGoal(GoalKind, frozen=True, tag="trajectory"):
    """Follow a trajectory of timed points that begins at the robot's pose. Quintic polynomials join the points."""

    points: Annotated[tuple[TrajectoryPoint, ...], Meta(min_length=2, max_length=MAX_PART)]
    """Points in order of time. The first point is the robot's pose. The robot is at rest at the last point."""
    id: OwnId = None
    stretch: Stretch = False
    settle: bool = True
    """If true, the goal is done when the robot's measured position has settled at the target, as for other goals. If
    false, the goal is done at the end of its path."""
    valid_for: ValidFor = None
    part: TrajectoryPart | None = None
    """Number of this message, if the points are sent in several messages with the same `id` and options. The reply to
    each message is the reply to the whole goal."""
    marks: Marks = ()
    stop_at: StopAtEdge = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.part is not None and self.id is None:
            raise ValueError("id is missing; all parts of a trajectory need the same id")
        check_times([point.t for point in self.points])

    @property
    def lengthy(self) -> bool:
        """True if the goal has more points than one message may contain."""
        return len(self.points) > MAX_PART


def check_times(times: Sequence[float]) -> None:
    """Raise ValueError if the times of the points [s] do not increase by SHORTEST_PIECE, or last too long."""
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
    """Split a trajectory into goals of similar size that fit into one message each."""
    points = goal.points
    number = -(-len(points) // MAX_PART)
    if number < 2:
        return [goal]
    bounds = [len(points) * k // number for k in range(number + 1)]
    return [
        structs.replace(goal, points=points[begin:end], part=TrajectoryPart(k, number))
        for k, (begin, end) in enumerate(itertools.pairwise(bounds), start=1)
    ]
