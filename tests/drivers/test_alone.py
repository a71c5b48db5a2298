"""One drive with power while the others stay without, and what rules beside simulated sliders read."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import pytest
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from trirail.config import Config
from trirail_drivers import config
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.interface import NAMES, Feedback, PowerState, Triple
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import Carriages, Servo

OFF = (PowerState.SWITCH_ON_DISABLED,) * 3
HOMING = config.Homing(method=37, speed_switch=0.02, speed_zero=0.005, acceleration=0.5)


def of(protocol: str, **keys: object) -> Config:
    """The simulated robot with drives of a protocol; B counts the other way."""
    drives = CONFIG.drives
    counts = 1e7 if protocol == "cia402" else 200.0
    for name in NAMES:
        drive = msgspec.structs.replace(
            getattr(drives, name), counts_per_metre=counts, direction=-1 if name == "B" else 1, **keys
        )
        drives = msgspec.structs.replace(drives, **{name: drive})
    return msgspec.structs.replace(CONFIG, drives=msgspec.structs.replace(drives, protocol=protocol))


class Rig:
    """Three simulated drives, their driver, and the time."""

    def __init__(self, robot: Config) -> None:
        self.now = 100.0
        self.bus = simulated_bus(robot.can, robot.drives, lambda: self.now)
        protocol = PROTOCOLS[robot.drives.protocol]
        self.drives = protocol.driver(self.bus, robot.can.timing, robot.drives, lambda: self.now)
        self.drives.configure(robot.period)
        self.period = robot.period
        self.target = self.drives.read().position
        self.feedback = self.cycle()

    def cycle(self, speed: Triple = (0.0, 0.0, 0.0)) -> Feedback:
        self.now += self.period
        self.drives.sync()
        self.feedback = self.drives.read()
        a, b, c = (place + rate * self.period for place, rate in zip(self.target, speed, strict=True))
        self.target = a, b, c
        self.drives.write(self.target, speed)
        return self.feedback

    def cycles(self, number: int, speed: Triple = (0.0, 0.0, 0.0)) -> Feedback:
        for _ in range(number):
            self.cycle(speed)
        return self.feedback


@pytest.fixture(params=["cia402", "odrive"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    made = Rig(of(request.param))
    yield made
    made.bus.shutdown()


@pytest.mark.parametrize("alone", NAMES)
def test_one_drive_moves_alone_and_the_others_stay_without_power(rig: Rig, alone: str) -> None:
    at = NAMES.index(alone)
    rig.drives.enable(alone)
    powered = set()
    for _ in range(400):
        powered.add(tuple(state is PowerState.OPERATION_ENABLED for state in rig.cycle().state))
    only = tuple(name == alone for name in NAMES)
    assert powered == {(False, False, False), only}
    rig.cycles(200, (0.005, 0.005, 0.005))  # the others would go along if they heard it
    assert rig.feedback.fault is None
    moved = [round(place, 5) for place in rig.bus.faults.carriages.read()]
    assert moved == [pytest.approx(0.001, abs=5e-5) if index == at else 0.0 for index in range(3)]
    others = [state for state, powered in zip(rig.feedback.state, only, strict=True) if not powered]
    assert others == [PowerState.SWITCH_ON_DISABLED] * 2


def test_after_one_alone_all_three_can_have_power(rig: Rig) -> None:
    rig.drives.enable("B")
    rig.cycles(300)
    rig.drives.disable()
    assert rig.cycles(300).state == OFF
    rig.drives.enable()
    assert rig.cycles(300).state == (PowerState.OPERATION_ENABLED,) * 3
    assert rig.feedback.fault is None


@pytest.mark.parametrize("struck", NAMES)
def test_a_fault_of_any_drive_stops_the_one_that_has_power(rig: Rig, struck: str) -> None:
    rig.drives.enable("A")
    rig.cycles(300)
    rig.bus.faults.add(f"{struck} fault 200")
    rig.cycles(500)
    assert rig.feedback.fault is not None
    assert rig.feedback.fault.drive == struck
    assert all(drive.power is not PowerState.OPERATION_ENABLED for drive in rig.bus.drives)


def test_one_drive_is_homed_alone() -> None:
    rig = Rig(of("cia402", homing=HOMING))
    rig.drives.enable("B")
    rig.cycles(100)
    rig.drives.home()
    before = rig.feedback
    assert before.homed == (False, False, False)
    rig.target = before.position
    for _ in range(500):
        feedback = rig.cycle()
        if feedback.homed[1] and not feedback.homing:
            break
    assert (feedback.homed, feedback.homing, feedback.fault) == ((False, True, False), False, None)
    rig.bus.shutdown()


# ---------------------------------------------------------------------- where simulated sliders really are


@pytest.mark.parametrize(
    ("lines", "rules"),
    [
        ([], (1.0, 1.0, 1.0)),
        (["A reversed"], (-1.0, 1.0, 1.0)),
        (["B scale 0.5"], (1.0, 0.5, 1.0)),
        (["B scale 2", "B reversed"], (1.0, -2.0, 1.0)),
        (["A swapped C", "C swapped A", "C scale 3"], (3.0, 1.0, 1.0)),
        (["A swapped B"], (0.0, 2.0, 1.0)),
    ],
)
@pytest.mark.long
def test_rules_read_where_sliders_really_are(rig: Rig, lines: list[str], rules: Triple) -> None:
    for line in lines:
        rig.bus.faults.add(line)
    rig.drives.enable()
    rig.cycles(300)
    rig.cycles(200, (0.005, 0.005, 0.005))
    rig.cycles(100)
    assert rig.feedback.fault is None
    assert rig.feedback.position == pytest.approx((0.001,) * 3, abs=1e-6)  # the encoders know nothing of it
    assert rig.bus.faults.carriages.read() == pytest.approx([0.001 * rule for rule in rules], abs=3e-6)


@pytest.mark.parametrize(
    ("line", "counted"), [("B loose", 0.0), ("B slips 0.25", 0.75), ("B against", 1.0), ("B stuck", 1.0)]
)
def test_an_encoder_counts_what_it_holds_on_to(rig: Rig, line: str, counted: float) -> None:
    rig.bus.faults.add(line)
    rig.cycles(3)
    before = rig.feedback.position[1]
    rig.bus.faults.carriages.push(1, 0.01)
    rig.cycles(3)
    assert rig.feedback.position[1] - before == pytest.approx(0.01 * counted, abs=1e-6)
    assert rig.bus.faults.carriages.read() == pytest.approx((0.0, 0.01, 0.0))


def test_a_slider_with_play_stays_behind_where_its_drive_turns_back(rig: Rig) -> None:
    rig.bus.faults.add("all play 0.0001")
    rig.drives.enable()
    rig.cycles(300)
    for speed, way, slider in ((0.005, 0.001, 0.00095), (-0.005, -0.001, 0.00005), (0.005, 0.0001, 0.00005)):
        before = rig.feedback.position[1]
        rig.cycles(round(way / speed * 1000), (speed,) * 3)
        rig.cycles(100)
        assert rig.feedback.position[1] - before == pytest.approx(way, abs=1e-6)
        assert rig.bus.faults.carriages.read() == pytest.approx((slider,) * 3, abs=3e-6)


ways_of_drives = st.lists(st.tuples(st.integers(0, 2), st.floats(-1e6, 1e6)), max_size=20)


@given(before=ways_of_drives, after=ways_of_drives, ratio=st.floats(0.1, 10.0), swapped=st.permutations(range(3)))
def test_rules_add_up_each_drives_way(
    before: list[tuple[int, float]], after: list[tuple[int, float]], ratio: float, swapped: list[int]
) -> None:
    scales = (1e6, -2e6, 3e6)
    servos = [Servo(0.0, time_constant=0.0, max_velocity=1.0, max_acceleration=1.0) for _ in scales]
    carriages = Carriages(servos, scales)
    wanted = [0.0, 0.0, 0.0]
    for index, way in before:
        servos[index].turn(way)
        wanted[index] += way / scales[index]
    for index, slider in enumerate(swapped):
        carriages.couple(index, slider, ratio)
    for index, way in after:
        servos[index].turn(way)
        wanted[swapped[index]] += ratio * way / scales[index]
    assert carriages.read() == pytest.approx(wanted, abs=1e-9)
