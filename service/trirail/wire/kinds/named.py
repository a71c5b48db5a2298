"""Moves to a named pose."""

from __future__ import annotations

from trirail.wire.goal_kind import Blend, GoalKind, GoalLimits, OwnId, PoseName, Speed, ValidFor
from trirail.wire.marks import Marks, StopAtEdge


class NamedGoal(GoalKind, frozen=True, tag="named"):
    """Move the platform to the pose that has this name when the message arrives; otherwise like a pose goal."""

    name: PoseName
    """Name of a pose in the reply on …/poses."""
    id: OwnId = None
    speed: Speed = 1.0
    valid_for: ValidFor = None
    limits: GoalLimits = None
    blend: Blend = None
    marks: Marks = ()
    stop_at: StopAtEdge = None
