"""The bench on simulated drives that lose their master: what it says of a drive's power is what the drive does."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import msgspec
import pytest
from drivers.test_cia402 import CONFIG, Rig
from hypothesis import given
from hypothesis import strategies as st
from trirail.commissioning.bench import Bench, DrivesStoppedError
from trirail.config import SIM, load
from trirail_drivers.interface import PowerState
from trirail_drivers.simulated.device import Nmt

ROBOT = msgspec.structs.replace(load(SIM), drives=CONFIG)
WITHOUT = (PowerState.SWITCH_ON_DISABLED, PowerState.FAULT)
_UPLOAD = 0x40
"""First byte of an SDO upload request."""
WATCHDOG_S = 3.0 * CONFIG.heartbeat + 0.2


@contextlib.contextmanager
def benched() -> Iterator[tuple[Rig, Bench]]:
    """Drives that are set up, and a bench that turns their clock."""
    rig = Rig()

    def tick() -> int:
        rig.clock.now += ROBOT.period
        for device in rig.devices:
            device.poll(rig.clock.now)
        return 0

    rig.drives.configure(ROBOT.period)
    bench = Bench(ROBOT, rig.drives, tick, lambda: False)
    bench.wait(0.01)
    try:
        yield rig, bench
    finally:
        rig.drives.close()


@given(
    watches_sync=st.booleans(),
    watches_heartbeat=st.booleans(),
    reaction=st.sampled_from((0, 1, 2, 3)),
    behaviour=st.sampled_from((0, 1, 2)),
)
def test_a_drive_passes_its_watchdog_if_it_removes_its_power_by_itself(
    watches_sync: bool, watches_heartbeat: bool, reaction: int, behaviour: int
) -> None:
    """`reaction` is 6007h and `behaviour` is 1029h:01 of the drive."""
    with benched() as (rig, bench):
        drive = rig.devices[0]
        objects = drive.objects
        if not watches_sync:
            objects[0x1006, 0].value = 0
        if not watches_heartbeat:
            objects[0x1016, 1].write(0)
        objects[0x6007, 0].value, objects[0x1029, 1].value = reaction, behaviour
        with bench.power("A"):
            bench.wait(0.05)
            begun, stop = len(rig.bus.sent), rig.drives.quick_stop
            ended: list[tuple[PowerState, bool]] = []

            def stopped() -> None:
                to_drive = [
                    each for each in rig.bus.sent[begun:] if each[0] in (0x200 + drive.node, 0x600 + drive.node)
                ]
                ended.append((drive.state, any(data[0] != _UPLOAD for _, data in to_drive)))
                stop()

            rig.drives.quick_stop = stopped  # type: ignore[method-assign]
            found = bench.provoke_watchdog(WATCHDOG_S)
        state, commanded = ended[0]
        assert not commanded
        assert (found.seconds is not None) is (state in WITHOUT)
        if found.seconds is not None:  # the bench may learn by a heartbeat that no statusword comes
            assert found.seconds <= 4.0 * CONFIG.heartbeat + 0.03


@pytest.mark.parametrize("keeps_power", [True, False])
@pytest.mark.parametrize("state", [Nmt.PRE_OPERATIONAL, Nmt.STOPPED])
def test_a_drive_that_leaves_nmt_operational_with_power_is_named(state: Nmt, keeps_power: bool) -> None:
    with benched() as (rig, bench):
        drive = rig.devices[0]

        def leave() -> None:
            with bench.power("A"):
                bench.wait(0.05)
                drive.objects[0x6007, 0].value = 0
                if keeps_power:
                    rig.keep_power(0)
                drive._enter(state)
                drive._send(0x700 + drive.node, bytes([state]))
                bench.wait(0.05)

        with pytest.raises(DrivesStoppedError, match="left NMT operational") as stopped:
            leave()
        assert (drive.state is PowerState.OPERATION_ENABLED) is keeps_power
        assert ("drive A STILL HAS POWER" in str(stopped.value)) is keeps_power
