"""Planning of slider goals. From rest, the path is straight in slider space."""

from __future__ import annotations

from trirail.motion.goal_motion import GoalMotion
from trirail.motion.path_planner import Plan
from trirail.motion.runs import MotionState
from trirail.wire.kinds.sliders import SlidersGoal


class SlidersMotion(GoalMotion[SlidersGoal]):
    """Planning of motions to given slider positions."""

    kind = SlidersGoal
    examples = (SlidersGoal((0.01, 0.0, 0.0)),)

    def plan(self, goal: SlidersGoal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan a motion that ends at rest at the slider positions."""
        del rate, begins
        return self._planner.plan_to_sliders(start, goal.position, goal.speed)
