"""Tracking of a moving target."""

from __future__ import annotations

from typing import Annotated, Self

from msgspec import Meta, structs
from trirail_drivers.interface import Triple

from trirail.wire.goal_kind import Clock, Coordinate, Coordinates, GoalKind, OwnId, ValidFor


class TrackGoal(GoalKind, frozen=True, tag="track"):
    """Follow a moving target, renewed 10 to 200 times a second, until `timeout` passes without a renewal of its id.

    Between two messages the target is extrapolated with its velocity. The platform follows a target that is too fast at
    its limits, and waits at the border of the workspace for one that is out of reach. Without a renewal in time, the
    robot brakes on its path.
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
    """Time of the target's pose, by the wall clock of the service's machine [s since 1970]; at most half a second in
    the past or future; the time of arrival if absent. The clocks of two machines must agree to about a millisecond."""
    id: OwnId = None
    timeout: Annotated[float, Meta(ge=0.01, le=1.0)] = 0.25
    """Real time, at every override, after which a track that is not renewed brakes [s]."""
    valid_for: ValidFor = None

    @property
    def target(self) -> Triple:
        """Pose of the target."""
        return self.x, self.y, self.phi

    def at(self, time: float) -> Self:
        """Return a copy with another time [s]."""
        return structs.replace(self, time=time)
