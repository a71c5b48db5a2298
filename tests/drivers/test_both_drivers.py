"""What the CiA 402 driver and the ODrive driver have in common: the same runs, each on its own simulated drives."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from rigs import ENABLED, STANDSTILL, START, STEP, DriverRig
from trirail_drivers.errors import BusError

from drivers import test_cia402, test_odrive

AnyRig = DriverRig[Any, Any]


@pytest.fixture(params=[test_cia402.Rig, test_odrive.Rig], ids=["cia402", "odrive"])
def new(request: pytest.FixtureRequest) -> Iterator[AnyRig]:
    """Drives that were just switched on."""
    rig = request.param()
    yield rig
    rig.drives.close()


def test_a_dead_bus_cannot_be_set_up(new: AnyRig) -> None:
    new.bus.broken = True
    with pytest.raises(BusError, match="cannot send"):
        new.drives.configure(STEP)


def test_the_time_between_set_up_and_first_cycle_is_no_loss(ready: AnyRig) -> None:
    ready.clock.now += 30.0
    assert ready.cycles(3).fault is None


def test_nothing_moves_on_enabling(ready: AnyRig) -> None:
    ready.enable()
    feedback = ready.cycles(50)
    assert feedback.position == pytest.approx(START, abs=1e-6)
    assert feedback.fault is None


def test_reset_of_drives_that_follow_setpoints_takes_no_power(enabled: AnyRig) -> None:
    enabled.drives.reset()
    feedback = enabled.cycles(1500)
    assert (feedback.fault, feedback.state) == (None, ENABLED)


@pytest.mark.parametrize("stop", ["disable", "quick_stop"])
@pytest.mark.parametrize("later", [200, 400])
def test_drives_that_are_enabled_again_in_time_keep_their_power(enabled: AnyRig, stop: str, later: int) -> None:
    getattr(enabled.drives, stop)()
    enabled.cycles(later)
    enabled.enable()
    feedback = enabled.cycles(1500)
    assert (feedback.fault, feedback.state) == (None, ENABLED)


def test_bus_off_is_a_fault(enabled: AnyRig) -> None:
    enabled.bus.inject(0x040, bytes(8), is_error_frame=True)
    fault = enabled.found("bus", within=1).fault
    assert fault is not None
    assert "bus-off" in fault.message


def test_setpoints_after_the_next_tick_are_counted_as_late(ready: AnyRig) -> None:
    ready.drives.sync()
    position = ready.drives.read().position
    ready.clock.now += 1.5 * STEP
    ready.drives.write(position, STANDSTILL)
    assert [count.setpoints_late for count in ready.cycle().counts] == [1, 1, 1]


def test_closed_twice_is_closed_once(enabled: AnyRig) -> None:
    enabled.drives.close()
    enabled.bus.sent.clear()
    enabled.drives.close()
    assert enabled.bus.sent == []
    assert enabled.bus.shutdowns == 1


def test_closing_on_a_dead_bus_shuts_it_down(enabled: AnyRig) -> None:
    enabled.bus.broken = True
    enabled.drives.close()
    assert enabled.bus.shutdowns == 1


def test_silence_is_a_fault_at_the_third_sync(ready: AnyRig) -> None:
    ready.cycle()
    ready.devices[1].silent = True
    assert ready.cycle().fault is None
    assert ready.cycle().fault is None
    fault = ready.cycle().fault
    assert fault is not None
    assert fault[:3] == ("B", "silent", 0)
