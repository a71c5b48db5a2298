"""A commissioning sets no drive up while another master is on the bus."""

from __future__ import annotations

import msgspec
import pytest
from commissioning.test_guide import Beside
from control_rig import CONFIG
from rigs import frame
from trirail.commissioning import opening
from trirail_drivers.connection.opening import simulated_bus
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
