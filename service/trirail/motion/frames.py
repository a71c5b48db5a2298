"""What goals mean that name tools and frames, or say by how much to move: poses of a point, in the base frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

from msgspec import structs
from trirail_drivers.interface import Triple

from trirail.config import BASE, PLATFORM, FramesTable
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.runs import NO_TOOL, of_tool, rest
from trirail.wire.goals import (
    Goal,
    MoveGoal,
    NamedGoal,
    PlannedGoal,
    PoseGoal,
    SlidersGoal,
    Tool,
    TrackGoal,
    TrajectoryGoal,
    VelocityGoal,
)

Place = Callable[[Literal["commanded", "measured"]], Sequence[float]]
"""The pose of the platform's centre from which a move begins."""


class NamedFrames:
    """The tools and work frames of one robot."""

    def __init__(self, table: FramesTable) -> None:
        self._table = table

    def planned(self, goal: Goal, place: Place) -> PlannedGoal:
        """Return the goal that the planner is to be asked for. Raises RefusedError for a name that there is not."""
        match goal:
            case PoseGoal():
                return self._pose(goal)
            case MoveGoal():
                return self._move(goal, place)
            case NamedGoal(name=name):  # what there is has a pose in its place when it comes here
                raise RefusedError(
                    RefusalCode.UNKNOWN_POSE, f"no pose {name!r}: `trirail poses` lists those that there are"
                )
            case SlidersGoal() | VelocityGoal() | TrackGoal() | TrajectoryGoal():
                return goal

    def _pose(self, goal: PoseGoal) -> PoseGoal:
        """Return a pose in the base frame."""
        if goal.frame == PLATFORM:
            raise RefusedError(
                RefusalCode.UNKNOWN_FRAME, "a pose in the platform's own frame is no place: send a move in that frame"
            )
        x0, y0, turned = self._frame(goal.frame)
        dx, dy = rotated(goal.x, goal.y, turned)
        there = {"x": x0 + dx, "y": y0 + dy, "phi": turned + goal.phi}
        return structs.replace(goal, **there, tool=self._tool(goal.tool), frame=BASE)

    def _move(self, goal: MoveGoal, place: Place) -> PoseGoal:
        """Return the pose to which a move leads from a place."""
        tool = self._tool(goal.tool)
        x, y, phi = of_tool(rest(place(goal.origin)), tool).pose
        turned = phi if goal.frame == PLATFORM else self._frame(goal.frame)[2]
        dx, dy = rotated(goal.x, goal.y, turned)
        same = {name: getattr(goal, name) for name in ("id", "speed", "valid_for", "limits", "blend")}
        return PoseGoal(x + dx, y + dy, phi + goal.phi, tool=tool, **same)

    def _frame(self, name: str) -> Triple:
        """Return a frame, x, y [m] and angle [rad] in the base frame."""
        if name == BASE:
            return 0.0, 0.0, 0.0
        found = self._table.work.get(name)
        if found is None:
            raise unknown("frame", name, (BASE, *self._table.work))
        return found

    def _tool(self, tool: Tool | None) -> tuple[float, float]:
        """Return a point of the platform in its own frame [m]."""
        if not isinstance(tool, str):
            return tool or NO_TOOL
        found = self._table.tool.get(tool)
        if found is None:
            raise unknown("tool", tool, tuple(self._table.tool))
        return found


def rotated(x: float, y: float, angle: float) -> tuple[float, float]:
    """Return a vector, turned counterclockwise [rad]."""
    if angle == 0.0:
        return x, y
    c, s = math.cos(angle), math.sin(angle)
    return c * x - s * y, s * x + c * y


def unknown(what: str, name: str, known: Sequence[str]) -> RefusedError:
    """Say that there is no such tool or frame, and which ones there are."""
    there_are = f"there is {', '.join(known)}" if known else "there is none in [frames.tool]: give a point, [u, v]"
    return RefusedError(RefusalCode.UNKNOWN_FRAME, f"no {what} {name!r}: {there_are}")
