"""To a pose that has a name."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from trirail.wire.goal_kind import GoalKind, Identifier, OwnLimits, PoseName, Speed, Validity


class NamedGoal(GoalKind, frozen=True, tag="named"):
    """Move the platform to a pose that has a name: a pose goal, of the pose of that name when it comes in."""

    name: PoseName
    """One of those that are answered on …/poses."""
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
