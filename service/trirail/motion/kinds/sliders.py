"""Planning of slider goals: straight in slider space from rest."""

from __future__ import annotations

from trirail.motion.goal_motion import GoalMotion
from trirail.motion.path_planner import Plan
from trirail.motion.runs import MotionState
from trirail.wire.kinds.sliders import SlidersGoal


class SlidersMotion(GoalMotion[SlidersGoal]):
    """Motion to positions of the sliders."""

    kind = SlidersGoal
    examples = (SlidersGoal((0.01, 0.0, 0.0)),)

    def plan(self, goal: SlidersGoal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan to rest at the positions."""
        del rate, begins
        return self._planner.plan_to_sliders(start, goal.position, goal.speed)
