"""Interface that each kind of goal implements for the planner: resolve names, check the goal, and plan its path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, Generic, Literal, TypeVar

from trirail.motion.path_planner import PathPlanner, Plan
from trirail.motion.runs import MotionState
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.goal_kind import GoalKind

G = TypeVar("G", bound=GoalKind)
PoseSource = Callable[[Literal["commanded", "measured"]], Sequence[float]]
"""Function that returns the commanded or the measured pose of the platform's centre, from which a relative move
starts."""


class GoalMotion(Generic[G]):
    """Planning of the goals of one kind. The subclasses are in trirail.motion.kinds."""

    kind: ClassVar[type[GoalKind]]
    examples: ClassVar[tuple[GoalKind, ...]] = ()
    """Goals that are planned once when the planner starts, because the first plan of each kind is slow."""

    def __init__(self, planner: PathPlanner) -> None:
        self._planner = planner

    @staticmethod
    def resolve(goal: G, frames: NamedFrames, source: PoseSource) -> GoalKind:
        """Return the goal with its pose in the base frame, and with the values of named tools, frames and poses.

        Raises
        ------
        RefusedError
            A tool, frame or pose has an unknown name.
        """
        del frames, source
        return goal

    def check(self, goal: G) -> None:
        """Raise RefusedError if the goal is impossible, independently of the start of the motion."""

    def plan(self, goal: G, start: MotionState, rate: float, begins: float) -> Plan:
        """Return a path to the goal.

        Parameters
        ----------
        goal : G
            Goal that has been resolved.
        start : MotionState
            State of the platform's centre at the start of the path.
        rate : float
            Rate of the time along the path, relative to real time.
        begins : float
            Time of the schedule at which the path begins [s].

        Raises
        ------
        RefusedError
            No path leads to the goal.
        """
        raise NotImplementedError(f"{type(goal).__name__} has no path itself: plan the goal that resolve returns")
