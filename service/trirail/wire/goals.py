"""Goals as clients send them, of every kind in trirail.wire.kinds. SI units and radians."""

from __future__ import annotations

from typing import TYPE_CHECKING, Union

from trirail.wire import kinds
from trirail.wire.goal_kind import Coordinates, GoalKind, OwnLimits, Tool, import_all
from trirail.wire.kinds.move import MoveGoal
from trirail.wire.kinds.named import NamedGoal
from trirail.wire.kinds.pose import PoseGoal
from trirail.wire.kinds.sliders import SlidersGoal
from trirail.wire.kinds.track import TrackGoal
from trirail.wire.kinds.trajectory import SHORTEST_PIECE, TrajectoryGoal, TrajectoryPoint
from trirail.wire.kinds.velocity import VelocityGoal

__all__ = [
    "SHORTEST_PIECE",
    "Coordinates",
    "Goal",
    "MoveGoal",
    "NamedGoal",
    "OwnLimits",
    "PoseGoal",
    "SlidersGoal",
    "Tool",
    "TrackGoal",
    "TrajectoryGoal",
    "TrajectoryPoint",
    "VelocityGoal",
]

import_all(kinds)
KINDS: tuple[type[GoalKind], ...] = tuple(sorted(GoalKind.__subclasses__(), key=lambda kind: kind.__module__))
"""All that there are: a kind is whatever has a file in trirail.wire.kinds."""

if TYPE_CHECKING:
    Goal = GoalKind
else:
    Goal = Union[KINDS]  # noqa: UP007 - of as many as there are
