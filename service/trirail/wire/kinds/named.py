"""Goal kind for moves to a named pose."""

from __future__ import annotations

from trirail.wire.goal_kind import Blend, GoalKind, GoalLimits, OwnId, PoseName, Speed, ValidFor
from trirail.wire.marks import Marks, StopAtEdge


class NamedGoal(GoalKind, frozen=True, tag="named"):
    """Move the platform to a named pose, like a pose goal. The service looks the name up when the message arrives."""

    name: PoseName
    """Name of a pose in the reply on …/poses."""
    id: OwnId = None
    speed: Speed = 1.0
    valid_for: ValidFor = None
    limits: GoalLimits = None
    blend: Blend = None
    marks: Marks = ()
    stop_at: StopAtEdge = None
