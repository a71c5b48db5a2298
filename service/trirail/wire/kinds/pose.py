"""Goal kind for moves to a pose."""

from __future__ import annotations

from trirail.wire.goal_kind import (
    Blend,
    Coordinate,
    GoalKind,
    GoalLimits,
    OwnId,
    PoseFrame,
    Speed,
    Tool,
    ToolPoint,
    ValidFor,
)
from trirail.wire.marks import Marks, StopAtEdge


class PoseGoal(GoalKind, frozen=True, tag="pose"):
    """Move the platform to a pose, on a straight line in pose space if the start allows this."""

    follows = True

    x: Coordinate
    """x of the platform's centre, or of its `tool`, in `frame` [m]."""
    y: Coordinate
    """y of the same point in `frame` [m]."""
    phi: Coordinate
    """Angle of the platform in `frame`, counterclockwise [rad]."""
    id: OwnId = None
    speed: Speed = 1.0
    valid_for: ValidFor = None
    limits: GoalLimits = None
    blend: Blend = None
    tool: ToolPoint = None
    frame: PoseFrame = "base"
    marks: Marks = ()
    stop_at: StopAtEdge = None


def pose_in_place_of(goal: GoalKind, x: float, y: float, phi: float, tool: Tool | None = None) -> PoseGoal:
    """Return a pose goal to a pose, with the id, speed, limits, marks and other common fields of `goal`."""
    same = {name: getattr(goal, name) for name in ("id", "speed", "valid_for", "limits", "blend", "marks", "stop_at")}
    return PoseGoal(x, y, phi, tool=tool, **same)
