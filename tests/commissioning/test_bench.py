"""The bench on simulated drives that lose their master: what it says of a drive's power is what the drive does."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
from commissioning.test_guide import ROBOT as GUIDED
from commissioning.test_guide import Beside, odrives, with_drives
from drivers.test_cia402 import CONFIG, Rig
from hypothesis import given
from hypothesis import strategies as st
from trirail.commissioning.bench import Bench, DrivesStoppedError
from trirail.commissioning.opening import open_steps
from trirail.config import SIM, Config, load
from trirail_drivers.config import Homing
from trirail_drivers.interface import PowerState
from trirail_drivers.simulated import SimulatedBus
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


@pytest.mark.parametrize("robot", [GUIDED, odrives()], ids=["cia402", "odrive"])
@pytest.mark.parametrize("speed", [0.02, -0.1])
def test_a_slider_that_runs_away_from_a_stop_loses_its_power(robot: Config, speed: float) -> None:
    """Its motor has wrong phases: no ramp brakes it."""
    with open_steps(robot, [f"when A enabled A runaway {speed}"], Beside(), lambda: False, lambda _: None) as steps:
        steps.session.set_up()
        rules, bus = steps.session.environment.rules, steps.session.environment.bus
        assert rules is not None
        assert isinstance(bus, SimulatedBus)
        start = rules.read()[0]
        judgement, _ = steps.power("A")
        assert abs(rules.read()[0] - start) < 0.01
        assert PowerState.OPERATION_ENABLED not in [drive.power for drive in bus.drives]
    assert judgement.verdict == "failed"
    assert "following error" in judgement.words[0]
    assert "slider A: ran on by" in judgement.words[0]


def test_a_stop_of_a_homing_is_left_its_ramp() -> None:
    """At this speed, the ramp takes more than the travel that a slider may run on."""
    homing = Homing(method=19, speed_switch=0.2, speed_zero=0.005, acceleration=5.0)
    robot = with_drives(GUIDED, homing=homing)
    simulated = msgspec.structs.replace(robot.can.simulated, start=(0.2, 0.0, 0.0))
    robot = msgspec.structs.replace(robot, can=msgspec.structs.replace(robot.can, simulated=simulated))
    pressed = False
    with open_steps(robot, [], Beside(), lambda: pressed, lambda _: None) as steps:
        steps.session.set_up()
        bench, rules = steps.session.bench(), steps.session.environment.rules
        assert rules is not None
        start, positions = rules.read()[0], [rules.read()[0]]

        def write(*setpoints: tuple[float, float, float]) -> None:
            nonlocal pressed
            positions.append(rules.read()[0])
            pressed = pressed or abs(positions[-1] - start) > 0.03
            apply(*setpoints)

        apply = bench._drives.write
        vars(bench._drives).update(write=write)
        with pytest.raises(KeyboardInterrupt) as stopped:
            steps.home("A")
    speeds = np.abs(np.diff(positions)) / robot.period
    assert speeds.max() > 0.19
    assert "ran on" not in str(stopped.value)


def test_no_drive_gets_power_while_a_slider_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one that a person pushes, or that falls."""
    with benched() as (rig, bench):
        device = rig.devices[1]
        poll = device.poll

        def pushed(now: float) -> None:
            device.servo.position += 20.0
            poll(now)

        monkeypatch.setattr(device, "poll", pushed)
        with pytest.raises(DrivesStoppedError, match=r"^slider B: moved -?\d+\.\d{3} mm without power"), bench.power():
            pass
        assert all(state is PowerState.SWITCH_ON_DISABLED for state in bench.feedback.state)


def test_a_fault_that_stays_is_named_and_no_drive_gets_power() -> None:
    with benched() as (rig, bench):
        rig.devices[1].silent = True
        bench.wait(0.1)
        assert bench.feedback.fault is not None
        with pytest.raises(DrivesStoppedError, match=r"^the fault cannot be reset: .*drive B"), bench.power("A"):
            pass
        assert PowerState.OPERATION_ENABLED not in bench.feedback.state
