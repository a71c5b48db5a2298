"""To a pose that has a name."""

from __future__ import annotations

from trirail.wire.goal_kind import Blend, GoalKind, GoalLimits, OwnId, PoseName, Speed, ValidFor
from trirail.wire.marks import Marks, StopAtEdge


class NamedGoal(GoalKind, frozen=True, tag="named"):
    """Move the platform to a pose that has a name: a pose goal, of the pose of that name when it comes in."""

    name: PoseName
    """One of those that are answered on …/poses."""
    id: OwnId = None
    speed: Speed = 1.0
    valid_for: ValidFor = None
    limits: GoalLimits = None
    blend: Blend = None
    marks: Marks = ()
    stop_at: StopAtEdge = None
