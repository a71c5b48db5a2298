"""After a moving target."""

from __future__ import annotations

from typing import Annotated, Self

from msgspec import Meta, structs
from trirail_drivers.interface import Triple

from trirail.wire.goal_kind import Clock, Coordinate, Coordinates, GoalKind, OwnId, ValidFor


class TrackGoal(GoalKind, frozen=True, tag="track"):
    """Follow a moving target, renewed 10 to 200 times a second, until `timeout` passes without a fresh one of its id.

    Between two messages the target is taken to go on with its velocity. What is too fast is followed as fast as the
    limits allow; where the target is out of reach the platform waits at the border. Who does not renew it in time has
    the robot brake on its path.
    """

    renewed = frequent = waits_at_end = timed = True
    greatest_rate = 1.0

    x: Coordinate
    """Where the target is at `time`: there the platform's centre is to be, in the base frame [m]."""
    y: Coordinate
    """Likewise [m]."""
    phi: Coordinate
    """The angle that the platform is to have then, counterclockwise [rad]."""
    velocity: Coordinates = (0.0, 0.0, 0.0)
    """Of x, y and phi then [m/s, m/s, rad/s]."""
    time: Clock | None = None
    """When that is so, by the wall clock of the service's machine [s since 1970]: clocks of two machines must agree to
    a millisecond or so. At most half a second ago or ahead; without it, when the message comes."""
    id: OwnId = None
    timeout: Annotated[float, Meta(ge=0.01, le=1.0)] = 0.25
    """Real time, at every override, after which a track that is not renewed brakes [s]."""
    valid_for: ValidFor = None

    @property
    def target(self) -> Triple:
        """Where the target is said to be."""
        return self.x, self.y, self.phi

    def at(self, time: float) -> Self:
        """Return it with another time [s]."""
        return structs.replace(self, time=time)
