"""Whole sessions of the control, a cycle at a time, over drives that are where they were told to be; what is judged."""

from __future__ import annotations

import itertools

import numpy as np
from conftest import CONFIG, Cycles, carried
from numpy.typing import NDArray
from trirail.config import Config
from trirail.control.control import Control, Given
from trirail.control.local_planner import LocalPlanner
from trirail.wire.goals import Goal
from trirail.wire.packets import CommandRequest, GoalRequest, Request
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import MODES, Command, Mode
from trirail_drivers.interface import DriveFault, Feedback, MissingProtection, PowerState, Triple

STILL = (0.0, 0.0, 0.0)
OFF, ON = (PowerState.SWITCH_ON_DISABLED,) * 3, (PowerState.OPERATION_ENABLED,) * 3
EXCESS = 1e-3
"""By that share may a setpoint exceed a limit: what lies between the moments at which a path is looked at."""


class PerfectDrives:
    """Drives that are at once where they were told to be two SYNCs ago, and power up and down within a cycle."""

    bus_load = 0.0
    missing_protections: tuple[MissingProtection, ...] = ()
    traffic = 0
    reported_faults: tuple[DriveFault | None, ...] = (None, None, None)

    def __init__(self, position: Triple = STILL) -> None:
        self._state = OFF
        self._due = position, position
        self._position = position

    def configure(self, period: float, fastest: float | None = None) -> None:
        """Do nothing: there is nothing to set up."""

    def sync(self) -> None:
        """Reach what was written a cycle before the last one."""
        self._position = self._due[0]

    def read(self) -> Feedback:
        """Tell where the sliders are."""
        return Feedback(self._position, self._state, None)

    def write(self, position: Triple, velocity: Triple) -> None:
        """Take setpoints, as from the next SYNC on."""
        self._due = self._due[1], position

    def enable(self, alone: str | None = None) -> None:
        """Power up."""
        self._state = ON

    def disable(self) -> None:
        """Power down."""
        self._state = OFF

    quick_stop = disable

    def home(self) -> None:
        """Do nothing: every position is absolute."""

    def stop_homing(self) -> None:
        """Do nothing."""

    def reset(self) -> None:
        """Do nothing: they have no fault."""

    def close(self) -> None:
        """Do nothing."""


class Session(Cycles):
    """A robot that is enabled, and what it was sent and told; `rows` are the records of its cycles."""

    def __init__(self, config: Config = CONFIG, delay: int = 1) -> None:
        super().__init__()
        self.config = config
        self.drives = PerfectDrives()
        self.planner = LocalPlanner(config, delay)
        self.control = Control(config, self.drives, self.planner)
        self.control.start(self.drives.read())
        self.rows: list[NDArray[np.void]] = []
        self._tickets = itertools.count(1)
        self._now = 100.0
        self.order(Command.ENABLE)
        self.until(lambda: self.mode is Mode.HOLDING, 10)

    def cycle(self, request: Request | None = None) -> None:
        """Run one cycle, with a request or without."""
        self._now += self.config.period
        now_ns = round(self._now * 1e9)
        given: list[Given] = [] if request is None else [(request, now_ns)]
        given += [(answer, now_ns) for answer in self.planner.answers()]
        self.drives.sync()
        self.control.cycle(self.drives.read, given)
        record = self.control.measured.record.copy()
        record["mode"] = MODES.index(self.mode)
        self.rows.append(record)
        self.keep_what_was_said()

    def order(self, name: Command, value: float | None = None) -> None:
        """Send a command in the next cycle."""
        self.cycle(CommandRequest(next(self._tickets), "ann", name, carried(name, value)))

    def send(self, name: str, goal: Goal) -> None:
        """Send a goal in the next cycle."""
        self.cycle(GoalRequest(next(self._tickets), "ann", name, goal, round((self._now + self.config.period) * 1e9)))

    @property
    def outcomes(self) -> dict[str | None, str | None]:
        """How each goal has ended."""
        return {said.id: said.outcome for said in self.notices if said.kind == "goal"}

    @property
    def records(self) -> NDArray[np.void]:
        """The records of all cycles, (cycles,)."""
        return np.concatenate(self.rows) if self.rows else np.zeros(0, DTYPE)


def shares(config: Config, records: NDArray[np.void]) -> dict[str, float]:
    """Return the greatest share of each limit that was made use of, by name; jerk from cycle to cycle.

    Where the robot follows what is measured, without power or in fault, it is commanded no motion.
    """
    commanded = np.isin(records["mode"], [MODES.index(mode) for mode in (Mode.HOLDING, Mode.MOVING, Mode.STOPPING)])
    both = commanded[1:] & commanded[:-1]
    platform, slider = config.limits.platform, config.limits.slider
    found = {}
    for name, prefix, limits in (
        ("platform", "commanded_pose", (platform.velocity, platform.acceleration, platform.jerk)),
        ("slider", "commanded", (slider.velocities, slider.accelerations, slider.jerks)),
    ):
        velocity, acceleration = records[f"{prefix}_velocity"], records[f"{prefix}_acceleration"]
        jerk = np.diff(acceleration, axis=0)[both] / config.period
        velocity, acceleration = velocity[commanded], acceleration[commanded]
        for quantity, rows, limit in zip(
            ("velocity", "acceleration", "jerk"), (velocity, acceleration, jerk), limits, strict=True
        ):
            found[f"{name} {quantity}"] = float((np.abs(rows) / limit).max(initial=0.0))
    return found


def assert_within_limits(config: Config, records: NDArray[np.void]) -> None:
    """Every limit of rate holds, but for rounding and what lies between two looks."""
    over = {name: share for name, share in shares(config, records).items() if share > 1.0 + EXCESS}
    assert not over
