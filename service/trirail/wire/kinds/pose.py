"""To a pose."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from trirail.wire.goal_kind import Coordinate, FrameName, GoalKind, Identifier, OwnLimits, Speed, Tool, Validity


class PoseGoal(GoalKind, frozen=True, tag="pose"):
    """Move the platform to a pose, straight in pose space where the start allows."""

    follows = True

    x: Coordinate
    """Of the platform's centre, or of its `tool`, in the base frame or in `frame` [m]."""
    y: Coordinate
    """Likewise [m]."""
    phi: Coordinate
    """The platform's angle in that frame, counterclockwise [rad]."""
    id: Identifier | None = None
    """A new one for every goal; the service makes one where there is none."""
    speed: Speed = 1.0
    """Fraction of full speed: 0.5 takes twice as long over the same path."""
    valid_for: Validity | None = None
    """The goal expires unless it starts within so many seconds."""
    limits: OwnLimits | None = None
    """Lower ones than the platform's, for this goal alone; with a `tool` they are the tool's."""
    blend: Annotated[float, Meta(ge=0.0, le=1e3)] | None = None
    """The next pose or move waits for this one, and begins when no point of the platform is farther than that from
    where it is to be [m]; without it, the next goal preempts this one."""
    tool: Tool | None = None
    """The point that goes where x, y say, straight and within the platform's limits; the centre where there is none."""
    frame: FrameName = "base"
    """In which x, y and phi are given: base, or a frame of [frames.work]."""


def pose_in_place_of(goal: GoalKind, x: float, y: float, phi: float, tool: Tool | None = None) -> PoseGoal:
    """Return the pose that a goal means which says it in other words; all that they have in common is the same."""
    same = {name: getattr(goal, name) for name in ("id", "speed", "valid_for", "limits", "blend")}
    return PoseGoal(x, y, phi, tool=tool, **same)
