"""At a velocity, and to rest when its time-out is over."""

from __future__ import annotations

import msgspec

from trirail.motion.goal_motion import GoalMotion, Place
from trirail.motion.path_planner import Plan
from trirail.motion.runs import MotionState
from trirail.motion.tool_frames import NamedFrames, point
from trirail.wire.kinds.velocity import VelocityGoal


class VelocityMotion(GoalMotion[VelocityGoal]):
    """A jog's."""

    kind = VelocityGoal

    @staticmethod
    def meant(goal: VelocityGoal, frames: NamedFrames, place: Place) -> VelocityGoal:
        """Return the jog of a point of the platform."""
        del place
        return msgspec.structs.replace(goal, tool=frames.tool(goal.tool))

    def check(self, goal: VelocityGoal) -> None:
        """Refuse velocities above the platform's limits."""
        self._planner.check_velocity((goal.x, goal.y, goal.phi))

    def plan(self, goal: VelocityGoal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan to the velocity, and to rest."""
        del rate, begins
        velocity = goal.x, goal.y, goal.phi
        return self._planner.jog(start, velocity, goal.timeout, point(goal.tool))
