"""The control over the real driver and the simulated drives: what moves, what does not, and what stops it."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable

import can
import msgspec
import numpy as np
import pytest
from conftest import Delay, Rig, a_cycle, changed, one_drive_late, part_of_a_cycle
from control_rig import CONFIG, ControlRig, expected_duration
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from refusals import refusal
from trirail.config import Config, geometry
from trirail.control.modes import ModeEvent
from trirail.kinematics.robot import forward, inverse
from trirail.motion.runs import MotionState, rest
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.goals import PoseGoal, SlidersGoal, TrajectoryGoal, TrajectoryPoint, VelocityGoal
from trirail.wire.messages import FaultDetail
from trirail.wire.packets import Accepted, CommandDone, GoalRequest
from trirail.wire.vocabulary import FaultCause, Mode
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.interface import PowerState

PERIOD = CONFIG.period
ROBOT = geometry(CONFIG.geometry)


def quick_stops(rig: Rig) -> set[int]:
    """Nodes that got the quick stop command (controlword xxxx xxxx xxxx x01x) in the last cycle."""
    return {
        message.arbitration_id - canopen_frames.RPDO1
        for message in rig.sent
        if message.arbitration_id - canopen_frames.RPDO1 in (1, 2, 3) and message.data[0] & 0b110 == 0b010
    }


def assert_within_limits(rig: ControlRig) -> None:
    """Setpoints as sent: velocity and acceleration by differences, inside the sliders' limits."""
    rows, limits = rig.setpoints(), rig.config.limits.slider
    velocity = np.diff(rows[:, 0], axis=0) / PERIOD
    acceleration = np.diff(velocity, axis=0) / PERIOD
    jerk = np.diff(rows[:, 2], axis=0) / PERIOD
    assert np.abs(velocity).max() <= limits.velocities[0] * 1.001
    assert np.abs(acceleration).max() <= limits.accelerations[0] * 1.001
    assert np.abs(jerk).max() <= limits.jerks[0] * 1.001
    assert np.abs(velocity - rows[1:, 1]).max() <= limits.accelerations[0] * PERIOD  # the feed-forward is the velocity
    assert_frames_within_limits(rig)


def assert_frames_within_limits(rig: ControlRig) -> None:
    """Setpoints as the drives get them: continuous in position, velocity and acceleration, jerk inside its limit."""
    (position, velocity), limits = rig.captured().transpose(1, 0, 2), rig.config.limits.slider
    count = 1.0 / min(drive.counts_per_metre for drive in rig.config.drives.each)
    acceleration = np.diff(velocity, axis=0) / PERIOD
    jerk = np.diff(acceleration, axis=0) / PERIOD
    between = (velocity[1:] + velocity[:-1]) / 2.0
    assert np.isfinite(velocity).sum() >= 0.9 * velocity.size
    apart = np.abs(np.diff(position, axis=0) / PERIOD - between)
    assert np.nanmax(apart) <= limits.jerks[0] * PERIOD**2 + count / PERIOD
    assert np.nanmax(np.abs(velocity)) <= limits.velocities[0] * 1.001
    assert np.nanmax(np.abs(acceleration)) <= limits.accelerations[0] * 1.001 + count / PERIOD
    assert np.nanmax(np.abs(jerk)) <= limits.jerks[0] * 1.001 + 2.0 * count / PERIOD**2


# ---------------------------------------------------------------------- enabling


def test_nothing_moves_on_enable(robots: Callable[..., Rig]) -> None:
    start = (0.01, -0.02, 0.035)
    rig = robots(changed(CONFIG, start=start))
    rig.enable()
    rig.cycles(100)
    assert [drive.servo.position for drive in rig.drives] == [round(value * 1e7) for value in start]
    assert np.max(np.ptp(rig.setpoints()[:, 0], axis=0)) < 1e-12
    assert rig.control.commanded.pose == pytest.approx(forward(ROBOT, np.array(start)).tolist(), abs=1e-12)
    assert max(map(abs, rig.control.measured.following_error)) < 1e-7


def test_a_robot_outside_its_limits_holds_there_and_moves_back_alone(robots: Callable[..., Rig]) -> None:
    outside = inverse(ROBOT, np.array([0.155, 0.0, 0.0])).position.tolist()
    rig = robots(changed(CONFIG, start=tuple(outside)))
    rig.enable()
    assert any("only motion back towards them is accepted: platform x" in said.message for said in rig.notices)
    answer = refusal(rig.goal("out", 0.156, 0.0, 0.0))
    assert answer.code == "out_of_workspace"
    assert "platform x" in answer.message
    assert isinstance(rig.goal("back", 0.14, 0.0, 0.0), Accepted)
    rig.until(rig.holds, 20_000)
    assert rig.control.measured.pose == pytest.approx((0.14, 0.0, 0.0), abs=1e-5)


def test_a_drive_that_does_not_power_up_is_named(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig.driver, "enable", lambda: None)
    answer = refusal(rig.command("enable"))
    assert rig.mode is Mode.FAULT
    assert "drive A is switch on disabled" in answer.message
    assert "enabled within 2 s" in answer.message


def test_enabled_drives_whose_sliders_belong_to_no_pose_are_stopped(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """They did when enable was sent, and were moved while the drives powered up."""
    rig.order("enable")
    monkeypatch.setattr(rig.control.measured, "pose_of", lambda sliders: None)
    rig.until(lambda: rig.mode is Mode.FAULT, 100)
    said = "all drives are enabled, but the measured slider positions do not correspond to any pose"
    assert (rig.control.fault or "").startswith(said)


@pytest.mark.parametrize("name", ["disable", "quick_stop"])
def test_a_drive_that_keeps_its_power_is_named_with_its_state(rig: Rig, name: str) -> None:
    rig.enable()
    rig.drives[1].objects.on_write(0x6040, lambda entry, old: None)
    answer = refusal(rig.command(name))
    assert rig.mode is Mode.FAULT
    said = f"drive B: is operation enabled 1 s after {name.replace('_', ' ')}; expected switch on disabled"
    assert said in answer.message
    assert any(said in notice.message for notice in rig.notices if notice.kind == "fault")


# ---------------------------------------------------------------------- goals


def test_a_goal_arrives_and_ends_once(rig: Rig) -> None:
    rig.enable()
    answer = rig.goal("g1", 0.05, -0.02, 0.3)
    assert isinstance(answer, Accepted)
    taken = rig.until(lambda: rig.mode is Mode.HOLDING)
    assert taken <= math.ceil((expected_duration(answer) + CONFIG.limits.in_position.dwell) / PERIOD) + 2
    rig.cycles(50)
    assert rig.outcomes() == [("g1", "done")]
    assert rig.control.commanded.pose == pytest.approx((0.05, -0.02, 0.3), abs=1e-9)
    assert rig.control.measured.pose == pytest.approx((0.05, -0.02, 0.3), abs=1e-6)
    assert_within_limits(rig)


def test_from_rest_the_path_is_straight(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.06, -0.03, 0.3)
    poses = []
    while rig.mode is Mode.MOVING:
        poses.append(rig.control.commanded.pose)
        rig.cycle()
    share = np.array(poses) / (0.06, -0.03, 0.3)
    assert np.max(np.ptp(share, axis=1)) < 1e-9


@pytest.mark.parametrize("distance", [0.01, 0.01000000000000001])
def test_a_distance_at_which_ruckig_changes_its_profile(rig: Rig, distance: float) -> None:
    rig.enable()
    rig.goal("g1", distance, 0.0, 0.0)  # 2 a³ / j² with the configured limits
    rig.until(lambda: rig.mode is Mode.HOLDING)
    rig.goal("g2", 0.0, 0.0, 0.0)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.outcomes() == [("g1", "done"), ("g2", "done")]


def test_speed_is_a_share_of_the_time(rig: Rig) -> None:
    rig.enable()
    full = rig.goal("g1", 0.05, 0.0, 0.0)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    back = rig.goal("g2", 0.0, 0.0, 0.0, speed=0.25)
    assert isinstance(full, Accepted)
    assert isinstance(back, Accepted)
    assert expected_duration(back) == pytest.approx(4 * expected_duration(full), rel=1e-9)


def test_too_fast_for_a_slider_is_slowed(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.0, 0.0, 0.84)  # close to the singular angle the sliders run far for little
    rig.until(lambda: rig.mode is Mode.HOLDING)
    rig.goal("g2", 0.02, 0.02, 0.84)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.outcomes() == [("g1", "done"), ("g2", "done")]
    assert_within_limits(rig)


@pytest.mark.parametrize(
    ("pose", "code", "said"),
    [
        ((0.5, 0.0, 0.0), "out_of_workspace", "platform x: position 500 mm is beyond the limit of 150 mm"),
        ((0.0, -0.2, 0.0), "out_of_workspace", "platform y: position -200 mm is beyond the limit of -150 mm"),
        ((0.0, 0.0, 0.9), "out_of_workspace", "platform phi: position 51.5662° is beyond the limit of 48.7014°"),
        ((0.14, 0.14, -0.9), "out_of_workspace", "the path leaves the workspace after"),
    ],
)
def test_out_of_the_workspace(rig: Rig, pose: tuple[float, float, float], code: str, said: str) -> None:
    rig.enable()
    answer = refusal(rig.goal("g1", *pose))
    assert (answer.code, rig.mode) == (code, Mode.HOLDING)
    assert said in answer.message
    assert answer.value is not None
    assert answer.limit is not None
    rig.cycles(10)
    assert rig.outcomes() == [("g1", "rejected")]
    assert np.max(np.ptp(rig.setpoints()[:, 0], axis=0)) < 1e-12


def test_a_goal_too_late_has_expired(rig: Rig) -> None:
    rig.enable()
    goal = PoseGoal(x=0.0, y=0.0, phi=0.1, valid_for=0.5)
    rig.cycle(GoalRequest(99, "ann", "g1", goal, round((rig.now - 0.6) * 1e9)))
    assert refusal(rig.answers[-1]).code == "expired"
    assert rig.outcomes() == [("g1", "expired")]
    assert rig.control.ledger.goal is None


def test_an_id_is_used_once(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.05, 0.0, 0.0)
    assert refusal(rig.goal("g1", 0.01, 0.0, 0.0)).code == "duplicate_id"
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert refusal(rig.goal("g1", 0.01, 0.0, 0.0)).code == "duplicate_id"
    for order in ("disable", "quick_stop"):  # no goal is taken then; this one has ended all the same, and once
        rig.command(order)
        assert refusal(rig.goal("g1", 0.01, 0.0, 0.0)).code == "duplicate_id"
    assert rig.outcomes() == [("g1", "done")]


# ---------------------------------------------------------------------- stopping


def test_stop_ends_in_a_standstill(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.1, 0.02, 0.2)
    rig.cycles(200)
    moved = rig.control.commanded.pose[0]
    answer = rig.command("stop")
    assert isinstance(answer, CommandDone)
    assert answer.mode == "holding"
    assert rig.outcomes() == [("g1", "stopped")]
    assert moved < rig.control.commanded.pose[0] < 0.1
    assert rig.control.commanded.at_rest
    ratio = np.array(rig.control.commanded.pose) / (0.1, 0.02, 0.2)
    assert np.ptp(ratio) < 1e-9  # still on the line
    assert_within_limits(rig)


def test_disable_in_motion_stops_first(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.1, 0.0, 0.0)
    rig.cycles(200)
    answer = rig.command("disable")
    assert isinstance(answer, CommandDone)
    assert rig.mode is Mode.DISABLED
    assert rig.outcomes() == [("g1", "stopped")]
    assert all(drive.state is PowerState.SWITCH_ON_DISABLED for drive in rig.drives)
    assert all(abs(drive.servo.velocity) < 1.0 for drive in rig.drives)
    assert_within_limits(rig)


@pytest.mark.parametrize(
    ("mode", "name", "code"),
    [
        (Mode.DISABLED, "reset", "no_fault"),
        (Mode.HOLDING, "reset", "no_fault"),
        (Mode.FAULT, "enable", "fault"),
    ],
)
def test_commands_in_the_wrong_mode(rig: Rig, mode: Mode, name: str, code: str) -> None:
    if mode is not Mode.DISABLED:
        rig.enable()
    if mode is Mode.FAULT:
        rig.command("quick_stop")
    assert refusal(rig.command(name)).code == code
    assert rig.mode is mode


def test_goals_in_the_wrong_mode(rig: Rig) -> None:
    assert refusal(rig.goal("g1", 0.0, 0.0, 0.1)).code == "not_enabled"
    rig.enable()
    rig.goal("g2", 0.1, 0.0, 0.0)
    rig.cycles(100)
    rig.control.modes.handle_disturbance(ModeEvent.GATEWAY_LOST, coded("gone", EventCode.GATEWAY_LOST))
    assert refusal(rig.goal("g3", 0.0, 0.0, 0.1)).code == "stopping"
    assert rig.outcomes() == [("g1", "rejected"), ("g2", "stopped"), ("g3", "rejected")]


# ---------------------------------------------------------------------- feedback that is on its way


def as_it_comes(message: can.Message) -> float:
    return zlib.crc32(bytes(message.data)) % 10 * 0.1 * PERIOD


def jogged(delay: Delay | None) -> tuple[Rig, NDArray[np.float64], NDArray[np.float64]]:
    """Jog along x and back; following errors and velocities of the sliders in every cycle."""
    rig = Rig(CONFIG, delay)
    rig.enable()
    rig.cycles(5)
    errors, velocities = [], []
    for n in range(600):
        if n % 50 == 0:
            rig.send("j1" if n < 300 else "j2", VelocityGoal(0.2 if n < 300 else -0.2, 0.0, 0.0, timeout=0.2))
        else:
            rig.cycle()
        errors.append(rig.control.measured.following_error)
        velocities.append(rig.control.measured.velocity)
    rig.bus.shutdown()
    return rig, np.array(errors), np.array(velocities)


@pytest.mark.parametrize("delay", [part_of_a_cycle, a_cycle, one_drive_late, as_it_comes])
def test_a_following_error_is_the_same_however_late_it_is_known(delay: Delay) -> None:
    _, prompt, prompt_velocity = jogged(None)
    rig, late, late_velocity = jogged(delay)
    assert rig.control.fault is None
    assert np.abs(prompt).max() < 1e-4
    age = 1 if delay in (part_of_a_cycle, a_cycle) else 0
    # The same errors, each a cycle later where the answers are; a cycle at 0.2 m/s is 0.2 mm.
    assert np.abs(late[1:] - prompt[: len(prompt) - 1] if age else late - prompt)[10:].max() < 2e-5
    assert np.abs(late_velocity).max() < 1.1 * np.abs(prompt_velocity).max()


@pytest.mark.parametrize("late", [0.0, 0.4, 1.0])
def test_a_lost_answer_is_no_step_in_error_or_velocity(late: float) -> None:
    lost: list[float] = []

    def delay(message: can.Message) -> float:
        if lost and message.arbitration_id == canopen_frames.TPDO2 + 2:
            return lost.pop()
        return late * PERIOD

    rig = Rig(CONFIG, delay)
    rig.enable()
    rig.send("j1", VelocityGoal(0.2, 0.0, 0.0, timeout=2.0))
    rig.cycles(300)
    velocity = rig.control.measured.velocity
    for number in (1, 2):
        lost += [math.inf] * number
        for _ in range(6):
            rig.cycle()
            assert max(map(abs, rig.control.measured.following_error)) < 1e-4
            assert rig.control.measured.velocity == pytest.approx(velocity, rel=0.01, abs=1e-4)
        assert not lost
    assert rig.mode is Mode.MOVING
    rig.bus.shutdown()


# ---------------------------------------------------------------------- faults


def moving(rig: ControlRig) -> None:
    rig.enable()
    rig.goal("g1", 0.1, 0.0, 0.0)
    rig.cycles(150)
    assert rig.mode is Mode.MOVING


def assert_tripped(rig: Rig, said: str) -> None:
    """All three drives were stopped in the very cycle of the fault, and it is latched."""
    assert rig.mode is Mode.FAULT
    assert quick_stops(rig) == {1, 2, 3}
    assert said in (rig.control.fault or "")
    assert rig.outcomes() == [("g1", "faulted")]
    before = len(rig.rows)
    rig.cycles(1000)
    assert rig.mode is Mode.FAULT
    assert all(drive.state is not PowerState.OPERATION_ENABLED for drive in rig.drives)
    assert all(drive.servo.velocity == 0.0 for drive in rig.drives)
    assert len(rig.rows) == before + 1000


def test_a_drive_fault(rig: Rig) -> None:
    moving(rig)
    rig.drives[1].fail(0x4310)
    rig.until(lambda: rig.mode is Mode.FAULT, 2)
    said = "drive B: emergency 0x4310 (drive too hot), error register 0x09; let it cool down; check load and airflow"
    assert_tripped(rig, said)
    assert [notice.message for notice in rig.notices if notice.kind == "fault"] == [said]
    assert refusal(rig.goal("g2", 0.0, 0.0, 0.0)).code == "fault"
    answer = rig.command("reset")
    assert isinstance(answer, CommandDone)
    assert rig.mode is Mode.DISABLED
    rig.cycles(200)
    assert all(drive.state is PowerState.SWITCH_ON_DISABLED for drive in rig.drives)  # never re-enabled
    rig.enable()


def test_a_following_error(rig: Rig) -> None:
    moving(rig)
    rig.drives[0].servo.position += 0.0045 * 1e7  # something pushed the slider; the drive itself allows 5 mm
    rig.until(lambda: rig.mode is Mode.FAULT, 3)
    assert_tripped(rig, "slider A: following error")
    assert FaultDetail(FaultCause.FOLLOWING_ERROR, "A") in [notice.fault for notice in rig.notices]


@pytest.mark.parametrize(
    ("commanded", "said"),
    [
        (rest((math.nan, 0.0, 0.0)), "not a number"),
        (rest((0.0, math.inf, 0.0)), "not a number"),
        (rest((0.12, 0.0, 0.0)), "step in one cycle"),
        (rest((0.0, 0.0, math.pi / 3)), "singular"),
        (MotionState((0.05, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "velocity"),
        (MotionState((0.05, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 99.0, 0.0)), "acceleration"),
    ],
)
def test_the_last_gate(rig: Rig, commanded: MotionState, said: str) -> None:
    moving(rig)
    sent = rig.setpoints()[-1, 0]
    rig.go_on_with(commanded)
    rig.cycle()
    assert rig.mode is Mode.FAULT
    assert quick_stops(rig) == {1, 2, 3}
    assert said in (rig.control.fault or "")
    assert not any(message.arbitration_id - canopen_frames.RPDO2 in (1, 2, 3) for message in rig.sent)
    assert np.abs(rig.setpoints()[-1, 0] - sent).max() < 1e-3  # what it would send is where the robot is


def test_the_last_gate_knows_the_platforms_limits(rig: Rig) -> None:
    rig.enable()
    rig.goal("there", 0.1498, 0.0, 0.0)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    rig.goal("g1", 0.1499, 0.0, 0.0)
    rig.cycle()
    rig.go_on_with(rest((0.1502, 0.0, 0.0)))
    rig.cycle()
    assert "setpoint refused: platform x: position 150.2 mm is beyond the limit of 150 mm" in (rig.control.fault or "")
    assert quick_stops(rig) == {1, 2, 3}


def test_quick_stop_is_latched_like_a_fault(rig: Rig) -> None:
    moving(rig)
    answer = rig.command("quick_stop")
    assert isinstance(answer, CommandDone)
    assert rig.mode is Mode.FAULT
    assert rig.outcomes() == [("g1", "faulted")]
    assert rig.control.fault == "quick_stop by ann"


def test_reset_waits_for_the_drives_to_stand(rig: Rig) -> None:
    moving(rig)
    rig.drives[0].fail(0x4310)
    rig.until(lambda: rig.mode is Mode.FAULT, 2)
    assert refusal(rig.command("reset")).code == "stopping"


# ---------------------------------------------------------------------- kinds of goals, and time along the path


def test_sliders_go_straight_in_slider_space(rig: Rig) -> None:
    rig.enable()
    target = inverse(ROBOT, np.array([0.03, -0.02, 0.3])).position
    assert isinstance(rig.send("g1", SlidersGoal(tuple(target.tolist()))), Accepted)
    begun = len(rig.rows)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    share = rig.setpoints()[begun:, 0] / target
    assert np.max(np.ptp(share, axis=1)) < 1e-9
    assert rig.control.commanded.pose == pytest.approx((0.03, -0.02, 0.3), abs=1e-9)
    assert rig.outcomes() == [("g1", "done")]
    assert_within_limits(rig)


def test_sliders_out_of_reach(rig: Rig) -> None:
    rig.enable()
    answer = refusal(rig.send("g1", SlidersGoal((0.35, 0.0, 0.0))))
    assert (answer.slider, answer.limit) == ("A", 0.34)
    answer = refusal(rig.send("g2", SlidersGoal((0.2, 0.2, 0.2))))
    assert "platform phi" in answer.message


@pytest.mark.parametrize("velocity", [(0.25, 0.0, 0.0), (0.0, -0.2, 0.0), (0.0, 0.0, 1.0), (0.1, 0.1, -0.5)])
def test_a_jog_brakes_before_a_limit(rig: Rig, velocity: tuple[float, float, float]) -> None:
    rig.enable()
    for _ in range(100):
        rig.send("j1", VelocityGoal(*velocity, timeout=0.1))
        rig.cycles(29)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.control.fault is None
    assert rig.control.commanded.at_rest
    assert rig.control.setpoints._bounds.pose_violation(rig.control.commanded.pose) is None
    assert max(map(abs, rig.control.commanded.pose)) > 0.05  # it did go there
    assert_within_limits(rig)


def paper_points(number: int = 31) -> tuple[TrajectoryPoint, ...]:
    """Equation (5) of the paper for the motion along x."""
    points = []
    for k in range(number):
        t = 3.0 * k / (number - 1)
        w = math.pi / 3.0
        x, v, a = 1.0 - math.cos(w * t), w * math.sin(w * t), w * w * math.cos(w * t)
        triples = [(0.025 * value, 0.0, 0.0) for value in (x, v, a)]
        points.append(TrajectoryPoint(t, *triples[0], velocity=triples[1], acceleration=triples[2]))
    return tuple(points)


def test_a_trajectory_is_followed_in_its_time(rig: Rig) -> None:
    rig.enable()
    answer = rig.send("g1", TrajectoryGoal(paper_points()))
    assert isinstance(answer, Accepted)
    assert expected_duration(answer) == pytest.approx(3.0)
    begun = len(rig.rows) - 1
    rig.until(lambda: rig.mode is Mode.HOLDING)
    t = PERIOD * np.arange(1, 3000)
    expected = -0.025 * (1.0 - np.cos(math.pi / 3.0 * t))
    assert np.abs(rig.setpoints()[begun : begun + len(t), 0, 1] - expected).max() < 1e-9
    assert rig.outcomes() == [("g1", "done")]
    assert_within_limits(rig)


def test_trajectories_that_are_refused(rig: Rig) -> None:
    rig.enable()
    elsewhere = (TrajectoryPoint(0.0, 0.01, 0.0, 0.0), TrajectoryPoint(1.0, 0.02, 0.0, 0.0))
    assert refusal(rig.send("g1", TrajectoryGoal(elsewhere))).code == "wrong_start"
    fast = (TrajectoryPoint(0.0, 0.0, 0.0, 0.0), TrajectoryPoint(0.1, 0.1, 0.0, 0.0))
    answer = refusal(rig.send("g2", TrajectoryGoal(fast)))
    assert answer.code == "too_fast"
    assert answer.value is not None
    out = (TrajectoryPoint(0.0, 0.0, 0.0, 0.0), TrajectoryPoint(2.0, 0.2, 0.0, 0.0))
    assert refusal(rig.send("g3", TrajectoryGoal(out))).code == "out_of_workspace"
    stretched = rig.send("g4", TrajectoryGoal(fast, stretch=True))
    assert isinstance(stretched, Accepted)
    assert expected_duration(stretched) == pytest.approx(0.1 * answer.value, rel=1e-4)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert_within_limits(rig)


def test_a_trajectory_may_not_jump_into_its_acceleration(rig: Rig) -> None:
    rig.enable()
    still = (0.0, 0.0, 0.0)
    for acceleration, taken in ((0.03, True), (0.05, False)):  # within a millisecond: 30 and 50 m/s³, 40 are allowed
        points = (
            TrajectoryPoint(0.0, 0.0, 0.0, 0.0, velocity=still, acceleration=(acceleration, 0.0, 0.0)),
            TrajectoryPoint(1.0, 0.05, 0.0, 0.0, velocity=still, acceleration=still),
        )
        answer = rig.send(f"g{acceleration}", TrajectoryGoal(points))
        assert isinstance(answer, Accepted) is taken
        rig.command("stop")
        rig.goal(f"back{acceleration}", 0.0, 0.0, 0.0)
        rig.until(lambda: rig.mode is Mode.HOLDING)
    assert_within_limits(rig)


def test_pause_and_resume_stay_on_the_path(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.08, -0.04, 0.3)
    rig.cycles(180)
    assert isinstance(rig.command("pause"), CommandDone)
    assert rig.mode is Mode.HOLDING
    assert rig.control.commanded.at_rest
    assert rig.control.ledger.goal is not None
    rig.cycles(100)
    assert rig.outcomes() == []
    rig.command("resume")
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.outcomes() == [("g1", "done")]
    assert rig.control.commanded.pose == pytest.approx((0.08, -0.04, 0.3), abs=1e-9)
    poses = forward(ROBOT, rig.setpoints()[50:, 0])
    moved = np.abs(poses[:, 0]) > 1e-3
    assert np.max(np.ptp(poses[moved] / (0.08, -0.04, 0.3), axis=1)) < 1e-6
    assert_within_limits(rig)


@pytest.mark.parametrize("before", [1, 2, 5])
def test_a_goal_that_is_paused_too_late_arrives_all_the_same(rig: Rig, before: int) -> None:
    """There is no room left to stop in: nothing remains to be resumed."""
    rig.enable()
    answer = rig.goal("g1", 0.05, 0.0, 0.0)
    assert isinstance(answer, Accepted)
    rig.until(lambda: rig.control.schedule.progress[1] < (before + 0.5) * PERIOD)
    rig.command("pause")
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.control.commanded.pose == pytest.approx((0.05, 0.0, 0.0), abs=1e-9)
    assert rig.outcomes() == [("g1", "done")]
    assert refusal(rig.command("resume")).code == "not_paused"
    assert isinstance(rig.goal("g2", 0.0, 0.0, 0.0), Accepted)


@pytest.mark.parametrize("end", ["stop", "disable"])
def test_a_paused_goal_can_be_given_up(rig: Rig, end: str) -> None:
    rig.enable()
    assert refusal(rig.command("resume")).code == "not_paused"
    assert refusal(rig.command("pause")).code == "no_goal"
    rig.goal("g1", 0.08, 0.0, 0.0)
    rig.cycles(100)
    rig.command("pause")
    rig.command(end)
    assert rig.outcomes() == [("g1", "stopped")]


@pytest.mark.parametrize("percent", [20, 50, 100, 150, 200])
def test_override_is_a_share_of_the_speed_within_the_limits(rig: Rig, percent: float) -> None:
    rig.enable()
    full = rig.goal("g1", 0.05, 0.02, 0.3)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert isinstance(full, Accepted)
    rig.command("override", percent / 100.0)
    back = rig.goal("g2", 0.0, 0.0, 0.0)
    assert isinstance(back, Accepted)
    if percent <= 100:
        assert expected_duration(back) == pytest.approx(expected_duration(full) * 100.0 / percent, rel=1e-6)
    else:
        assert (
            expected_duration(full) * 100.0 / percent
            <= expected_duration(back) * (1.0 + 1e-9)
            < expected_duration(full)
        )
    rig.cycles(30)
    rig.command("override", 0.7)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.outcomes() == [("g1", "done"), ("g2", "done")]
    assert_within_limits(rig)


# ---------------------------------------------------------------------- any sequence


def slower(config: Config, **limits: float) -> Config:
    slider = msgspec.structs.replace(config.limits.slider, **limits)
    return msgspec.structs.replace(config, limits=msgspec.structs.replace(config.limits, slider=slider))


def with_sliders_of(shares: tuple[float, float, float]) -> Config:
    """The shipped robot with these shares of its sliders' velocity, acceleration and jerk."""
    limits, (v, a, j) = CONFIG.limits.slider, shares
    return slower(
        CONFIG, velocity=v * limits.velocities[0], acceleration=a * limits.accelerations[0], jerk=j * limits.jerks[0]
    )


SLOW = slower(CONFIG, velocity=0.2, acceleration=1.5, jerk=30.0)
"""Sliders for which most of the platform's motions are too fast."""

POSE = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.5, 0.4))
GOAL = st.one_of(
    POSE.map(lambda pose: PoseGoal(*pose)),
    POSE.map(lambda pose: SlidersGoal(tuple(inverse(ROBOT, np.array(pose)).position.tolist()))),
    POSE.map(lambda velocity: VelocityGoal(4.0 * velocity[0], 4.0 * velocity[1], 4.0 * velocity[2])),
)
COMMAND = st.sampled_from(["stop", "pause", "resume", "lost", 0.0, 0.3, 1.0, 1.7])
STEP = st.tuples(st.one_of(GOAL, GOAL, COMMAND), st.integers(1, 400))


STEPS = st.lists(STEP, min_size=1, max_size=10)


@pytest.mark.parametrize("config", [CONFIG, SLOW], ids=["as shipped", "slow sliders"])
@settings(max_examples=60)
@given(STEPS)
def test_any_sequence_is_smooth_and_ends_every_goal_once(config: Config, steps: list[tuple[object, int]]) -> None:
    assert_smooth(ControlRig(config), steps)


@settings(max_examples=15)
@given(STEPS)
def test_any_sequence_is_smooth_on_the_bus(steps: list[tuple[object, int]]) -> None:
    rig = Rig()
    assert_smooth(rig, steps)
    rig.bus.shutdown()


def assert_smooth(rig: ControlRig, steps: list[tuple[object, int]]) -> None:
    """Any sequence stays within the limits, ends every goal once, and is no fault."""
    rig.enable()
    ids = []
    for number, (what, wait) in enumerate(steps):
        if what == "lost":
            rig.control.modes.handle_disturbance(ModeEvent.GATEWAY_LOST, coded("gone", EventCode.GATEWAY_LOST))
        elif isinstance(what, str):
            rig.command(what)
        elif isinstance(what, float):
            rig.command("override", what)
        else:
            ids.append(f"g{number}")
            rig.send(ids[-1], what)  # type: ignore[arg-type]
        rig.cycles(wait)
    rig.command("override", 1.0)
    rig.command("stop")
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert [said.message for said in rig.notices if said.kind == "fault"] == []
    assert sorted(goal_id or "" for goal_id, _ in rig.outcomes()) == sorted(ids)
    assert_within_limits(rig)


def test_the_target_is_where_the_goal_leads(rig: Rig) -> None:
    rig.enable()
    assert rig.control.target is None
    rig.goal("a", 0.03, -0.02, 0.2)
    assert rig.control.target == pytest.approx((0.03, -0.02, 0.2))
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.control.target is None
    rig.send("b", SlidersGoal(position=(0.02, 0.0, -0.01)))
    target = rig.control.target
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert target == pytest.approx(rig.control.commanded.pose, abs=1e-9)
    rig.send("jog", VelocityGoal(x=0.01, y=0.0, phi=0.0))
    assert rig.control.target is None


def test_a_fault_says_what_it_is_about_for_programs(rig: Rig) -> None:
    rig.enable()
    rig.order("quick_stop")
    (said,) = [notice for notice in rig.notices if notice.kind == "fault"]
    assert said.fault == FaultDetail(FaultCause.QUICK_STOP)


@pytest.mark.parametrize("number", range(3))
def test_a_drives_fault_has_its_name_and_code(rig: Rig, number: int) -> None:
    rig.enable()
    rig.drives[number].fail(0x8611)
    rig.until(lambda: rig.mode is Mode.FAULT)
    first, *_ = [notice.fault for notice in rig.notices if notice.kind == "fault"]
    assert first is not None
    assert (first.drive, first.code) == ("ABC"[number], 0x8611)
    assert first.cause in ("emcy", "fault")
