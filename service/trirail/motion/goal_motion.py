"""Interface between kinds of goals and the planner: resolve names and frames, check the request, and plan the path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, Generic, Literal, TypeVar

from trirail.motion.path_planner import PathPlanner, Plan
from trirail.motion.runs import MotionState
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.goal_kind import GoalKind

G = TypeVar("G", bound=GoalKind)
PoseSource = Callable[[Literal["commanded", "measured"]], Sequence[float]]
"""Function that returns the pose of the platform's centre from which a relative move is counted."""


class GoalMotion(Generic[G]):
    """Planning of the goals of one kind. The subclasses are in trirail.motion.kinds."""

    kind: ClassVar[type[GoalKind]]
    examples: ClassVar[tuple[GoalKind, ...]] = ()
    """Goals that the warm-up plans from the middle of the workspace, because the first plan of a kind is slow."""

    def __init__(self, planner: PathPlanner) -> None:
        self._planner = planner

    @staticmethod
    def resolve(goal: G, frames: NamedFrames, source: PoseSource) -> GoalKind:
        """Return the goal in the base frame, with names replaced by their values.

        Raises
        ------
        RefusedError
            A tool, frame or pose has an unknown name.
        """
        del frames, source
        return goal

    def check(self, goal: G) -> None:
        """Raise RefusedError if the goal cannot be reached from any start."""

    def plan(self, goal: G, start: MotionState, rate: float, begins: float) -> Plan:
        """Return a path to the goal.

        Parameters
        ----------
        goal : G
            Goal that has been resolved.
        start : MotionState
            State of the platform's centre at the start of the path.
        rate : float
            Rate at which time runs along the path.
        begins : float
            Loop time at which the path begins [s].

        Raises
        ------
        RefusedError
            No path leads to the goal.
        """
        raise NotImplementedError(f"{type(goal).__name__} is resolved to another kind of goal")
