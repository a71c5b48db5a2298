"""Goal kind for following a moving target."""

from __future__ import annotations

from typing import Annotated, Self

from msgspec import Meta, structs
from trirail_drivers.interface import Triple

from trirail.wire.goal_kind import Clock, Coordinate, Coordinates, GoalKind, OwnId, ValidFor


class TrackGoal(GoalKind, frozen=True, tag="track"):
    """Follow a moving target; the client sends the target's pose 10 to 200 times a second.

    The goal ends when `timeout` passes without a renewal with the same id. The robot then brakes on its path. Between
    two messages, the service extrapolates the target's pose with the target's velocity. If the target is too fast, the
    platform follows it as fast as the platform's limits allow. If the target is out of reach, the platform waits at the
    border of the workspace.
    """

    renewed = frequent = waits_at_end = timed = True

    x: Coordinate
    """Target x of the platform's centre at `time`, in the base frame [m]."""
    y: Coordinate
    """Target y of the platform's centre at `time`, in the base frame [m]."""
    phi: Coordinate
    """Target angle of the platform at `time`, counterclockwise [rad]."""
    velocity: Coordinates = (0.0, 0.0, 0.0)
    """Velocity of the target's x, y and phi at `time` [m/s, m/s, rad/s]."""
    time: Clock | None = None
    """Time at which the target has this pose, on the wall clock of the service's machine [s since 1970]. The time may
    be at most half a second in the past or future, and defaults to the time of arrival. The clocks of the client's and
    the service's machine must agree to about a millisecond."""
    id: OwnId = None
    timeout: Annotated[float, Meta(ge=0.01, le=1.0)] = 0.25
    """Time without a renewal after which the robot brakes [s]. It is real time, independent of the override."""
    valid_for: ValidFor = None

    @property
    def greatest_rate(self) -> float:
        """Maximum rate of the motion, whose timing is that of the target."""
        return 1.0

    @property
    def target(self) -> Triple:
        """Pose of the target: x, y [m], phi [rad]."""
        return self.x, self.y, self.phi

    def at(self, time: float) -> Self:
        """Return a copy with another `time` [s]."""
        return structs.replace(self, time=time)
