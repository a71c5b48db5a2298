"""To positions of the sliders."""

from __future__ import annotations

from trirail.wire.goal_kind import Coordinates, GoalKind, Identifier, Speed, Validity


class SlidersGoal(GoalKind, frozen=True, tag="sliders"):
    """Move the sliders to positions, straight in slider space where the start allows."""

    position: Coordinates
    """lambda_10 of the sliders A, B, C [m]."""
    id: Identifier | None = None
    """As of a pose goal."""
    speed: Speed = 1.0
    """As of a pose goal."""
    valid_for: Validity | None = None
    """As of a pose goal [s]."""
