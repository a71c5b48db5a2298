"""What a goal costs the loop: the steps in which it is planned and looked at along its path, in processor time."""

from __future__ import annotations

import json as json_format
import random
import time
from collections.abc import Callable

import bench_time_optimal
import numpy as np
from ruckig import InputParameter, Ruckig, Synchronization, Trajectory
from trirail.config import SIM, geometry, load
from trirail.errors import RefusedError
from trirail.motion.goals import Goals
from trirail.motion.runs import rest
from trirail.motion.schedule import Schedule
from trirail.wire.messages import Goal, PoseGoal, SlidersGoal, VelocityGoal

GOALS = 1500
AIM = 300.0
"""What a step should take at most [µs]."""
SEED = 4


def main(json: bool) -> None:
    """Plan goals from rest and from motion, one after the other, and print what a step takes."""
    config = load(SIM)
    goals = Goals(geometry(config.geometry), config.limits, config.period)
    kinds: dict[str, Callable[[random.Random], Goal]] = {
        "pose": lambda rnd: PoseGoal(*_pose(rnd)),
        "sliders": lambda rnd: SlidersGoal((rnd.uniform(-0.1, 0.1), rnd.uniform(-0.1, 0.1), rnd.uniform(-0.1, 0.1))),
        "velocity": lambda rnd: VelocityGoal(
            rnd.uniform(-0.25, 0.25), rnd.uniform(-0.25, 0.25), rnd.uniform(-1.5, 1.5)
        ),
    }
    results = {}
    for kind, make in kinds.items():
        schedule, rnd = Schedule(rest((0.0, 0.0, 0.0)), config.period), random.Random(SEED)
        steps: list[float] = []
        counts: list[int] = []
        for _ in range(GOALS):
            counts.append(_plan(goals, schedule, make(rnd), steps))
            for _ in range(rnd.randrange(1, 300)):
                schedule.advance()
        results[kind] = {
            "steps_us": dict(
                zip(("p50", "p99", "max"), np.percentile(np.array(steps) * 1e6, (50, 99, 100)).tolist(), strict=True)
            ),
            "in_one_step": counts.count(1) / len(counts),
            "most_steps": max(counts),
        }
    bare = _bare(config.period)
    weak = bench_time_optimal.measure()
    if json:
        print(json_format.dumps({"goals": results, "ruckig_alone_us": bare, "aim_us": AIM, "weak_sliders": weak}))
        return
    print(f"a step of planning, processor time [µs]; the aim is {AIM:g}, and one step a cycle")
    for kind, found in results.items():
        p50, p99, greatest = found["steps_us"].values()  # type: ignore[attr-defined]
        print(
            f"{kind:<10} p50 {p50:5.0f}  p99 {p99:5.0f}  max {greatest:5.0f}   "
            f"{found['in_one_step']:.0%} of the goals in one step, none in more than {found['most_steps']}"
        )
    print(f"Ruckig alone, for one pose from rest: {bare:.1f} µs; the rest is the look along the path")
    bench_time_optimal.report(weak)


def _pose(rnd: random.Random) -> tuple[float, float, float]:
    return rnd.uniform(-0.06, 0.06), rnd.uniform(-0.06, 0.06), rnd.uniform(-0.5, 0.4)


def _plan(goals: Goals, schedule: Schedule, goal: Goal, steps: list[float]) -> int:
    """Plan a goal step by step, the schedule going on meanwhile; return how many steps it took."""
    planning, count = goals.plan(goal, schedule, 1.0), 0
    while True:
        count += 1
        began = time.thread_time()
        try:
            next(planning)
        except StopIteration as decided:
            steps.append(time.thread_time() - began)
            schedule.take(decided.value.runs, decided.value.turn)
            return count
        except RefusedError:
            steps.append(time.thread_time() - began)
            return count
        steps.append(time.thread_time() - began)
        schedule.advance()


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
