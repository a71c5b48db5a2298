"""What a goal costs the planner: it is planned and looked at along its path beside the loop, in processor time."""

from __future__ import annotations

import random
import time
from collections import deque
from collections.abc import Callable

import numpy as np
from ruckig import InputParameter, Ruckig, Synchronization, Trajectory
from trirail.config import SIM, geometry, load
from trirail.errors import RefusedError
from trirail.motion.goals import Goals
from trirail.motion.runs import rest
from trirail.motion.schedule import Schedule
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal, TrackGoal, VelocityGoal

AIM = 5000.0
"""What a goal should take at most [µs]."""
LEAD = 3
"""Cycles from the question until a motion from motion begins."""
SEED = 4


def measure(number: int) -> dict[str, object]:
    """Plan so many goals of each kind from rest and from motion, one after the other; what one takes, microseconds."""
    config = load(SIM)
    goals = Goals(geometry(config.geometry), config.limits, config.period)
    kinds: dict[str, Callable[[random.Random], Goal]] = {
        "pose": lambda rnd: PoseGoal(*_pose(rnd)),
        "sliders": lambda rnd: SlidersGoal((rnd.uniform(-0.1, 0.1), rnd.uniform(-0.1, 0.1), rnd.uniform(-0.1, 0.1))),
        "velocity": lambda rnd: VelocityGoal(
            rnd.uniform(-0.25, 0.25), rnd.uniform(-0.25, 0.25), rnd.uniform(-1.5, 1.5)
        ),
        "track": lambda rnd: TrackGoal(*_pose(rnd), velocity=(rnd.uniform(-0.2, 0.2), rnd.uniform(-0.2, 0.2), 0.0)),
    }
    results = {}
    for kind, make in kinds.items():
        schedule, rnd = Schedule(rest((0.0, 0.0, 0.0)), config.period), random.Random(SEED)
        times = []
        for _ in range(number):
            times.append(_plan(goals, schedule, make(rnd)))
            for _ in range(rnd.randrange(1, 300)):
                schedule.advance()
        results[kind] = dict(
            zip(("p50", "p99", "max"), np.percentile(np.array(times) * 1e6, (50, 99, 100)).tolist(), strict=True)
        )
    return {"goal_us": results, "ruckig_alone_us": _bare(config.period), "aim_us": AIM}


def _pose(rnd: random.Random) -> tuple[float, float, float]:
    return rnd.uniform(-0.06, 0.06), rnd.uniform(-0.06, 0.06), rnd.uniform(-0.5, 0.4)


def _plan(goals: Goals, schedule: Schedule, goal: Goal) -> float:
    """Plan a goal, and begin with it where it is accepted; return how long planning took [s]."""
    began = time.thread_time()
    try:
        planned = goals.plan(goal, schedule, 1.0, LEAD)
    except RefusedError:
        return time.thread_time() - began
    took = time.thread_time() - began
    for _ in range(LEAD if schedule.runs else 0):
        schedule.advance()
    if not planned.stops_first:
        schedule.take(deque([planned.run]))
    return took


def _bare(period: float) -> float:
    """Time Ruckig by itself [µs]."""
    request, trajectory, ruckig = InputParameter(3), Trajectory(3), Ruckig(3, period)
    request.target_position = [0.05, -0.03, 0.2]
    request.max_velocity, request.max_acceleration, request.max_jerk = [0.25] * 3, [2.0] * 3, [40.0] * 3
    request.synchronization = Synchronization.Phase
    began = time.thread_time()
    for _ in range(1000):
        ruckig.calculate(request, trajectory)
    return (time.thread_time() - began) * 1e3
