"""Planning of relative moves."""

from __future__ import annotations

from trirail.config import PLATFORM
from trirail.motion.goal_motion import GoalMotion, PoseSource
from trirail.motion.runs import rest, tool_motion
from trirail.motion.tool_frames import NamedFrames, rotated
from trirail.wire.kinds.move import MoveGoal
from trirail.wire.kinds.pose import PoseGoal, pose_in_place_of


class MoveMotion(GoalMotion[MoveGoal]):
    """Planning of relative moves, which are converted to pose goals."""

    kind = MoveGoal

    @staticmethod
    def resolve(goal: MoveGoal, frames: NamedFrames, source: PoseSource) -> PoseGoal:
        """Return a pose goal with the target of the move, which begins at the pose that `source` returns."""
        tool = frames.tool(goal.tool)
        x, y, phi = tool_motion(rest(source(goal.origin)), tool).pose
        turned = phi if goal.frame == PLATFORM else frames.frame(goal.frame)[2]
        dx, dy = rotated(goal.x, goal.y, turned)
        return pose_in_place_of(goal, x + dx, y + dy, phi + goal.phi, tool)
