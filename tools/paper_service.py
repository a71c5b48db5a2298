"""The paper's three motions, executed by a running service and read back from its recording.

A private service runs on simulated drives (configs/sim.toml), and listens on a socket in a temporary folder. It
receives each motion of equation (5) over Zenoh as a timed trajectory. Equation (5) begins and ends at standstill with
an acceleration, which is up to 0.032 m/s² at a slider. For one cycle of 1 ms at either end, this is a jerk of 32 m/s³,
which the sliders' limit of 400 m/s³ in configs/sim.toml allows.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from paper_motions import DURATION, EXAMPLES, Curves, Example, platform
from trirail.client import own_service
from trirail.client.client import GoalHandle, Robot
from trirail.config import SIM, load
from trirail.errors import RefusedError, ServiceError
from trirail.kinematics.arrays import Array
from trirail.telemetry.reading import read
from trirail.telemetry.recording import Recording
from trirail.wire.goals import TrajectoryPoint
from trirail.wire.vocabulary import MODES, Mode

SPACING = 0.02
"""Time between the points of a trajectory [s]. The error of the service's quintic polynomials between the points is
f⁽⁶⁾ τ³ (h − τ)³ / 720 at the time τ in an interval of length h. In position, velocity and acceleration this is at most
h⁶/46080, √5 h⁵/30000 and h⁴/1920 times the sixth derivative, here 5e-17 m, 9e-15 m/s and 3e-12 m/s². Rounding errors
are not smaller than this, and would increase with closer points.
"""
MOTION_TIMEOUT_S = 60.0
"""Time limit of a motion [s]; a motion takes longer on a busy machine."""
USER = "paper"
REACHED_AFTER_CYCLES = 2
"""Number of cycles between the writing of a setpoint and the SYNC at which a drive should have reached the setpoint.
The drive applies the setpoint at the SYNC in between (trirail.control.control.Control.observe).
"""


class Driven(NamedTuple):
    """Motion executed by the service, at t = 1, 2, … periods."""

    commanded: Curves
    """Setpoints of the sliders."""
    measured: Array
    """Slider positions that the drives reported for the times of the setpoints, (N, 3) [m]."""


def drive(recording: Path, say: Callable[[str], None]) -> dict[Example, Driven]:
    """Let a private service follow the motions and record them to a file; return the motions. Raises TrirailError."""
    period = load(SIM).period
    with tempfile.TemporaryDirectory(prefix="trirail-") as folder:
        config, locator = own_service.private(Path(folder))
        say("starting a service on simulated drives")
        with own_service.service(config, recording) as service:
            with Robot(load(config).robot.name, locator, user=USER) as robot:
                robot.enable()
                for example in EXAMPLES:
                    say(f"{example.name}: {DURATION:g} s, from the centre")
                    _finish(robot.move_to(x=0.0, y=0.0, phi=0.0), "the way back to the centre")
                    _finish(_send(robot, example), example.name)
                robot.disable()
            if code := own_service.end(service):
                raise ServiceError(f"the service ended with exit code {code}")
    made = read(recording)
    return {example: driven(made, _name(example), period) for example in EXAMPLES}


def points(example: Example) -> list[TrajectoryPoint]:
    """Return a motion as a timed trajectory. Position, velocity and acceleration are exact at its points."""
    t = np.linspace(0.0, DURATION, round(DURATION / SPACING) + 1)
    rows = zip(t.tolist(), *(values.tolist() for values in platform(example, t)), strict=True)
    return [
        TrajectoryPoint(time, x, y, phi, tuple(velocity), tuple(acceleration))
        for time, (x, y, phi), velocity, acceleration in rows
    ]


def driven(recording: Recording, goal: str, period: float) -> Driven:
    """Extract the motion to a goal from a recording, with the times of equation (5). Raises ServiceError.

    No times are fitted. The log names the goal and the cycle that started its motion. In that cycle the motion advanced
    by one period for the first time (trirail.control.control.Control.solve), so its setpoints belong to t = 1 period.
    The setpoints of the k-th cycle of motion belong to t = k periods, and t = 0 is the standstill before the motion.
    The motion ends with its path, because the goal does not wait for the robot to settle. The progress in each record
    confirms these times.
    """
    records = recording.records
    events = [(line.t, line.event) for line in recording.events if line.event is not None]
    began = [t for t, event in events if event.goal == goal]
    if len(began) != 1:
        raise ServiceError(f"the recording's log says {len(began)} times, not once, that goal {goal} began")
    first = int(np.searchsorted(recording.t, began[0] - period / 2.0))
    moving = records["mode"][first:] == MODES.index(Mode.MOVING)
    n = int(np.argmin(np.append(moving, False)))
    wanted = round(DURATION / period)
    n -= n > wanted and records["progress"][first + n - 1] >= 1.0  # without the cycle that detects the end
    span = records[first : first + n + REACHED_AFTER_CYCLES]
    t = np.arange(1.0, n + 1.0) * period
    if n != wanted or not np.array_equal(np.diff(span["cycle"]), np.ones(n + REACHED_AFTER_CYCLES - 1)):
        raise ServiceError(f"goal {goal}: {n} cycles of motion are recorded; expected {wanted} without a gap")
    if np.max(np.abs(span["progress"][:n] * DURATION - t)) > 1e-3 * period:
        raise ServiceError(f"goal {goal}: its time did not run evenly, by the progress in its records")
    position, velocity, acceleration = (
        span[:n][f"commanded_{each}"] for each in ("position", "velocity", "acceleration")
    )
    return Driven(Curves(t, position, velocity, acceleration), span["position"][REACHED_AFTER_CYCLES:])


def _name(example: Example) -> str:
    return f"paper-{example.name}"


def _send(robot: Robot, example: Example) -> GoalHandle:
    try:
        return robot.follow(points(example), settle=False, id=_name(example))
    except RefusedError as error:
        raise RefusedError(error.code, f"the service refused {example.name}: {error}") from error


def _finish(goal: GoalHandle, name: str) -> None:
    try:
        result = goal.wait(MOTION_TIMEOUT_S)
    except TimeoutError as error:
        raise ServiceError(f"{name}: {error}") from error
    if result.outcome != "done":
        raise ServiceError(f"{name} ended {result.outcome}: {result.message}")
