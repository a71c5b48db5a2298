"""A robot without processes: the control over the real driver on the simulated bus, with a fake clock."""

from __future__ import annotations

import gc
import heapq
import itertools
import math
import os
import signal
import tempfile
import traceback
import tracemalloc
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import cast

import can
import msgspec
import numpy as np
import pytest
import trirail
from msgspec.structs import fields
from numpy.typing import NDArray
from trirail.config import SIM, Config, load
from trirail.control.control import Control, Given
from trirail.control.local_planner import LocalPlanner
from trirail.control.notices import Notice
from trirail.motion.paths import FOR_EVER, Path, constant
from trirail.motion.runs import MotionState
from trirail.wire.goals import Goal, PoseGoal
from trirail.wire.packets import Answer, CommandRequest, GoalRequest, Request
from trirail.wire.vocabulary import Command, CommandContent, Mode
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.interface import Feedback, Triple
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import SimulatedDrive

SHIPPED = load(SIM)
# In simulated time no machine keeps the drives waiting: what is lost is lost as soon as that of real ones.
CONFIG = msgspec.structs.replace(SHIPPED, drives=msgspec.structs.replace(SHIPPED.drives, missed_positions=3))

_STATE = tempfile.TemporaryDirectory(prefix="trirail-tests-")
os.environ["STATE_DIRECTORY"] = _STATE.name  # the poses that somebody has taught on this machine are no test's

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts what it runs beside it without
pytest_plugins = ["generated", "parsed_eds"]


def changed(config: Config, **simulated: object) -> Config:
    """Change how the simulated drives behave."""
    behaviour = msgspec.structs.replace(config.can.simulated, **simulated)
    return msgspec.structs.replace(config, can=msgspec.structs.replace(config.can, simulated=behaviour))


Delay = Callable[[can.Message], float]
"""How long the bus takes for a frame from a drive [s]."""


def delay_answers(bus: can.BusABC, delay: Delay, clock: Callable[[], float]) -> None:
    """Let what the drives send be received only after its delay, as on a wire, and in the order of arrival."""
    receive = bus.recv
    travelling: list[tuple[float, int, can.Message]] = []
    number = itertools.count()

    def recv(timeout: float | None = None) -> can.Message | None:
        while (message := receive(timeout)) is not None:
            wait = delay(message)
            if wait == 0.0:
                return message
            heapq.heappush(travelling, (clock() + wait, next(number), message))
        if travelling and travelling[0][0] <= clock() + 1e-9:
            return heapq.heappop(travelling)[2]
        return None

    bus.recv = recv  # type: ignore[method-assign]


def part_of_a_cycle(message: can.Message) -> float:
    return 0.4 * CONFIG.period


def a_cycle(message: can.Message) -> float:
    return CONFIG.period


def one_drive_late(message: can.Message) -> float:
    return 0.4 * CONFIG.period if message.arbitration_id == canopen_frames.TPDO2 + 2 else 0.0


FRAMES = 25
"""How deep a stack is looked into for who has allocated."""


def carried(name: str, rate: float | None = None) -> CommandContent:
    """What a command carries at least: 1 for each number that it needs, or for override a rate, 1 being full speed."""
    content = Command(name).content
    return content(*(1.0 if rate is None else 100.0 * rate for field in fields(content) if field.required))


class Cycles(ABC):
    """Runs cycles of a control, and keeps what it said."""

    control: Control

    def __init__(self) -> None:
        self.answers: list[Answer] = []
        self.notices: list[Notice] = []

    @abstractmethod
    def cycle(self, request: Request | None = None) -> None:
        """Run one cycle, with a request or without."""

    @property
    def mode(self) -> Mode:
        """The robot's mode."""
        return self.control.state.mode

    def keep_what_was_said(self) -> None:
        """Move answers and notices from the control's ledger to here."""
        ledger = self.control.ledger
        self.answers += ledger.answers
        self.notices += ledger.notices
        ledger.answers.clear()
        ledger.notices.clear()

    def cycles(self, number: int) -> None:
        """Run so many cycles."""
        for _ in range(number):
            self.cycle()

    def until(self, condition: Callable[[], bool], within: int = 5000) -> int:
        """Run cycles until something holds; return how many."""
        for number in range(within):
            if condition():
                return number
            self.cycle()
        raise AssertionError(f"not within {within} cycles; the mode is {self.mode}")


class Rig(Cycles):
    """Runs cycles of control, driver and drives, and keeps what was said and every frame that was sent."""

    def __init__(self, config: Config = CONFIG, delay: Delay | None = None) -> None:
        super().__init__()
        self.config = config
        self.now = 100.0
        self.bus = simulated_bus(config.can, config.drives, lambda: self.now)
        self.sent: list[can.Message] = []
        self._send = self.bus.send
        self.bus.send = self._note  # type: ignore[assignment,method-assign]
        driver = PROTOCOLS[config.drives.protocol].driver
        self.driver = driver(self.bus, config.can.bitrate, config.drives, lambda: self.now)
        self.driver.configure(config.period)
        if delay is not None:
            delay_answers(self.bus, delay, lambda: self.now)
        self.planner = LocalPlanner(config)
        self.control = Control(config, self.driver, self.planner)
        self.driver.sync()
        self.control.start(self.driver.read())
        self.rows: list[list[list[float]]] = []
        self.seen: list[list[tuple[int, int]]] = []
        self._tickets = itertools.count(1)

    def _note(self, message: can.Message, timeout: float | None = None) -> None:
        self.sent.append(message)
        self._send(message, timeout)

    @property
    def drives(self) -> tuple[SimulatedDrive, ...]:
        return cast(tuple[SimulatedDrive, ...], self.bus.drives)  # tests with another protocol take rig.bus.drives

    def holds(self) -> bool:
        """Whether the robot stands and is ready for a goal."""
        return self.mode is Mode.HOLDING

    def cycle(self, request: Request | None = None) -> None:
        """Run one cycle, with a request or without; `sent` holds its frames afterwards."""
        self.now += self.config.period
        self.sent.clear()
        control = self.control
        self.driver.sync()
        now_ns = round(self.now * 1e9)
        given: list[Given] = [] if request is None else [(request, now_ns)]
        given += [(answer, now_ns) for answer in self.planner.answers()]
        control.cycle(self.driver.read, given)
        self.rows.append(control.setpoints.rows)
        self.seen.append(
            [canopen_frames.SETPOINT.unpack(sent.data) for sent in self.sent if sent.arbitration_id >> 7 == 6]
        )
        self.keep_what_was_said()

    def command(self, name: str, value: float | None = None) -> Answer:
        """Send a command and run until it is answered."""
        ticket = next(self._tickets)
        self.cycle(CommandRequest(ticket, "ann", Command(name), carried(name, value)))
        self.until(lambda: self._answered(ticket))
        return self._answer(ticket)

    def goal(self, id: str, x: float, y: float, phi: float, speed: float = 1.0) -> Answer:  # noqa: A002
        """Send a pose goal; return its answer."""
        return self.send(id, PoseGoal(x=x, y=y, phi=phi, speed=speed))

    def send(self, id: str, goal: Goal) -> Answer:  # noqa: A002
        """Send a goal; return its answer."""
        ticket = next(self._tickets)
        self.cycle(GoalRequest(ticket, "ann", id, goal, round(self.now * 1e9)))
        self.until(lambda: self._answered(ticket), 50)
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
        run.path = Path(np.array([0.0, FOR_EVER]), pieces)
        run.change_law(constant(1.0), 1.0)
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
        """Setpoints and velocity offsets [m, m/s] of all cycles so far, as their frames have them: (cycles, 2, 3).

        Not a number where no setpoints were sent.
        """
        scale = np.array([drive.counts_per_metre * drive.direction for drive in self.config.drives.each])
        offset = np.array([drive.offset for drive in self.config.drives.each])
        nothing = [(math.nan, math.nan)] * 3
        counts = np.array([sent if len(sent) == 3 else nothing for sent in self.seen])
        return np.stack([counts[:, :, 0] / scale + offset, counts[:, :, 1] / scale], axis=1)


class Followers:
    """Powered drives that are where they were told to be: no bus, no frames, and next to no memory of their own."""

    bus_load = 0.0
    missing_protections = ()
    traffic = 0

    def __init__(self, feedback: Feedback) -> None:
        self._feedback = feedback._replace(warnings=())
        self._due = feedback.position, feedback.position

    def sync(self) -> None:
        """Reach what was written a cycle before the last one."""
        self._feedback = self._feedback._replace(position=self._due[0], age=(0, 0, 0))

    def read(self) -> Feedback:
        return self._feedback

    def write(self, position: Triple, velocity: Triple) -> None:
        self._due = self._due[1], position


def alone(check: Callable[[], None]) -> None:
    """Check something in a copy of this process, in which no thread of another test runs; fail as it fails."""
    gc.collect()  # what others have left is not taken apart in the copy
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the copy takes no lock that another thread may hold
        pid = os.fork()
    if pid == 0:
        said = ""
        try:
            check()
        except BaseException:  # noqa: BLE001 - all of it is told
            said = traceback.format_exc()
        os.write(writing, said.encode()[-60_000:])  # a pipe holds that much
        os._exit(0)
    os.close(writing)
    with open(reading, encoding="utf-8", errors="replace") as told:
        said = told.read()
    _, status = os.waitpid(pid, 0)
    if said or status:
        pytest.fail(said or f"the copy ended with status {status}", pytrace=False)


def what_memory_takes(cycle: Callable[[], None], cycles: int) -> tuple[int, int]:
    """Return by how many bytes memory grows in so many cycles, and how many are in use for a moment at most.

    Of all threads: to be called `alone`. Without the garbage collector, as the loop runs. The cycles before are for
    what is made once, and for the tuples that CPython keeps for later: 2000 of each length, then no more. Only what
    code of the package has allocated, called from here, counts as grown.
    """
    gc.disable()
    tracemalloc.start(FRAMES)
    try:
        for _ in range(2500):
            cycle()
        before = _allocated_here()
        in_use = _peak(cycle, cycles)
        grown = _allocated_here().compare_to(before, "lineno")
    finally:
        tracemalloc.stop()
        gc.enable()
    return sum(line.size_diff for line in grown), in_use


def _peak(cycle: Callable[[], None], cycles: int) -> int:
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    for _ in range(cycles):
        cycle()
    _, peak = tracemalloc.get_traced_memory()
    return peak - held


def _allocated_here() -> tracemalloc.Snapshot:
    """Return what is held that code of the package has allocated, called from here."""
    found = tracemalloc.take_snapshot()
    for one in (f"{os.path.dirname(trirail.__file__)}/*", __file__):
        found = found.filter_traces([tracemalloc.Filter(True, one, all_frames=True)])
    return found


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.bus.shutdown()  # not driver.close, which waits for standstill by a clock that stands


@pytest.fixture(scope="module")
def locator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where a service on simulated drives is, one for all tests of a module."""
    from trirail.client import own_service

    folder = tmp_path_factory.mktemp("service")
    config, locator = own_service.private(folder)
    with own_service.service(config, folder / "session.rrd"):
        yield locator
