"""Refusal of goals with an unknown pose name. The gateway replaces known names before the goal is planned."""

from __future__ import annotations

from typing import NoReturn

from trirail.errors import RefusalCode, RefusedError
from trirail.motion.goal_motion import GoalMotion, PoseSource
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.kinds.named import NamedGoal


class NamedMotion(GoalMotion[NamedGoal]):
    """Refusal of goals with an unknown pose name."""

    kind = NamedGoal

    @staticmethod
    def resolve(goal: NamedGoal, frames: NamedFrames, source: PoseSource) -> NoReturn:
        """Raise RefusedError, because the gateway has already replaced all goals that have a known pose name."""
        del frames, source
        text = f"no pose {goal.name!r}: `trirail poses` lists the saved poses"
        raise RefusedError(RefusalCode.UNKNOWN_POSE, text)
