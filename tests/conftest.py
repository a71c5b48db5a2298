"""A robot without processes: the control over the real driver on the simulated bus, with a fake clock."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from typing import cast

import can
import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from numpy.typing import NDArray

from drivers.bus import PROTOCOLS
from drivers.simulated import SimulatedDrive, simulated_bus
from service.config import SIM, Config, load
from service.control import Control
from service.desk import Happening
from service.messages import Goal, PoseGoal
from service.modes import Mode
from service.packets import Answer, CommandRequest, GoalRequest, Request

CONFIG = load(SIM)

# How fast this machine is, or how many random robots are thrown away, says nothing of the code. What decides whether
# a change lands tries the same examples every time; by hand they are new ones at every run.
settings.register_profile(
    "trirail",
    deadline=None,
    derandomize="CI" in os.environ,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
settings.load_profile("trirail")


def changed(config: Config, **simulated: object) -> Config:
    """Change how the simulated drives behave."""
    behaviour = msgspec.structs.replace(config.can.simulated, **simulated)
    return msgspec.structs.replace(config, can=msgspec.structs.replace(config.can, simulated=behaviour))


class Rig:
    """Runs cycles of control, driver and drives, and keeps what was said and every frame that was sent."""

    def __init__(self, config: Config = CONFIG) -> None:
        self.config = config
        self.now = 100.0
        self.bus = simulated_bus(config.can, config.drives, lambda: self.now)
        self.sent: list[can.Message] = []
        self._send = self.bus.send
        self.bus.send = self._note  # type: ignore[assignment,method-assign]
        self.driver = PROTOCOLS[config.drives.protocol](self.bus, config.can.bitrate, config.drives, lambda: self.now)
        self.driver.configure(config.period)
        self.control = Control(config, self.driver)
        self.driver.sync()
        self.control.start(self.driver.read())
        self.answers: list[Answer] = []
        self.happenings: list[Happening] = []
        self.rows: list[list[list[float]]] = []
        self._tickets = itertools.count(1)

    def _note(self, message: can.Message, timeout: float | None = None) -> None:
        self.sent.append(message)
        self._send(message, timeout)

    @property
    def drives(self) -> tuple[SimulatedDrive, ...]:
        return cast(tuple[SimulatedDrive, ...], self.bus.drives)  # tests with another protocol take rig.bus.drives

    @property
    def mode(self) -> Mode:
        return self.control.state.mode

    def cycle(self, request: Request | None = None) -> None:
        """Run one cycle, with a request or without; `sent` holds its frames afterwards."""
        self.now += self.config.period
        self.sent.clear()
        control = self.control
        self.driver.sync()
        control.observe(self.driver.read())
        if request is not None:
            control.handle(request, round(self.now * 1e9))
        control.advance()
        control.solve()
        control.write()
        self.rows.append(control.rows)
        desk = control.desk
        self.answers += desk.answers
        self.happenings += desk.happenings
        desk.answers.clear()
        desk.happenings.clear()

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
        self.cycle(CommandRequest(ticket, "ann", name, value))
        self.until(lambda: self._answered(ticket))
        return self.answers[-1]

    def goal(self, id: str, x: float, y: float, phi: float, speed: float = 1.0) -> Answer:  # noqa: A002
        """Send a pose goal; return its answer."""
        return self.send(id, PoseGoal(x=x, y=y, phi=phi, speed=speed))

    def send(self, id: str, goal: Goal) -> Answer:  # noqa: A002
        """Send a goal; return its answer."""
        ticket = next(self._tickets)
        self.cycle(GoalRequest(ticket, "ann", id, goal, round(self.now * 1e9)))
        assert self._answered(ticket)
        return self.answers[-1]

    def _answered(self, ticket: int) -> bool:
        return bool(self.answers) and getattr(self.answers[-1], "ticket", None) == ticket

    def enable(self) -> None:
        self.command("enable")
        assert self.mode is Mode.HOLDING

    def outcomes(self) -> list[tuple[str | None, str | None]]:
        return [(said.id, said.outcome) for said in self.happenings if said.kind == "goal"]

    def setpoints(self) -> NDArray[np.float64]:
        """Rows of all cycles so far: (cycles, 6, 3), lambda_10, v_10, gamma_10, lambda_32, v_32, gamma_32."""
        return np.array(self.rows)


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.bus.shutdown()  # not driver.close, which waits for standstill by a clock that stands
