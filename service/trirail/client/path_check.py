"""Checks before a motion if a pose is reachable, or if the trajectory in a file can be followed.

The service makes the final decision.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from trirail_drivers.interface import Triple

from trirail.client import trajectory
from trirail.client.outgoing import goal_messages
from trirail.config import Limits
from trirail.errors import KinematicsError, RefusalCode, RefusedError, TrirailError
from trirail.motion.goal_planner import GoalPlanner
from trirail.motion.kinds.pose import PoseMotion
from trirail.motion.limits import Bounds, Violation
from trirail.motion.paths import ROUNDING
from trirail.motion.runs import centre_motion, nominal_motion, rest, tool_motion
from trirail.motion.schedule import Schedule
from trirail.motion.tool_frames import NamedFrames, tool_point
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.wire.goals import PoseGoal, Tool, TrajectoryGoal
from trirail.wire.packed_trajectory import packed
from trirail.workspace.violations import violations

CHECKED_POSES = 40
"""Number of poses that are checked on the straight line in pose space, from its end to its start."""
SYMBOLS = {"phi": "φ"}
"""Symbols of the platform's coordinates on the page, where they differ from the name."""
DRAWN_POINTS = 200
"""Number of points with which a path is drawn, evenly spaced in time."""


class Obstacle(Struct, frozen=True, omit_defaults=True):
    """Reason why a pose cannot be reached, as a message, and as a code and values that the web page translates."""

    message: str
    on_way: bool = False
    """True if the obstacle is on the way to the end pose, False if it is at the end pose."""
    code: str = ""
    """Name of the exceeded limit, "unreachable", or a RefusalCode."""
    what: str = ""
    """Label of the slider, or symbol of the platform's coordinate."""
    value: float = 0.0
    limit: float = 0.0
    unit: str = ""


def find_obstacle(robot: DrawnRobot, start: Triple, end: Triple, tool: Tool | None, frame: str) -> Obstacle | None:
    """Check if the tool can move along a straight line in pose space; CHECKED_POSES poses are checked.

    The function checks positions, passive travel, the limits of the platform and the singularity margin. Only the
    service checks the speeds, and the path between the checked poses.

    As in the service, a robot beyond a limit may move, if it moves no farther beyond that limit.

    Parameters
    ----------
    robot
        Robot, with its limits.
    start
        Pose of the platform's centre in the base frame: x, y [m], phi [rad].
    end
        Pose of the tool in `frame`.
    tool
        Tool, by name or by its point; None for the centre.
    frame
        Name of a work frame.

    Returns
    -------
    Obstacle | None
        Obstacle nearest to the end of the line; None if there is no obstacle.
    """
    names, (x, y, phi) = NamedFrames(robot.frames), end
    try:
        goal = PoseMotion.resolve(PoseGoal(x, y, phi, tool=tool, frame=frame), names, lambda _: start)
    except RefusedError as error:
        return Obstacle(str(error), code=error.code)
    point, limits = tool_point(goal.tool), robot.planned_limits
    bounds = Bounds(limits, 1.0 / robot.rate_hz, labels=robot.geometry.labels)
    first, last = np.array(tool_motion(rest(start), point).pose), np.array((goal.x, goal.y, goal.phi))
    try:
        before = _violations(robot, limits, start)
    except KinematicsError:
        before = {}
    for share in np.linspace(1.0, 0.0, CHECKED_POSES, endpoint=False):
        pose = centre_motion(rest((share * last + (1.0 - share) * first).tolist()), point).pose
        if outside := bounds.pose_violation_from(pose, start):
            return _obstacle(outside, bool(share < 1.0))
        try:
            exceeded = _violations(robot, limits, pose)
        except KinematicsError as error:
            return Obstacle(str(error), bool(share < 1.0), "unreachable", error.leg)
        for key, violation in exceeded.items():
            if key not in before or _excess(violation) > _excess(before[key]) + ROUNDING:
                return _obstacle(violation, bool(share < 1.0))
    return None


def _violations(robot: DrawnRobot, limits: Limits, pose: Sequence[float]) -> dict[tuple[str, str, float], Violation]:
    """Return the violations of the limits of the joints at a pose, by slider or coordinate, quantity and limit."""
    return {(each.axis, each.quantity, each.limit): each for each in violations(robot.geometry, limits, pose)}


def _excess(violation: Violation) -> float:
    return abs(violation.value - violation.limit)


def _obstacle(exceeded: Violation, on_way: bool) -> Obstacle:
    code, what = exceeded.quantity.replace(" ", "_"), exceeded.label
    if exceeded.part == "platform" and code == "position":
        code, what = "platform_position", SYMBOLS.get(exceeded.axis, exceeded.axis)
    return Obstacle(str(exceeded), on_way, code, what, exceeded.value, exceeded.limit, exceeded.unit)


class CheckedPath(Struct, frozen=True, omit_defaults=True):
    """Result of the check of a trajectory file."""

    why: str = ""
    """Reason why the trajectory cannot be followed; empty if it can be followed."""
    code: str = ""
    """RefusalCode or "unreadable"; empty if the trajectory can be followed."""
    line: Sequence[Triple] = ()
    """Poses along the path, in the base frame [m, rad]; only the file's points if they cannot be followed."""
    duration: float = 0.0
    """Duration at full speed [s]."""
    slowed: float = 1.0
    """Ratio of `duration` to the duration in the file."""


def check_path(robot: DrawnRobot, name: str, text: str, stretch: bool) -> CheckedPath:
    """Parse a trajectory, and plan it from its first point in the same way as the service.

    The planner checks the whole path after its first pose. `name` is the name of the file, and `stretch` is that of
    Robot.follow.
    """
    line: list[Triple] = []
    try:
        points = tuple(trajectory.parse(name, text))
        line = [(point.x, point.y, point.phi) for point in points]
        goal, period = TrajectoryGoal(points, stretch=stretch), 1.0 / robot.rate_hz
        goal_messages(goal, "checked")  # the checks of the client
        _check_first_pose(robot, line[0])  # the planner lets a robot that is outside the limits stand or return
        limits = robot.planned_limits
        planner, schedule = GoalPlanner(robot.geometry, limits, period), Schedule(rest(line[0]), period)
        planned = planner.plan(packed(goal), schedule, 1.0, 0)
    except (TrirailError, ValueError) as error:
        code = error.code if isinstance(error, RefusedError) else "unreadable"
        return CheckedPath(str(error), code, line)
    path = planned.run.path
    poses = [nominal_motion(path, float(s)).pose for s in np.linspace(0.0, path.duration, DRAWN_POINTS)]
    drawn = [(float(x), float(y), float(phi)) for x, y, phi in poses]
    return CheckedPath(line=drawn, duration=planned.duration, slowed=planned.reply.slowed)


def _check_first_pose(robot: DrawnRobot, pose: Triple) -> None:
    """Raise RefusedError if a pose is outside the limits, and KinematicsError if it cannot be reached."""
    limits = robot.planned_limits
    outside = Bounds(limits, 1.0 / robot.rate_hz, labels=robot.geometry.labels).pose_violation(pose)
    exceeded = [outside] if outside else violations(robot.geometry, limits, pose)
    if exceeded:
        value, limit = exceeded[0].value, exceeded[0].limit
        text = f"the first point is outside the limits: {exceeded[0]}"
        raise RefusedError(RefusalCode.OUT_OF_WORKSPACE, text, value=value, limit=limit)
