"""Conversion of the names of tools and work frames in goals to coordinates."""

from __future__ import annotations

import math
from collections.abc import Sequence

from trirail_drivers.interface import Triple

from trirail.config import BASE, FramesTable
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.runs import NO_TOOL
from trirail.wire.goals import Tool


class NamedFrames:
    """Named tools and work frames from the configuration of one robot."""

    def __init__(self, table: FramesTable) -> None:
        self._table = table

    def frame(self, name: str) -> Triple:
        """Return the pose of a frame, x, y [m] and angle [rad], in the base frame. Raises RefusedError if unknown."""
        if name == BASE:
            return 0.0, 0.0, 0.0
        entry = self._table.work.get(name)
        if entry is None:
            raise unknown_name("frame", name, (BASE, *self._table.work))
        return entry

    def tool(self, tool: Tool | None) -> tuple[float, float]:
        """Return the position of a tool in the platform's frame [m]. Raises RefusedError if the name is unknown."""
        if not isinstance(tool, str):
            return tool or NO_TOOL
        entry = self._table.tool.get(tool)
        if entry is None:
            raise unknown_name("tool", tool, tuple(self._table.tool))
        return entry


def tool_point(tool: Tool | None) -> tuple[float, float]:
    """Return the tool of a resolved goal as a point in the platform's frame [m]; the centre if the goal has no tool.

    Raises
    ------
    TypeError
        The tool is a name, because the goal has not been resolved.
    """
    if isinstance(tool, str):
        raise TypeError(f"tool {tool!r} of a resolved goal is a name, not a point")
    return tool or NO_TOOL


def rotated(x: float, y: float, angle: float) -> tuple[float, float]:
    """Return a vector rotated counterclockwise by an angle [rad]."""
    if angle == 0.0:
        return x, y
    c, s = math.cos(angle), math.sin(angle)
    return c * x - s * y, s * x + c * y


def unknown_name(kind: str, name: str, known: Sequence[str]) -> RefusedError:
    """Return the error for an unknown tool or frame, with a list of the known names."""
    there_are = f"known are {', '.join(known)}" if known else "there are none in [frames.tool]: give a point, [u, v]"
    return RefusedError(RefusalCode.UNKNOWN_FRAME, f"no {kind} {name!r}: {there_are}")
