"""A robot without processes and without a bus: the control over drives that are where they were told to be.

A cycle costs a tenth of one with the real driver and simulated drives, which conftest.Rig has.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from msgspec.structs import fields
from numpy.typing import NDArray
from trirail.config import SIM, Config, load
from trirail.control.control import Control, TimedInput
from trirail.control.local_planner import LocalPlanner
from trirail.motion.paths import LAST_PIECE_S, Path, constant_law
from trirail.motion.runs import MotionState
from trirail.wire.goals import Goal, PoseGoal
from trirail.wire.messages import Notice
from trirail.wire.packets import Accepted, Answer, CommandRequest, Disturbance, GoalRequest, Request
from trirail.wire.vocabulary import Command, CommandContent, Mode, SetOutput
from trirail_drivers.interface import (
    Counts,
    DriveFault,
    DriveGroup,
    Feedback,
    MissingProtection,
    PowerState,
    Travel,
    Triple,
)

SHIPPED = load(SIM)
# In simulated time no machine keeps the drives waiting: what is lost is lost as soon as that of real ones.
CONFIG = msgspec.structs.replace(SHIPPED, drives=msgspec.structs.replace(SHIPPED.drives, missed_positions=3))
OFF, ON = (PowerState.SWITCH_ON_DISABLED,) * 3, (PowerState.OPERATION_ENABLED,) * 3
STILL = (0.0, 0.0, 0.0)


def carried(name: str, rate: float | None = None) -> CommandContent:
    """What a command carries at least: 1 for each number that it needs, or for override a rate, 1 being full speed."""
    content = Command(name).content
    numbers = (1.0 if rate is None else 100.0 * rate for field in fields(content) if field.required)
    return content("valve", True) if content is SetOutput else content(*numbers)


def expected_duration(answer: Answer) -> float:
    """Return the expected duration of an accepted goal, infinite where it has none [s]."""
    assert isinstance(answer, Accepted), answer
    return math.inf if answer.reply.duration is None else answer.reply.duration


class PerfectDrives:
    """Drives that are at once where they were told to be two SYNCs ago, and power up and down within a cycle."""

    bus_load = next_sync = 0.0
    missing_protections: tuple[MissingProtection, ...] = ()
    traffic = 0
    counts = Counts(), Counts(), Counts()
    reported_faults: tuple[DriveFault | None, ...] = (None, None, None)

    def __init__(self, position: Triple = STILL) -> None:
        self._state = OFF
        self._due = position, position
        self._position = position
        self.outputs: list[int] = [0, 0, 0]
        """Output words that were set last."""
        self.inputs = (0, 0, 0)
        """Input words that the drives report."""

    path_outputs = (True, True, True)

    def set_outputs(self, words: Sequence[int]) -> None:
        """Take output words."""
        self.outputs = list(words)

    def configure(
        self, period: float, fastest: float | None = None, *, travel: Travel | None = None, awaits: bool = False
    ) -> None:
        """Do nothing: there is nothing to set up."""

    def sync(self) -> None:
        """Reach what was written a cycle before the last one."""
        self._position = self._due[0]

    def read(self) -> Feedback:
        """Tell where the sliders are."""
        return Feedback(self._position, self._state, None, inputs=self.inputs)

    observe = read

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


class ControlRig:
    """Runs cycles of control and drives, and keeps what was said."""

    def __init__(self, config: Config = CONFIG, driver: DriveGroup | None = None, delay: int = 1) -> None:
        """`delay`: cycles that the planner thinks."""
        self.config = config
        self.now = 100.0
        self.driver = driver or PerfectDrives(config.can.simulated.start)
        self.planner = LocalPlanner(config, delay)
        self.control = Control(config, self.driver, self.planner)
        self.driver.sync()
        self.control.start(self.driver.read())
        self.answers: list[Answer] = []
        self.notices: list[Notice] = []
        self.rows: list[list[list[float]]] = []
        self.more: list[Request | Disturbance] = []
        """What comes in the next cycle beside its request, and before it."""
        self._tickets = itertools.count(1)

    @property
    def mode(self) -> Mode:
        return self.control.state.mode

    def holds(self) -> bool:
        """Whether the robot stands and is ready for a goal."""
        return self.mode is Mode.HOLDING

    def cycle(self, request: Request | None = None) -> None:
        """Run one cycle, with a request or without."""
        self.now += self.config.period
        control = self.control
        self.driver.sync()
        now_ns = round(self.now * 1e9)
        given: list[TimedInput] = [(each, now_ns) for each in (*self.more, request) if each is not None]
        self.more.clear()
        given += [(answer, now_ns) for answer in self.planner.answers()]
        control.cycle(self.driver.read, given)
        self.rows.append(control.setpoints.rows)
        ledger = control.ledger
        self.answers += ledger.answers
        self.notices += ledger.notices
        ledger.answers.clear()
        ledger.notices.clear()

    def cycles(self, number: int) -> None:
        for _ in range(number):
            self.cycle()

    def until(self, condition: Callable[[], bool], within: int = 5000) -> int:
        """Run cycles until something holds; return how many."""
        for number in range(within):
            if condition():
                return number
            self.cycle()
        raise AssertionError(f"not within {within} cycles; the mode is {self.mode}")

    def command(self, name: str, value: float | None = None) -> Answer:
        """Send a command and run until it is answered."""
        ticket = next(self._tickets)
        self.cycle(CommandRequest(ticket, "ann", Command(name), carried(name, value)))
        self.until(lambda: self._answered(ticket))
        return self._answer(ticket)

    def goal(self, id: str, x: float, y: float, phi: float, speed: float = 1.0) -> Answer:  # noqa: A002
        """Send a pose goal; return its answer."""
        return self.send(id, PoseGoal(x=x, y=y, phi=phi, speed=speed))

    def send(self, id: str, goal: Goal, within: int = 50) -> Answer:  # noqa: A002
        """Send a goal; return its answer, which comes within so many cycles."""
        ticket = next(self._tickets)
        self.cycle(GoalRequest(ticket, "ann", id, goal, round(self.now * 1e9)))
        self.until(lambda: self._answered(ticket), within)
        return self._answer(ticket)

    def post(self, id: str, goal: Goal) -> None:  # noqa: A002
        """Send a goal in this cycle and do not wait for its answer."""
        self.cycle(GoalRequest(next(self._tickets), "ann", id, goal, round(self.now * 1e9)))

    def go_on_with(self, state: MotionState) -> None:
        """Let the run under way have this motion in the next cycle, whatever it has now."""
        run = self.control.schedule.runs[0]
        pieces = np.zeros((1, 3, 6))
        pieces[0, :, :3] = np.transpose(state)
        pieces[0, :, 2] /= 2.0
        run.path = Path(np.array([0.0, LAST_PIECE_S]), pieces)
        run.change_law(constant_law(1.0), 1.0)
        run.time = -self.config.period
        run.furthest[:] = -math.inf

    def order(self, name: str, value: float | None = None) -> None:
        """Send a command in this cycle and do not wait for its answer."""
        self.cycle(CommandRequest(next(self._tickets), "ann", Command(name), carried(name, value)))

    def _answered(self, ticket: int) -> bool:
        return any(getattr(answer, "ticket", None) == ticket for answer in self.answers)

    def _answer(self, ticket: int) -> Answer:
        return next(answer for answer in reversed(self.answers) if getattr(answer, "ticket", None) == ticket)

    def enable(self) -> None:
        self.command("enable")
        assert self.mode is Mode.HOLDING

    def outcomes(self) -> list[tuple[str | None, str | None]]:
        return [(said.id, said.outcome) for said in self.notices if said.kind == "goal"]

    def setpoints(self) -> NDArray[np.float64]:
        """Rows of all cycles so far: (cycles, 6, 3), lambda_10, v_10, gamma_10, lambda_32, v_32, gamma_32."""
        return np.array(self.rows)

    def captured(self) -> NDArray[np.float64]:
        """Positions and velocities of the sliders [m, m/s] in all cycles so far: (cycles, 2, 3)."""
        return self.setpoints()[:, :2]
