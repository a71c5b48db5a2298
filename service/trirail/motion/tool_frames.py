"""What the names of tools and frames mean."""

from __future__ import annotations

import math
from collections.abc import Sequence

from trirail_drivers.interface import Triple

from trirail.config import BASE, FramesTable
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.runs import NO_TOOL
from trirail.wire.goals import Tool


class NamedFrames:
    """The tools and work frames of one robot."""

    def __init__(self, table: FramesTable) -> None:
        self._table = table

    def frame(self, name: str) -> Triple:
        """Return a frame, x, y [m] and angle [rad] in the base frame."""
        if name == BASE:
            return 0.0, 0.0, 0.0
        found = self._table.work.get(name)
        if found is None:
            raise unknown("frame", name, (BASE, *self._table.work))
        return found

    def tool(self, tool: Tool | None) -> tuple[float, float]:
        """Return a point of the platform in its own frame [m]."""
        if not isinstance(tool, str):
            return tool or NO_TOOL
        found = self._table.tool.get(tool)
        if found is None:
            raise unknown("tool", tool, tuple(self._table.tool))
        return found


def point(tool: Tool | None) -> tuple[float, float]:
    """Return the point of the platform that a planned goal is of: its name is known where the goal came in."""
    if isinstance(tool, str):
        raise TypeError(f"tool {tool!r} of a planned goal is no point")
    return tool or NO_TOOL


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
