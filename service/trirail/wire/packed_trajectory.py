"""A trajectory as the processes of the service have it: one row of numbers a point.

The loop must not decode thousands of points: 5,000 of them take 15 ms as structs, and 0.1 ms as bytes.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Sequence

from msgspec import structs
from trirail_drivers.interface import Triple

from trirail.wire.goal_kind import GoalKind, check_fields
from trirail.wire.kinds.trajectory import TrajectoryGoal, TrajectoryPoint, check_times
from trirail.wire.marks import Mark, StopAt
from trirail.wire.sizes import MAX_PART

COLUMNS = 10
"""t, x, y, phi; their velocity and acceleration, not a number where a point has none."""
ROW = COLUMNS * array("d").itemsize
Row = tuple[float, Triple, Triple | None, Triple | None]
_NONE = (math.nan,) * 3


class PackedTrajectory(GoalKind, frozen=True, tag="packed trajectory"):
    """A trajectory goal, with its points packed; the fields of the same names are those of TrajectoryGoal."""

    rows: bytes
    """float64 of this machine's byte order, COLUMNS of them a point."""
    id: str | None = None
    stretch: bool = False
    settle: bool = True
    valid_for: float | None = None
    marks: tuple[Mark, ...] = ()
    stop_at: StopAt | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if len(self.rows) % ROW or len(self.rows) < 2 * ROW:
            raise ValueError(f"{len(self.rows)} bytes of points, each of {ROW}")

    @property
    def lengthy(self) -> bool:
        """Whether it has more points than a message holds."""
        return len(self.rows) > MAX_PART * ROW

    @property
    def points(self) -> Iterator[Row]:
        """The points: time, pose, velocity and acceleration."""
        values = array("d", self.rows).tolist()
        for at in range(0, len(values), COLUMNS):
            t, x, y, phi, *derivatives = values[at : at + COLUMNS]
            yield t, (x, y, phi), _triple(derivatives[:3]), _triple(derivatives[3:])

    def unpacked(self) -> TrajectoryGoal:
        """Return it as a client has it."""
        points = tuple(TrajectoryPoint(t, *pose, *derivatives) for t, pose, *derivatives in self.points)
        return TrajectoryGoal(
            points, self.id, self.stretch, self.settle, self.valid_for, marks=self.marks, stop_at=self.stop_at
        )


def packed(goal: TrajectoryGoal) -> PackedTrajectory:
    """Return a trajectory with its points packed."""
    rows = array("d")
    for p in goal.points:
        rows.extend((p.t, p.x, p.y, p.phi, *(p.velocity or _NONE), *(p.acceleration or _NONE)))
    return PackedTrajectory(
        rows.tobytes(), goal.id, goal.stretch, goal.settle, goal.valid_for, goal.marks, goal.stop_at
    )


def joined(parts: Sequence[PackedTrajectory]) -> PackedTrajectory:
    """Return a trajectory from its parts in their order, whose options are those of the first.

    Raises ValueError where times do not rise from part to part.
    """
    goal = structs.replace(parts[0], rows=b"".join(part.rows for part in parts))
    check_times(array("d", goal.rows)[::COLUMNS])
    return goal


def _triple(values: Sequence[float]) -> Triple | None:
    a, b, c = values
    return None if math.isnan(a) else (a, b, c)
