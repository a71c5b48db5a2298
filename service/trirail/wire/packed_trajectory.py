"""Trajectories in the form in which the service's processes exchange them, with one row of numbers for each point.

The loop must not spend time on decoding thousands of points. Decoding 5,000 points takes 15 ms if they are structs, and
0.1 ms if they are bytes.
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
"""Number of columns: t, x, y, phi, and the velocity and acceleration of x, y and phi, which are NaN if missing."""
ROW = COLUMNS * array("d").itemsize
Row = tuple[float, Triple, Triple | None, Triple | None]
_NONE = (math.nan,) * 3


class PackedTrajectory(GoalKind, frozen=True, tag="packed trajectory"):
    """Trajectory goal with packed points. The other fields are those of TrajectoryGoal."""

    rows: bytes
    """Points as float64 in this machine's byte order, with COLUMNS numbers for each point."""
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
        """True if the goal has more points than one message may contain."""
        return len(self.rows) > MAX_PART * ROW

    @property
    def points(self) -> Iterator[Row]:
        """Yield time, pose, velocity and acceleration of each point."""
        values = array("d", self.rows).tolist()
        for at in range(0, len(values), COLUMNS):
            t, x, y, phi, *derivatives = values[at : at + COLUMNS]
            yield t, (x, y, phi), _triple(derivatives[:3]), _triple(derivatives[3:])

    def unpacked(self) -> TrajectoryGoal:
        """Return the equivalent goal in the form in which a client sends it."""
        points = tuple(TrajectoryPoint(t, *pose, *derivatives) for t, pose, *derivatives in self.points)
        return TrajectoryGoal(
            points, self.id, self.stretch, self.settle, self.valid_for, marks=self.marks, stop_at=self.stop_at
        )


def packed(goal: TrajectoryGoal) -> PackedTrajectory:
    """Return a copy of a trajectory goal with packed points."""
    rows = array("d")
    for p in goal.points:
        rows.extend((p.t, p.x, p.y, p.phi, *(p.velocity or _NONE), *(p.acceleration or _NONE)))
    return PackedTrajectory(
        rows.tobytes(), goal.id, goal.stretch, goal.settle, goal.valid_for, goal.marks, goal.stop_at
    )


def joined(parts: Sequence[PackedTrajectory]) -> PackedTrajectory:
    """Join the parts of a trajectory, given in order; the result has the options of the first part.

    Raises ValueError if the times do not increase from part to part, or if the trajectory lasts too long.
    """
    goal = structs.replace(parts[0], rows=b"".join(part.rows for part in parts))
    check_times(array("d", goal.rows)[::COLUMNS])
    return goal


def _triple(values: Sequence[float]) -> Triple | None:
    a, b, c = values
    return None if math.isnan(a) else (a, b, c)
