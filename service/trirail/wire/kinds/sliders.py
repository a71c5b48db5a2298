"""Goal kind for moves to slider positions."""

from __future__ import annotations

from trirail.wire.goal_kind import Coordinates, GoalKind, OwnId, Speed, ValidFor
from trirail.wire.marks import Marks, StopAtEdge


class SlidersGoal(GoalKind, frozen=True, tag="sliders"):
    """Move the sliders to positions, on a straight line in slider space if the start allows this."""

    position: Coordinates
    """Target positions lambda_10 of the sliders A, B, C [m]."""
    id: OwnId = None
    speed: Speed = 1.0
    valid_for: ValidFor = None
    marks: Marks = ()
    stop_at: StopAtEdge = None
