"""Planning of pose goals. From rest, the path is straight in pose space."""

from __future__ import annotations

import math

from msgspec import structs

from trirail.config import BASE, PLATFORM
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.goal_motion import GoalMotion, PoseSource
from trirail.motion.path_planner import Plan
from trirail.motion.ruckig_call import Kinodynamic
from trirail.motion.runs import MotionState
from trirail.motion.tool_frames import NamedFrames, rotated, tool_point
from trirail.wire.goals import PoseGoal


class PoseMotion(GoalMotion[PoseGoal]):
    """Planning of motions to a pose."""

    kind = PoseGoal
    examples = PoseGoal(0.02, 0.01, 0.1), PoseGoal(-0.01, 0.0, 0.0, blend=0.01)

    @staticmethod
    def resolve(goal: PoseGoal, frames: NamedFrames, source: PoseSource) -> PoseGoal:
        """Return the goal with its pose in the base frame, and with the tool as a point in the platform's frame.

        The angle of a pose in a work frame is between -pi and pi in the base frame.
        """
        del source
        if goal.frame == PLATFORM:
            raise RefusedError(
                RefusalCode.UNKNOWN_FRAME,
                "frame platform: a pose cannot be given in the platform's own frame; send a move in that frame",
            )
        x0, y0, turned = frames.frame(goal.frame)
        dx, dy = rotated(goal.x, goal.y, turned)
        phi = goal.phi if goal.frame == BASE else math.remainder(turned + goal.phi, math.tau)
        there = {"x": x0 + dx, "y": y0 + dy, "phi": phi}
        return structs.replace(goal, **there, tool=frames.tool(goal.tool), frame=BASE)

    def check(self, goal: PoseGoal) -> None:
        """Raise RefusedError if a limit that the goal requests is higher than the limit of the platform."""
        self._limits(goal)

    def plan(self, goal: PoseGoal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan a motion that ends at rest at the pose."""
        del rate, begins
        return self._planner.plan_to_pose(
            start, (goal.x, goal.y, goal.phi), goal.speed, self._limits(goal), tool_point(goal.tool)
        )

    def _limits(self, goal: PoseGoal) -> Kinodynamic | None:
        own = goal.limits
        return self._planner.lower_limits(own.velocity, own.acceleration, own.jerk) if own else None
