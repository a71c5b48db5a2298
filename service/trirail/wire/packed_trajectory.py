"""Trajectories as the service's processes exchange them: one row of numbers per point.

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
"""Columns t, x, y, phi, and their velocity and acceleration, NaN if a point has none."""
ROW = COLUMNS * array("d").itemsize
Row = tuple[float, Triple, Triple | None, Triple | None]
_NONE = (math.nan,) * 3


class PackedTrajectory(GoalKind, frozen=True, tag="packed trajectory"):
    """A trajectory goal with packed points; fields of the same name are as in TrajectoryGoal."""

    rows: bytes
    """Points as float64 in this machine's byte order, COLUMNS numbers per point."""
    id: str | None = None
    stretch: bool = False
    settle: bool = True
    valid_for: float | None = None
    marks: tuple[Mark, ...] = ()
    stop_at: StopAt | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if len(self.rows) % ROW or len(self.rows) < 2 * ROW:
            raise ValueError(f"rows: {len(self.rows)} bytes are not two or more points of {ROW} bytes")

    @property
    def lengthy(self) -> bool:
        """Whether it has more points than fit into one message."""
        return len(self.rows) > MAX_PART * ROW

    @property
    def points(self) -> Iterator[Row]:
        """Yield the points: time, pose, velocity and acceleration."""
        values = array("d", self.rows).tolist()
        for at in range(0, len(values), COLUMNS):
            t, x, y, phi, *derivatives = values[at : at + COLUMNS]
            yield t, (x, y, phi), _triple(derivatives[:3]), _triple(derivatives[3:])

    def unpacked(self) -> TrajectoryGoal:
        """Return the equivalent goal as a client sends it."""
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
    """Return a trajectory from its parts in order, with the options of the first part.

    Raises ValueError if the times do not increase from part to part.
    """
    goal = structs.replace(parts[0], rows=b"".join(part.rows for part in parts))
    check_times(array("d", goal.rows)[::COLUMNS])
    return goal


def _triple(values: Sequence[float]) -> Triple | None:
    a, b, c = values
    return None if math.isnan(a) else (a, b, c)
