"""Along timed points, quintic between them."""

from __future__ import annotations

from trirail.motion.goal_motion import GoalMotion
from trirail.motion.path_planner import Plan
from trirail.motion.quintic import Point
from trirail.motion.runs import MotionState
from trirail.wire.kinds.trajectory import TrajectoryGoal


class TrajectoryMotion(GoalMotion[TrajectoryGoal]):
    """A trajectory's."""

    kind = TrajectoryGoal

    def plan(self, goal: TrajectoryGoal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan through the points."""
        del rate, begins
        points = [Point(p.t, (p.x, p.y, p.phi), p.velocity, p.acceleration) for p in goal.points]
        return self._planner.follow(start, points, goal.stretch)
