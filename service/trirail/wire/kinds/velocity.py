"""At a velocity, for as long as that is renewed."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.goal_kind import Coordinate, GoalKind, OwnId, ToolPoint, ValidFor


class VelocityGoal(GoalKind, frozen=True, tag="velocity"):
    """Jog: move at a velocity [m/s, rad/s] until `timeout` passes without a fresh one of the same id."""

    renewed = True

    x: Coordinate
    """Velocity of the platform's centre, or of its `tool`, along x of the base frame [m/s]."""
    y: Coordinate
    """Along y [m/s]."""
    phi: Coordinate
    """Rate of the platform's angle, counterclockwise, about that point [rad/s]."""
    id: OwnId = None
    timeout: Annotated[float, Meta(ge=0.01, le=10.0)] = 0.1
    """Real time, at every override, after which a jog that is not renewed brakes [s]."""
    valid_for: ValidFor = None
    tool: ToolPoint = None

    def check_beginning(self) -> None:
        """Raise RefusedError for a jog that would begin at rest."""
        if not any((self.x, self.y, self.phi)):
            text = "a jog of no velocity moves nothing: give it one along x, y or phi"
            raise RefusedError(RefusalCode.NO_VELOCITY, text)
