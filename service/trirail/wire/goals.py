"""Goals of all kinds that clients can send, from the modules in trirail.wire.kinds, in SI units and radians."""

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
from trirail.wire.packed_trajectory import PackedTrajectory

__all__ = [
    "SHORTEST_PIECE",
    "Coordinates",
    "Goal",
    "LoopGoal",
    "MoveGoal",
    "NamedGoal",
    "OwnLimits",
    "PathGoal",
    "PoseGoal",
    "SlidersGoal",
    "Tool",
    "TrackGoal",
    "TrajectoryGoal",
    "TrajectoryPoint",
    "VelocityGoal",
    "kind_name",
]

import_all(kinds)
KINDS: tuple[type[GoalKind], ...] = tuple(
    sorted(set(GoalKind.__subclasses__()) - {PackedTrajectory}, key=lambda kind: kind.__module__)
)
"""Classes of all goal kinds; each module in trirail.wire.kinds contains one class."""

if TYPE_CHECKING:
    Goal = GoalKind
    PathGoal = GoalKind
    LoopGoal = GoalKind
else:
    Goal = Union[KINDS]  # noqa: UP007 - from a tuple of types
    PathGoal = Union[tuple(kind for kind in KINDS if not kind.renewed)]  # noqa: UP007 - as above
    LoopGoal = Union[(*KINDS, PackedTrajectory)]
"""Unions of goals. `Goal` is any goal that a client can send. `PathGoal` is a goal with a path that is completely
known when the goal arrives. `LoopGoal` is any goal in the form that the gateway, loop, planner and recordings use."""


def kind_name(goal: GoalKind) -> str:
    """Return the name of a goal's kind, for people."""
    kind = TrajectoryGoal if isinstance(goal, PackedTrajectory) else type(goal)
    return kind.__name__.removesuffix("Goal").lower()
