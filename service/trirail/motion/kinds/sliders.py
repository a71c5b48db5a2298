"""To positions of the sliders, straight in slider space where the start allows."""

from __future__ import annotations

from trirail.motion.goal_motion import GoalMotion
from trirail.motion.path_planner import Plan
from trirail.motion.runs import MotionState
from trirail.wire.kinds.sliders import SlidersGoal


class SlidersMotion(GoalMotion[SlidersGoal]):
    """A sliders goal's."""

    kind = SlidersGoal
    examples = (SlidersGoal((0.01, 0.0, 0.0)),)

    def check(self, goal: SlidersGoal) -> None:
        """Refuse positions beyond the sliders' travel."""
        self._planner.check_sliders(goal.position)

    def plan(self, goal: SlidersGoal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan to rest at the positions."""
        del rate, begins
        return self._planner.to_sliders(start, goal.position, goal.speed)
