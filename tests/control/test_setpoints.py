"""What is commanded while the robot has no power, and what the drives get when it has: where the sliders are."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import Rig, changed
from control.test_control import ROBOT
from control_rig import CONFIG, OFF, ON, ControlRig, PerfectDrives
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.kinematics.robot import inverse
from trirail.wire.event_codes import EventCode
from trirail.wire.packets import Accepted, CommandDone
from trirail.wire.vocabulary import Mode
from trirail_drivers.interface import Feedback, PowerState, Triple

STEP = 0.5 * CONFIG.limits.slider.velocities[0] * CONFIG.period
"""How far a slider is pushed in a cycle [m]."""
ELSEWHERE = (0.02, -0.015, 0.1)
"""Where the platform is pushed to by hand: x, y [m], phi [rad]."""


def push(rig: Rig, pose: tuple[float, float, float]) -> None:
    """Push the sliders by hand, as the platform goes to a pose."""
    begin, end = rig.control.measured.feedback.position, inverse(ROBOT, np.array(pose)).position
    cycles = int(np.abs(end - begin).max() / STEP) + 1
    for share in np.arange(1, cycles + 1) / cycles:
        for drive, own, metres in zip(rig.drives, rig.config.drives.each, begin + share * (end - begin), strict=True):
            counts = own.direction * (metres - own.offset) * own.counts_per_metre
            drive.servo.position = drive.servo.setpoint = counts
            drive.objects[0x6064, 0].value = round(counts)
        rig.cycle()
    rig.cycles(3)


def assert_told(rig: Rig, pose: tuple[float, float, float]) -> None:
    """All that is told of the sliders, the passive ones among it, is that of a pose at rest."""
    motion = inverse(ROBOT, np.array(pose))
    expected = np.zeros((6, 3))
    expected[0], expected[3] = motion.position, motion.passive_position
    assert rig.setpoints()[-1] == pytest.approx(expected, abs=2e-7)
    assert rig.control.commanded.pose == pytest.approx(pose, abs=2e-6)
    assert rig.control.commanded.at_rest


@pytest.mark.parametrize("ended_by", ["disable", "quick_stop"])
def test_a_robot_that_is_pushed_after_a_motion_is_enabled_where_it_was_pushed(rig: Rig, ended_by: str) -> None:
    rig.enable()
    rig.goal("g1", -0.05, 0.03, -0.2)
    rig.cycles(100)
    rig.command(ended_by)
    rig.cycles(500)
    if ended_by == "quick_stop":
        rig.command("reset")
    push(rig, ELSEWHERE)
    assert_told(rig, ELSEWHERE)
    rig.enable()
    rig.cycles(10)
    assert rig.control.fault is None
    assert_told(rig, ELSEWHERE)
    assert isinstance(rig.goal("g2", 0.0, 0.0, 0.0), Accepted)
    rig.until(rig.holds)
    assert_told(rig, (0.0, 0.0, 0.0))


@pytest.mark.parametrize("end", [Mode.DISABLED, Mode.FAULT])
def test_of_a_robot_without_power_no_motion_is_told(rig: Rig, end: Mode) -> None:
    rig.enable()
    rig.goal("g1", -0.05, 0.03, -0.2)
    rig.cycles(100)
    rig.command("disable" if end is Mode.DISABLED else "quick_stop")
    rig.cycles(500)
    assert rig.mode is end
    assert_told(rig, rig.control.measured.pose)


def test_the_first_cycle_already_knows_where_the_sliders_are() -> None:
    pose = (0.02, -0.015, 0.1)
    a, b, c = inverse(ROBOT, np.array(pose)).position.tolist()
    rig = Rig(changed(CONFIG, start=(a, b, c)))
    rig.cycle()
    assert_told(rig, pose)
    rig.bus.shutdown()


def test_a_jammed_slider_whose_drive_is_deaf_to_the_stop_does_not_jump_when_it_comes_free(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.1, 0.0, 0.0)
    rig.cycles(100)
    drive = rig.drives[1]
    drive.objects.on_write(0x6040, lambda entry, old: None)
    drive.servo.forced_velocity = 0.0
    rig.until(lambda: rig.mode is Mode.FAULT)
    rig.cycles(100)
    assert drive.state is PowerState.OPERATION_ENABLED
    jammed = drive.servo.position
    drive.servo.forced_velocity = None
    rig.cycles(100)
    assert abs(drive.servo.position - jammed) <= 2.0


@pytest.mark.parametrize("pushed", [0.0, 0.19])
def test_a_slider_that_moves_while_its_brake_opens_is_held_where_it_then_is(rig: Rig, pushed: float) -> None:
    """Without power and brake a vertical slider sags. 0.19 m is beyond the travel."""
    for drive, seconds in zip(rig.drives, (0.0, 0.02, 0.3), strict=True):
        drive.power_up_time = seconds
    rig.order("enable")
    counts = CONFIG.drives.A.direction * CONFIG.drives.A.counts_per_metre
    for _ in range(200):
        for drive in rig.drives:
            if drive.state is not PowerState.OPERATION_ENABLED:
                drive.servo.push(-pushed / 200.0 * counts)
        rig.cycle()
    assert not rig.holds()
    rig.until(rig.holds)
    rig.cycles(100)
    assert rig.holds()
    assert rig.control.measured.position[2] == pytest.approx(-pushed, abs=1e-6)
    warned = [said.event_code for said in rig.notices if said.level == "warning"]
    assert warned == [EventCode.OUTSIDE_LIMITS] * (pushed > 0.0)


class SlowDrives(PerfectDrives):
    """Perfect drives, each of which needs a time to power up, in which a person pushes its slider."""

    def __init__(self, pushed: Triple, cycles: tuple[int, int, int]) -> None:
        """`pushed`: how far each slider is pushed [m]; `cycles`: after how many cycles each drive has power."""
        super().__init__()
        self._pushed, self._cycles = pushed, cycles
        self._since = 0
        self._states = OFF

    def sync(self) -> None:
        """Push the sliders without power; those with power follow their setpoints."""
        super().sync()
        if self._state is ON:
            self._since += 1
            powered = [self._since >= own for own in self._cycles]
            a, b, c = (
                due if on else min(1.0, self._since * STEP / max(abs(far), STEP)) * far
                for due, on, far in zip(self._due[0], powered, self._pushed, strict=True)
            )
            self._position = a, b, c
            a, b, c = (on if has else off for has, on, off in zip(powered, ON, OFF, strict=True))
            self._states = a, b, c

    def read(self) -> Feedback:
        """Tell which drives have power."""
        return super().read()._replace(state=self._states)


@settings(max_examples=60)
@given(
    st.tuples(*[st.floats(-0.25, 0.25)] * 2, st.floats(-1.4, 1.4)),
    st.tuples(*[st.integers(0, 1000)] * 3),
)
@example((0.0, 0.0, -1.09), (1000, 1000, 1000))  # slider A beyond its travel
@example((0.0, 0.0, 1.2), (1000, 1000, 1000))  # beyond the singular pose
@example((0.01, 0.0, 0.1), (1000, 1000, 1000))
@example((0.155, 0.0, 0.0), (3, 40, 1000))
def test_sliders_pushed_during_a_power_up_are_judged_as_if_they_had_been_there_before(
    pose: Triple, cycles: tuple[int, int, int]
) -> None:
    a, b, c = inverse(ROBOT, np.array(pose)).position.tolist()
    rig = ControlRig(driver=SlowDrives((a, b, c), cycles))
    answer = rig.command("enable")
    before = ControlRig(driver=PerfectDrives(rig.control.measured.position))
    assert isinstance(before.command("enable"), CommandDone) is isinstance(answer, CommandDone)
    told, expected = ([said.message for said in one.notices if said.level != "info"] for one in (rig, before))
    if rig.mode is Mode.HOLDING:
        assert told == expected
        assert len(told) <= 1
    else:
        assert rig.mode is Mode.FAULT
        assert before.mode is Mode.DISABLED
        assert told[0].startswith("all drives are enabled, but the ")
