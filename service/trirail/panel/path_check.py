"""Whether a pose can be gone to, or a file followed, said before anything moves; the service decides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from trirail_drivers.interface import Triple

from trirail.client import trajectory
from trirail.client.outgoing import goal_message
from trirail.errors import KinematicsError, RefusedError, TrirailError
from trirail.motion.goal_planner import GoalPlanner
from trirail.motion.runs import nominal, of_centre, of_tool, rest
from trirail.motion.schedule import Schedule
from trirail.motion.tool_frames import NamedFrames, rotated
from trirail.telemetry.shown_robot import ShownRobot
from trirail.wire.goals import TrajectoryGoal
from trirail.workspace.violations import violations

LOOKS = 40
"""Poses on the way, straight in pose space, that are looked at, its end first."""
DRAWN = 200
"""Places of a path, evenly in time, that are drawn."""


def problem(robot: ShownRobot, start: Triple, end: Triple, tool: str | None, frame: str) -> tuple[str, bool]:
    """Return what is in the way from a pose to another, straight in pose space, and whether it is before the end.

    `start` is the centre's in the base frame, `end` the tool's in a frame of the robot's, x, y [m] and phi [rad]; the
    tool goes straight. Empty where nothing is known to be in the way: positions, passive travel and the singular
    margin are looked at, at LOOKS places; speeds and what the planner finds between them are the service's to judge.
    """
    names = NamedFrames(robot.frames)
    try:
        point, (x, y, angle) = names.tool(tool), names.frame(frame)
    except RefusedError as error:
        return str(error), False
    u, v = rotated(end[0], end[1], angle)
    first, last = np.array(of_tool(rest(start), point).pose), np.array((x + u, y + v, angle + end[2]))
    for share in np.linspace(1.0, 0.0, LOOKS, endpoint=False):
        pose = of_centre(rest((share * last + (1.0 - share) * first).tolist()), point).pose
        try:
            found = violations(robot.geometry, robot.limits, np.asarray(pose))
        except KinematicsError as error:
            return str(error), bool(share < 1.0)
        if found:
            return str(found[0]), bool(share < 1.0)
    return "", False


class CheckedPath(Struct, frozen=True, omit_defaults=True):
    """What a file's path comes to."""

    why: str = ""
    """Why it cannot be followed; empty where it can."""
    line: Sequence[Triple] = ()
    """Poses along it, in the base frame [m, rad]; its points alone where it cannot be followed."""
    duration: float = 0.0
    """How long it takes at full speed [s]."""
    slowed: float = 1.0
    """How many times slower that is than was asked for."""


def checked_path(robot: ShownRobot, name: str, text: str, stretch: bool) -> CheckedPath:
    """Read a trajectory and plan it as the service would from its first point: its whole path is checked."""
    line: list[Triple] = []
    try:
        points = tuple(trajectory.parse(name, text))
        line = [(point.x, point.y, point.phi) for point in points]
        goal, period = TrajectoryGoal(points, stretch=stretch), 1.0 / robot.rate_hz
        goal_message(goal, "checked")  # as the client does
        planned = GoalPlanner(robot.geometry, robot.limits, period).plan(goal, Schedule(rest(line[0]), period), 1.0, 0)
    except (TrirailError, ValueError) as error:
        return CheckedPath(str(error), line)
    path = planned.run.path
    poses = [nominal(path, float(s)).pose for s in np.linspace(0.0, path.duration, DRAWN)]
    return CheckedPath("", [(float(x), float(y), float(phi)) for x, y, phi in poses], planned.duration, planned.slowed)
