"""Planning of jogs."""

from __future__ import annotations

import msgspec

from trirail.motion.goal_motion import GoalMotion, PoseSource
from trirail.motion.path_planner import Plan
from trirail.motion.runs import MotionState
from trirail.motion.tool_frames import NamedFrames, tool_point
from trirail.wire.kinds.velocity import VelocityGoal


class VelocityMotion(GoalMotion[VelocityGoal]):
    """Planning of jogs, which are motions at a constant velocity that end at rest."""

    kind = VelocityGoal

    @staticmethod
    def resolve(goal: VelocityGoal, frames: NamedFrames, source: PoseSource) -> VelocityGoal:
        """Return the goal with the tool as a point in the platform's frame."""
        del source
        return msgspec.structs.replace(goal, tool=frames.tool(goal.tool))

    def check(self, goal: VelocityGoal) -> None:
        """Raise RefusedError if the velocity exceeds the limits of the platform."""
        self._planner.check_velocity((goal.x, goal.y, goal.phi))

    def plan(self, goal: VelocityGoal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan a motion that accelerates to the velocity, and later brakes to rest."""
        del rate, begins
        velocity = goal.x, goal.y, goal.phi
        return self._planner.plan_jog(start, velocity, goal.timeout, tool_point(goal.tool))
