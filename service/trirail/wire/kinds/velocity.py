"""Goal kind for jogs, which move the robot at a velocity for as long as the client renews the goal."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.goal_kind import Coordinate, GoalKind, OwnId, ToolPoint, ValidFor


class VelocityGoal(GoalKind, frozen=True, tag="velocity"):
    """Move at a velocity [m/s, rad/s] until `timeout` passes without a renewal with the same id."""

    renewed = True

    x: Coordinate
    """Velocity of the platform's centre, or of its `tool`, along x of the base frame [m/s]."""
    y: Coordinate
    """Velocity of the same point along y of the base frame [m/s]."""
    phi: Coordinate
    """Angular velocity of the platform about the same point, counterclockwise [rad/s]."""
    id: OwnId = None
    timeout: Annotated[float, Meta(ge=0.01, le=10.0)] = 0.1
    """Time without a renewal after which the robot brakes [s]. It is real time, independent of the override."""
    valid_for: ValidFor = None
    tool: ToolPoint = None

    def check_beginning(self) -> None:
        """Raise RefusedError if the velocity is zero."""
        if not any((self.x, self.y, self.phi)):
            text = "jog: the velocity is zero; give a velocity in x, y or phi"
            raise RefusedError(RefusalCode.NO_VELOCITY, text)
