"""By so much, from where the robot is or will be."""

from __future__ import annotations

from typing import Literal

from trirail.wire.goal_kind import AxesFrame, Blend, Coordinate, GoalKind, GoalLimits, OwnId, Speed, ToolPoint, ValidFor
from trirail.wire.marks import Marks, StopAtEdge


class MoveGoal(GoalKind, frozen=True, tag="move", rename={"origin": "from"}):
    """Move the platform by so much: a pose goal, relative to where its tool is."""

    follows = True

    x: Coordinate
    """How far its tool, or its centre, is to go along x of `frame` [m]."""
    y: Coordinate
    """Along y [m]."""
    phi: Coordinate
    """By what angle the platform is to turn about that point, counterclockwise [rad]."""
    frame: AxesFrame = "base"
    tool: ToolPoint = None
    origin: Literal["commanded", "measured"] = "commanded"
    """From which pose: "commanded" is where the goals before it lead, and where the robot is commanded to be without
    one or in a jog, so that moves add up whenever they come; "measured" is where it is measured to be when they have
    been planned."""
    id: OwnId = None
    speed: Speed = 1.0
    valid_for: ValidFor = None
    limits: GoalLimits = None
    blend: Blend = None
    marks: Marks = ()
    stop_at: StopAtEdge = None
