"""A commissioning sets no drive up while another master is on the bus."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import NoReturn

import msgspec
import pytest
from commissioning.test_guide import ROBOT, Beside, odrives
from control_rig import CONFIG
from rigs import frame
from trirail.commissioning import opening
from trirail.config import Config
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.interface import PowerState
from trirail_drivers.simulated import SimulatedBus


class BesideService(SimulatedBus):
    """A bus on which a service sends a controlword whenever this end waits."""

    def recv(self, timeout: float | None = None) -> object:  # type: ignore[override]
        return super().recv(timeout) if not timeout else frame(0x201, b"\x0f\x00")

    def send(self, *_: object) -> None:
        raise AssertionError("nothing may be sent")


def test_no_drive_is_set_up_beside_a_service(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = simulated_bus(CONFIG.can, CONFIG.drives)
    bus.__class__ = BesideService
    monkeypatch.setattr(opening, "open_bus", lambda *_: bus)
    robot = msgspec.structs.replace(CONFIG, can=msgspec.structs.replace(CONFIG.can, interface="unix", channel="none"))
    with opening.open_steps(robot, [], Beside(), lambda: False) as steps:
        judgement, _ = steps.session.set_up()
    assert judgement.verdict == "failed"
    assert "another master is on the bus and sends PDOs" in judgement.words[0]


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def interrupt() -> NoReturn:
    """End the closing of a driver, in the way of a handler that nothing has replaced."""
    raise KeyboardInterrupt("held down")


@pytest.mark.parametrize("robot", [ROBOT, odrives()], ids=["cia402", "odrive"])
@pytest.mark.parametrize("act", [press_ctrl_c, interrupt])
def test_ctrl_c_held_down_leaves_no_drive_with_power(robot: Config, act: Callable[[], None]) -> None:
    handler = signal.getsignal(signal.SIGINT)

    def leave(person: Beside) -> None:
        with opening.open_steps(robot, [], person, lambda: False, sleep=lambda _: None) as steps:
            steps.session.set_up()
            bench = steps.session.bench()
            buses.append(steps.session.environment.bus)
            with bench.power("A"):
                bench.wait(0.1)
                monitored, wait = bench._drives._wire, bench._drives._wire.wait  # type: ignore[attr-defined]

                def waiting(*args: object) -> None:
                    act()
                    wait(*args)

                bench._stop = interrupt  # type: ignore[method-assign]
                monitored.wait = waiting
                raise KeyboardInterrupt("first")

    buses: list[object] = []
    with pytest.raises(KeyboardInterrupt):
        leave(Beside())
    (bus,) = buses
    assert isinstance(bus, SimulatedBus)
    assert signal.getsignal(signal.SIGINT) is handler
    assert PowerState.OPERATION_ENABLED not in [drive.power for drive in bus.drives]
