"""At a velocity, and to rest when its time-out is over."""

from __future__ import annotations

from trirail.motion.goal_motion import GoalMotion
from trirail.motion.path_planner import Plan
from trirail.motion.runs import MotionState
from trirail.wire.kinds.velocity import VelocityGoal


class VelocityMotion(GoalMotion[VelocityGoal]):
    """A jog's."""

    kind = VelocityGoal

    def check(self, goal: VelocityGoal) -> None:
        """Refuse velocities above the platform's limits."""
        self._planner.check_velocity((goal.x, goal.y, goal.phi))

    def plan(self, goal: VelocityGoal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan to the velocity, and to rest."""
        del rate, begins
        return self._planner.jog(start, (goal.x, goal.y, goal.phi), goal.timeout)
