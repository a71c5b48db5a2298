"""From a goal of any kind to the motion that leads there from the present one."""

from __future__ import annotations

from collections import deque

from service.errors import RefusedError
from service.messages import Goal, PoseGoal, SlidersGoal, TrajectoryGoal, VelocityGoal
from service.motion import MotionState, Run, rest
from service.paths import Path
from service.planning import Planner, Point

SLOWEST = 0.05
"""Where the time along a path runs slower than this, a new goal is planned from a standstill."""


def plan(planner: Planner, goal: Goal, start: MotionState, under_way: Run | None, rate: float) -> deque[Run]:
    """Return the motion to a goal, its time to run at `rate`, from the commanded state of the motion under way.

    It is one run where that can be done at once. Where it would be too fast for a slider, the motion under way is
    stopped on its path first: two runs. Raises RefusedError.
    """
    if start.at_rest or under_way is None:
        return deque([planner.begin(_path(planner, goal, start), rate, start.pose)])
    now = under_way.at.rate
    if now >= SLOWEST:
        try:
            # The new path's time goes on at the rate of the old one's: in it, the motion is that much slower.
            velocity = [value / now for value in start.velocity]
            acceleration = [value / now**2 for value in start.acceleration]
            path = _path(planner, goal, MotionState(start.pose, velocity, acceleration))
            run = planner.begin(path, now, start.pose)
            if run.target == now:
                if rate != now:
                    planner.change_rate(run, rate, start.pose)
                return deque([run])
        except RefusedError as error:
            if error.code not in ("too_fast", "no_plan"):
                raise
    stop = under_way.copy()
    planner.change_rate(stop, 0.0, start.pose)
    end = stop.state(stop.ends - stop.time, start.pose).pose
    return deque([stop, planner.begin(_path(planner, goal, rest(end)), rate, end)])


def _path(planner: Planner, goal: Goal, start: MotionState) -> Path:
    match goal:
        case PoseGoal():
            return planner.to_pose(start, (goal.x, goal.y, goal.phi), goal.speed)
        case SlidersGoal():
            return planner.to_sliders(start, goal.position, goal.speed)
        case VelocityGoal():
            return planner.jog(start, (goal.x, goal.y, goal.phi), goal.timeout)
        case TrajectoryGoal():
            points = [Point(p.t, (p.x, p.y, p.phi), p.velocity, p.acceleration) for p in goal.points]
            return planner.follow(start, points, goal.stretch)
