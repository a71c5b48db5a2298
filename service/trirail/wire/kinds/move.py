"""By so much, from where the robot is or will be."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from trirail.wire.goal_kind import Coordinate, FrameName, GoalKind, Identifier, OwnLimits, Speed, Tool, Validity


class MoveGoal(GoalKind, frozen=True, tag="move", rename={"origin": "from"}):
    """Move the platform by so much: a pose goal, relative to where its tool is."""

    follows = True

    x: Coordinate
    """How far its tool, or its centre, is to go along x of `frame` [m]."""
    y: Coordinate
    """Along y [m]."""
    phi: Coordinate
    """By what angle the platform is to turn about that point, counterclockwise [rad]."""
    frame: FrameName = "base"
    """Along whose axes: those of base, of the platform as it is then, or of a frame of [frames.work]."""
    tool: Tool | None = None
    """As of a pose goal."""
    origin: Literal["commanded", "measured"] = "commanded"
    """From which pose: "commanded" is where the goals before it lead, and where the robot is commanded to be without
    one or in a jog, so that moves add up whenever they come; "measured" is where it is measured to be when they have
    been planned."""
    id: Identifier | None = None
    """As of a pose goal."""
    speed: Speed = 1.0
    """As of a pose goal."""
    valid_for: Validity | None = None
    """As of a pose goal [s]."""
    limits: OwnLimits | None = None
    """As of a pose goal."""
    blend: Annotated[float, Meta(ge=0.0, le=1e3)] | None = None
    """As of a pose goal [m]."""
