"""By so much: a pose, relative to where the robot is or will be."""

from __future__ import annotations

from trirail.config import PLATFORM
from trirail.motion.goal_motion import GoalMotion, Place
from trirail.motion.runs import of_tool, rest
from trirail.motion.tool_frames import NamedFrames, rotated
from trirail.wire.kinds.move import MoveGoal
from trirail.wire.kinds.pose import PoseGoal, pose_in_place_of


class MoveMotion(GoalMotion[MoveGoal]):
    """A move's: that of a pose."""

    kind = MoveGoal

    @staticmethod
    def meant(goal: MoveGoal, frames: NamedFrames, place: Place) -> PoseGoal:
        """Return the pose to which it leads from a place."""
        tool = frames.tool(goal.tool)
        x, y, phi = of_tool(rest(place(goal.origin)), tool).pose
        turned = phi if goal.frame == PLATFORM else frames.frame(goal.frame)[2]
        dx, dy = rotated(goal.x, goal.y, turned)
        return pose_in_place_of(goal, x + dx, y + dy, phi + goal.phi, tool)
