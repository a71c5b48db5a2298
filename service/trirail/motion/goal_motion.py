"""What is asked of each kind of goal to plan it: what it means, whether that can be, and the path that leads there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, Generic, Literal, TypeVar

from trirail.motion.path_planner import PathPlanner, Plan
from trirail.motion.runs import MotionState
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.goal_kind import GoalKind

G = TypeVar("G", bound=GoalKind)
Place = Callable[[Literal["commanded", "measured"]], Sequence[float]]
"""The pose of the platform's centre from which a move begins."""


class GoalMotion(Generic[G]):
    """How one robot plans the goals of one kind; each has its own, in trirail.motion.kinds."""

    kind: ClassVar[type[GoalKind]]
    examples: ClassVar[tuple[GoalKind, ...]] = ()
    """Planned from the middle of the workspace before the first goal comes: what runs for the first time is slow."""

    def __init__(self, planner: PathPlanner) -> None:
        self._planner = planner

    @staticmethod
    def meant(goal: G, frames: NamedFrames, place: Place) -> GoalKind:
        """Return the goal that is planned, in the base frame. Raises RefusedError for names that there are not."""
        del frames, place
        return goal

    def check(self, goal: G) -> None:
        """Raise RefusedError for what can be reached from nowhere."""

    def plan(self, goal: G, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan from a state of motion, in which a path begins that is run at a rate, at the loop's time `begins` [s].

        Raises RefusedError where there is no path.
        """
        raise NotImplementedError(f"{type(goal).__name__} is planned in other words")
