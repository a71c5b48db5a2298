"""Outputs on the path: the places at which they switch, compared with a client, and the time that switching takes.

The place of a pulse is compared with the commanded pose of the setpoint with which its output was sent. The client does
what users of a robot without marks do: it watches the state, and sends `set_output` once the robot has passed the
place. The record of each cycle shows where an output took effect.

The time is that of the compiled switching function alone, in each cycle of a path, and includes two calls of the clock.
The program sleeps between cycles, as the loop does, so that the processor's caches are as cold as in the loop.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from bench_rig import QUANTILES, Rig, quantiles
from numpy.typing import NDArray
from trirail.client.client import Robot
from trirail.config import SIM, Output, load
from trirail.control.outputs import Outputs, switch
from trirail.kinematics.compiled import compiled
from trirail.motion.goal_planner import GoalPlanner
from trirail.motion.marks import GoalMarks, place_marks
from trirail.motion.runs import rest
from trirail.motion.schedule import Schedule
from trirail.processes.clock import now_ns, sleep
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.wire.goals import PoseGoal
from trirail.wire.marks import Mark
from trirail.wire.records import DTYPE, unpack

SECTIONS: Final = '[outputs.valve]\ndrive = "A"\nbit = 16\n'
"""Sections that are added to the configuration."""
FIRST_BIT: Final = 16
BIT: Final = 1 << FIRST_BIT
SPEEDS: Final = (0.01, 0.1, 0.25)
"""Speeds of the platform at the marks [m/s]."""
TRAVELS: Final = (0.02, 0.1, 0.2)
"""Length of the path at each speed, along x [m]."""
CRUISE: Final = 0.3
"""Fraction of the path at each end that has no marks, since the robot accelerates or brakes there."""
TIMED_OUTPUTS: Final = (0, 1, 8)
"""Numbers of outputs for which the switching function is timed."""
PASSES: Final = 2
"""Number of times that the path is repeated to time the switching function."""


def measure(made: Rig, pulses: int, tries: int) -> dict[str, Any]:
    """Return the position errors of `pulses` marks and of `tries` attempts by a client at each speed, and the times."""
    robot = DrawnRobot.from_info(made.robot.info())
    limit, rate_hz = robot.limits.platform.velocity[0], robot.rate_hz
    rows = []
    for speed, travel in zip(SPEEDS, TRAVELS, strict=True):
        marks = _errors_of_marks(made.robot, travel, speed / limit, pulses)
        client = [_error_of_client(made.robot, travel, speed / limit) for _ in range(tries)]
        rows.append(
            {
                "mm_s": speed * 1e3,
                "half_a_cycle_um": 0.5e6 * speed / rate_hz,
                "marks_um": quantiles(marks),
                "client_um": quantiles(client),
            }
        )
    return {"quantiles": QUANTILES, "pulses": pulses, "tries": tries, "speeds": rows, "switch_us": times(PASSES)}


def _errors_of_marks(robot: Robot, travel: float, speed: float, pulses: int) -> list[float]:
    """Return the distance between the intended and the actual beginning of each pulse of one goal [µm]."""
    robot.move_to(x=-travel / 2.0, y=0.0, phi=0.0).wait()
    length = travel * (1.0 - 2.0 * CRUISE)
    increment, begin = length / pulses, travel * CRUISE
    mark = {"output": "valve", "start": begin, "end": begin + length, "increment": increment, "pulse_width": 0.002}
    result = robot.move_to(x=travel / 2.0, y=0.0, phi=0.0, speed=speed, marks=[mark]).wait()
    places = [row.commanded[0] + travel / 2.0 for row in result.marks if row.value]
    expected = begin + increment * np.arange(len(places))
    return [float(error) for error in 1e6 * np.abs(np.array(places) - expected)]


def _error_of_client(robot: Robot, travel: float, speed: float) -> float:
    """Return the distance from the middle of the path at which a client that watches the state has switched [µm]."""
    robot.move_to(x=-travel / 2.0, y=0.0, phi=0.0).wait()
    robot.set_output("valve", False)
    batches: list[bytes] = []
    with robot.records(batches.append):
        goal = robot.move_to(x=travel / 2.0, y=0.0, phi=0.0, speed=speed)
        next(state for state in robot.states() if state.pose[0] >= 0.0)
        robot.set_output("valve", True)
        goal.wait()
    records = np.concatenate([unpack(batch) for batch in batches])
    on = records["outputs"][:, 0] & BIT != 0
    switched = records[1:][on[1:] & ~on[:-1]]
    return 1e6 * abs(float(switched["commanded_pose"][0, 0]))


# ---------------------------------------------------------------------- time of the compiled switch


def times(passes: int) -> list[dict[str, Any]]:
    """Return the times of the switching function in the cycles of a path with 100 pulses of each output [µm]."""
    return [_times(count, passes) for count in TIMED_OUTPUTS]


def _times(count: int, passes: int) -> dict[str, Any]:
    robot = DrawnRobot.from_config(load(SIM))
    period, start = 1.0 / robot.rate_hz, (-0.1, 0.0, 0.0)
    run = (
        GoalPlanner(robot.geometry, robot.limits, period)
        .plan(PoseGoal(0.1, 0.0, 0.0, speed=0.4), Schedule(rest(start), period), 1.0, 0)
        .run
    )
    named = {f"output{number}": Output("A", FIRST_BIT + number) for number in range(count)}
    marks = [Mark(name, start=0.0, increment=0.002, pulse_width=0.002) for name in named]
    placed = place_marks(marks, run.path, robot.geometry.packed(), start, period)
    run.marks.append(GoalMarks("bench", marks, placed.switches.tobytes()))
    outputs = Outputs(named, {}, period)
    outputs.prepare(run, 1)
    first = outputs.state.copy()
    durations = np.zeros(math.ceil(run.path.duration / period), np.int64)
    law, record, samples, switched = run.law, np.zeros(1, DTYPE), [], 0
    for _ in range(passes):
        outputs.state[:] = first
        switched += _timed(
            *(outputs.state, outputs.planned, outputs.words, outputs.log, law.knots, law.pieces, period, record),
            *(durations, np.zeros(2, np.int64)),
        )
        samples.append(durations / 1e3)
    return {"outputs": count, "switched": switched, "us": quantiles(np.concatenate(samples))}


@compiled()
def _timed(
    outputs: NDArray[np.void],
    planned: NDArray[np.void],
    words: NDArray[np.int64],
    log: NDArray[np.void],
    knots: NDArray[np.float64],
    pieces: NDArray[np.float64],
    period: float,
    record: NDArray[np.void],
    durations: NDArray[np.int64],
    moment: NDArray[np.int64],
) -> int:
    """Write the duration of the switching function in each cycle [ns]; return how many times outputs switched."""
    switched = 0
    due = now_ns(moment)
    for cycle in range(len(durations)):
        due += int(period * 1e9)
        sleep(due, moment)
        began = now_ns(moment)
        logged = switch(outputs, planned, words, log, 0, knots, pieces, True, cycle * period, period, cycle, 0, record)
        durations[cycle] = now_ns(moment) - began
        switched += logged
    return switched
