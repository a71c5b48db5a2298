"""To a pose that has a name: the gateway, who knows them, has put the pose in its place."""

from __future__ import annotations

from typing import NoReturn

from trirail.errors import RefusalCode, RefusedError
from trirail.motion.goal_motion import GoalMotion, Place
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.kinds.named import NamedGoal


class NamedMotion(GoalMotion[NamedGoal]):
    """That of a name that no pose has."""

    kind = NamedGoal

    @staticmethod
    def meant(goal: NamedGoal, frames: NamedFrames, place: Place) -> NoReturn:
        """Refuse what still has no pose here."""
        del frames, place
        text = f"no pose {goal.name!r}: `trirail poses` lists those that there are"
        raise RefusedError(RefusalCode.UNKNOWN_POSE, text)
