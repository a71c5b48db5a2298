"""Planning of jogs."""

from __future__ import annotations

import msgspec

from trirail.motion.goal_motion import GoalMotion, PoseSource
from trirail.motion.path_planner import Plan
from trirail.motion.runs import MotionState
from trirail.motion.tool_frames import NamedFrames, tool_point
from trirail.wire.kinds.velocity import VelocityGoal


class VelocityMotion(GoalMotion[VelocityGoal]):
    """Motion at a constant velocity, which ends at rest after the time-out."""

    kind = VelocityGoal

    @staticmethod
    def resolve(goal: VelocityGoal, frames: NamedFrames, source: PoseSource) -> VelocityGoal:
        """Return the goal with its tool as a point of the platform."""
        del source
        return msgspec.structs.replace(goal, tool=frames.tool(goal.tool))

    def check(self, goal: VelocityGoal) -> None:
        """Refuse velocities above the platform's limits. Raises RefusedError."""
        self._planner.check_velocity((goal.x, goal.y, goal.phi))

    def plan(self, goal: VelocityGoal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan a motion to the velocity, and then to rest."""
        del rate, begins
        velocity = goal.x, goal.y, goal.phi
        return self._planner.plan_jog(start, velocity, goal.timeout, tool_point(goal.tool))
