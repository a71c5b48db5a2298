"""Moves relative to the robot's pose."""

from __future__ import annotations

from typing import Literal

from trirail.wire.goal_kind import AxesFrame, Blend, Coordinate, GoalKind, GoalLimits, OwnId, Speed, ToolPoint, ValidFor
from trirail.wire.marks import Marks, StopAtEdge


class MoveGoal(GoalKind, frozen=True, tag="move", rename={"origin": "from"}):
    """Move the platform by a displacement of its tool and a rotation about the tool."""

    follows = True

    x: Coordinate
    """Displacement of the tool, or of the platform's centre, along x of `frame` [m]."""
    y: Coordinate
    """Displacement of the same point along y of `frame` [m]."""
    phi: Coordinate
    """Rotation of the platform about the same point, counterclockwise [rad]."""
    frame: AxesFrame = "base"
    tool: ToolPoint = None
    origin: Literal["commanded", "measured"] = "commanded"
    """Start of the move. "commanded" is the end of the preceding goals, so that moves add up no matter how fast they
    are sent. If there are no preceding goals, or during a jog, "commanded" is the commanded pose. "measured" is the
    measured pose after the preceding goals have been planned."""
    id: OwnId = None
    speed: Speed = 1.0
    valid_for: ValidFor = None
    limits: GoalLimits = None
    blend: Blend = None
    marks: Marks = ()
    stop_at: StopAtEdge = None
