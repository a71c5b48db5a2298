"""Nothing of the driver is on the bus in the time before a SYNC, by a clock that the tests turn."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from drivers.test_cia402 import PERIOD, Rig
from rigs import OFF
from trirail_drivers.cia402 import canopen_frames as layout
from trirail_drivers.driver.driver import MAX_STEPS_LEFT_OUT
from trirail_drivers.interface import PowerState
from trirail_drivers.timing import frame_bits

ROOM = 3 * frame_bits(8) / 1e6
"""Time for a frame to each drive, at 1 Mbit/s [s]."""


@pytest.fixture
def new() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.drives.close()


def sent(rig: Rig) -> list[int]:
    taken = [identifier for identifier, _ in rig.bus.sent]
    rig.bus.sent.clear()
    return taken


@pytest.mark.parametrize(("left", "held"), [(ROOM + 1e-6, False), (ROOM - 1e-6, True), (0.0, True), (-PERIOD, True)])
def test_disable_before_a_sync_is_sent_by_the_next_write(enabled: Rig, left: float, held: bool) -> None:
    sent(enabled)
    enabled.drives.next_sync = enabled.clock() + left
    enabled.drives.disable()
    assert sent(enabled) == ([] if held else [layout.RPDO1 + drive.node for drive in enabled.devices])
    enabled.cycle()
    after = sent(enabled)
    assert after[0] == layout.SYNC
    if held:
        words = [after.index(layout.RPDO1 + drive.node) for drive in enabled.devices]
        assert max(words) < after.index(layout.RPDO2 + enabled.devices[0].node)
    assert enabled.cycles(10).state == OFF


def test_a_quick_stop_is_never_held_back(enabled: Rig) -> None:
    sent(enabled)
    enabled.drives.next_sync = enabled.clock()
    enabled.drives.quick_stop()
    assert sent(enabled) == [layout.RPDO1 + drive.node for drive in enabled.devices]


def test_a_reset_before_a_sync_clears_the_faults_in_the_next_cycle(enabled: Rig) -> None:
    failed = enabled.devices[1]
    failed.fail(0x4310)
    while enabled.cycle().fault is None:
        pass
    enabled.cycles(1200)
    sent(enabled)
    enabled.drives.next_sync = enabled.clock() + ROOM - 1e-6
    enabled.drives.reset()
    assert sent(enabled) == []
    enabled.cycle()
    after = sent(enabled)
    assert after[0] == layout.SYNC
    assert layout.RPDO1 + failed.node in after
    enabled.cycles(300)
    assert enabled.enable().state == (PowerState.OPERATION_ENABLED,) * 3


def test_a_recovery_continues_even_if_every_cycle_is_late(enabled: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[float] = []
    assert enabled.drives._recovery is not None
    monkeypatch.setattr(enabled.drives._recovery, "step", lambda now, stopping: steps.append(now))
    for cycle in range(3 * (MAX_STEPS_LEFT_OUT + 1)):
        enabled.drives._synced = enabled.clock() - PERIOD
        enabled.drives._recover()
        assert len(steps) == (cycle + 1) // (MAX_STEPS_LEFT_OUT + 1)
    enabled.drives._synced = enabled.clock()
    enabled.drives._recover()
    assert len(steps) == 4
