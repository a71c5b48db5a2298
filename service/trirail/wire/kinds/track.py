"""Tracking of a moving target."""

from __future__ import annotations

from typing import Annotated, Self

from msgspec import Meta, structs
from trirail_drivers.interface import Triple

from trirail.wire.goal_kind import Clock, Coordinate, Coordinates, GoalKind, OwnId, ValidFor


class TrackGoal(GoalKind, frozen=True, tag="track"):
    """Follow a moving target that the client renews 10 to 200 times a second.

    The goal ends when `timeout` passes without a renewal of its id; the robot then brakes on its path. Between two
    messages the service extrapolates the target with its velocity. The platform follows a target that is too fast at
    its own limits, and waits at the border of the workspace for a target that is out of reach.
    """

    renewed = frequent = waits_at_end = timed = True
    greatest_rate = 1.0

    x: Coordinate
    """x of the target for the platform's centre at `time`, in the base frame [m]."""
    y: Coordinate
    """y of that target [m]."""
    phi: Coordinate
    """Angle of the target for the platform at `time`, counterclockwise [rad]."""
    velocity: Coordinates = (0.0, 0.0, 0.0)
    """Velocity of x, y and phi at `time` [m/s, m/s, rad/s]."""
    time: Clock | None = None
    """Time to which the target's pose applies, on the wall clock of the service's machine [s since 1970]. It may be at
    most half a second in the past or future, and defaults to the time of arrival. The clocks of two machines must agree
    to about a millisecond."""
    id: OwnId = None
    timeout: Annotated[float, Meta(ge=0.01, le=1.0)] = 0.25
    """Real time without a renewal after which the track brakes, at every override [s]."""
    valid_for: ValidFor = None

    @property
    def target(self) -> Triple:
        """Pose of the target."""
        return self.x, self.y, self.phi

    def at(self, time: float) -> Self:
        """Return a copy with another time [s]."""
        return structs.replace(self, time=time)
