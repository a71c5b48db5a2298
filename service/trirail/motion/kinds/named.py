"""Refusal of goals with an unknown pose name. The gateway keeps the named poses."""

from __future__ import annotations

from typing import NoReturn

from trirail.errors import RefusalCode, RefusedError
from trirail.motion.goal_motion import GoalMotion, PoseSource
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.kinds.named import NamedGoal


class NamedMotion(GoalMotion[NamedGoal]):
    """Goal with an unknown pose name."""

    kind = NamedGoal

    @staticmethod
    def resolve(goal: NamedGoal, frames: NamedFrames, source: PoseSource) -> NoReturn:
        """Refuse the goal, because the gateway has already replaced every known name by its pose."""
        del frames, source
        text = f"no pose {goal.name!r}: `trirail poses` lists the saved poses"
        raise RefusedError(RefusalCode.UNKNOWN_POSE, text)
