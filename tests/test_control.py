"""The control over the real driver and the simulated drives: what moves, what does not, and what stops it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import CONFIG, Rig, changed
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import frames
from drivers.interface import PowerState
from service.config import geometry
from service.kinematics import forward, inverse
from service.messages import PoseGoal
from service.modes import Event, Mode
from service.motion import MotionState, rest
from service.packets import Accepted, Answer, Confirmed, GoalRequest, Refused

PERIOD = CONFIG.period
LIMITS = CONFIG.limits.slider
ROBOT = geometry(CONFIG.geometry)


def refusal(answer: Answer) -> Refused:
    assert isinstance(answer, Refused), answer
    return answer


def quick_stops(rig: Rig) -> set[int]:
    """Nodes that got the quick stop command (controlword xxxx xxxx xxxx x01x) in the last cycle."""
    return {
        message.arbitration_id - frames.RPDO1
        for message in rig.sent
        if message.arbitration_id - frames.RPDO1 in (1, 2, 3) and message.data[0] & 0b110 == 0b010
    }


def assert_within_limits(rig: Rig) -> None:
    """Setpoints as sent: velocity and acceleration by differences, inside the sliders' limits."""
    position = rig.setpoints()[:, 0]
    velocity = np.diff(position, axis=0) / PERIOD
    acceleration = np.diff(velocity, axis=0) / PERIOD
    assert np.abs(velocity).max() <= LIMITS.velocity * 1.001
    assert np.abs(acceleration).max() <= LIMITS.acceleration * 1.01  # a difference is not quite a derivative


# ---------------------------------------------------------------------- enabling


def test_nothing_moves_on_enable() -> None:
    start = (0.01, -0.02, 0.035)
    rig = Rig(changed(CONFIG, start=start))
    rig.enable()
    rig.cycles(100)
    assert [drive.servo.position for drive in rig.drives] == [round(value * 1e7) for value in start]
    assert np.max(np.ptp(rig.setpoints()[:, 0], axis=0)) < 1e-12
    assert rig.control.commanded.pose == pytest.approx(forward(ROBOT, np.array(start)).tolist(), abs=1e-12)
    assert max(map(abs, rig.control.following_error)) < 1e-7
    rig.bus.shutdown()


def test_a_robot_outside_its_limits_is_not_enabled() -> None:
    outside = inverse(ROBOT, np.array([0.2, 0.0, 0.0])).position.tolist()
    rig = Rig(changed(CONFIG, start=tuple(outside)))
    answer = refusal(rig.command("enable"))
    assert answer.code == "out_of_workspace"
    assert "platform x" in answer.message
    assert rig.mode is Mode.DISABLED
    assert all(drive.state is PowerState.SWITCH_ON_DISABLED for drive in rig.drives)
    rig.bus.shutdown()


def test_a_drive_that_does_not_power_up_is_named(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig.driver, "enable", lambda: None)
    answer = refusal(rig.command("enable"))
    assert rig.mode is Mode.FAULT
    assert "drive A is switch on disabled" in answer.message
    assert "2 s after enable" in answer.message


# ---------------------------------------------------------------------- goals


def test_a_goal_arrives_and_ends_once(rig: Rig) -> None:
    rig.enable()
    answer = rig.goal("g1", 0.05, -0.02, 0.3)
    assert isinstance(answer, Accepted)
    taken = rig.until(lambda: rig.mode is Mode.HOLDING)
    assert taken <= math.ceil(answer.duration / PERIOD) + 2
    rig.cycles(50)
    assert rig.outcomes() == [("g1", "done")]
    assert rig.control.commanded.pose == pytest.approx((0.05, -0.02, 0.3), abs=1e-9)
    assert rig.control.pose == pytest.approx((0.05, -0.02, 0.3), abs=1e-6)
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
    assert back.duration == pytest.approx(4 * full.duration, rel=1e-9)


def test_too_fast_for_a_slider_is_slowed(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.0, 0.0, 0.84)  # close to the singular angle the sliders run far for little
    rig.until(lambda: rig.mode is Mode.HOLDING)
    rig.goal("g2", 0.02, 0.02, 0.84)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.outcomes() == [("g1", "done"), ("g2", "done")]
    assert_within_limits(rig)


def test_a_new_goal_preempts_smoothly(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.08, 0.0, 0.0)
    rig.cycles(150)
    rig.goal("g2", -0.03, 0.05, -0.3)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert rig.outcomes() == [("g1", "preempted"), ("g2", "done")]
    assert_within_limits(rig)


@pytest.mark.parametrize(
    ("pose", "code", "said"),
    [
        ((0.5, 0.0, 0.0), "out_of_workspace", "platform x: position 0.5 m is beyond its limit 0.15 m"),
        ((0.0, -0.2, 0.0), "out_of_workspace", "platform y: position -0.2 m is beyond its limit -0.15 m"),
        ((0.0, 0.0, 0.9), "out_of_workspace", "platform phi: position 0.9 rad is beyond its limit 0.85 rad"),
        ((0.14, 0.14, -0.9), "out_of_workspace", "the path leads out of the workspace after"),
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
    assert rig.control.desk.goal is None


def test_an_id_is_used_once(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.05, 0.0, 0.0)
    assert refusal(rig.goal("g1", 0.01, 0.0, 0.0)).code == "duplicate_id"
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert refusal(rig.goal("g1", 0.01, 0.0, 0.0)).code == "duplicate_id"
    assert rig.outcomes() == [("g1", "done")]


# ---------------------------------------------------------------------- stopping


def test_stop_ends_in_a_standstill(rig: Rig) -> None:
    rig.enable()
    rig.goal("g1", 0.1, 0.02, 0.2)
    rig.cycles(200)
    moved = rig.control.commanded.pose[0]
    answer = rig.command("stop")
    assert isinstance(answer, Confirmed)
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
    assert isinstance(answer, Confirmed)
    assert rig.mode is Mode.DISABLED
    assert rig.outcomes() == [("g1", "stopped")]
    assert all(drive.state is PowerState.SWITCH_ON_DISABLED for drive in rig.drives)
    assert all(abs(drive.servo.velocity) < 1.0 for drive in rig.drives)
    assert_within_limits(rig)


@pytest.mark.parametrize(
    ("event", "end"),
    [(Event.GATEWAY_LOST, Mode.HOLDING), (Event.LATE, Mode.HOLDING), (Event.SHUTDOWN, Mode.DISABLED)],
)
def test_mishaps_stop_within_the_limits(rig: Rig, event: Event, end: Mode) -> None:
    rig.enable()
    rig.goal("g1", 0.1, 0.0, 0.0)
    rig.cycles(200)
    rig.control.happen(event, "it happened")
    assert rig.mode is Mode.STOPPING
    rig.until(lambda: rig.mode is end)
    assert rig.outcomes() == [("g1", "stopped")]
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
    rig.control.happen(Event.GATEWAY_LOST, "gone")
    assert refusal(rig.goal("g3", 0.0, 0.0, 0.1)).code == "stopping"
    assert rig.outcomes() == [("g1", "rejected"), ("g2", "stopped"), ("g3", "rejected")]


# ---------------------------------------------------------------------- faults


def moving(rig: Rig) -> None:
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
    assert_tripped(rig, "drive B: emergency 4310")
    assert refusal(rig.goal("g2", 0.0, 0.0, 0.0)).code == "fault"
    answer = rig.command("reset")
    assert isinstance(answer, Confirmed)
    assert rig.mode is Mode.DISABLED
    rig.cycles(200)
    assert all(drive.state is PowerState.SWITCH_ON_DISABLED for drive in rig.drives)  # never re-enabled
    rig.enable()


def test_a_silent_drive(rig: Rig) -> None:
    moving(rig)
    rig.drives[2].silent = True
    assert rig.until(lambda: rig.mode is Mode.FAULT) <= 4
    assert quick_stops(rig) == {1, 2, 3}
    assert "drive C" in (rig.control.fault or "")


def test_a_following_error(rig: Rig) -> None:
    moving(rig)
    rig.drives[0].servo.position += 0.0045 * 1e7  # something pushed the slider; the drive itself allows 5 mm
    rig.until(lambda: rig.mode is Mode.FAULT, 3)
    assert_tripped(rig, "slider A: following error")


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
def test_the_last_gate(rig: Rig, monkeypatch: pytest.MonkeyPatch, commanded: MotionState, said: str) -> None:
    moving(rig)
    sent = rig.setpoints()[-1, 0]
    plan = rig.control._plan
    assert plan is not None
    monkeypatch.setattr(plan, "at", lambda _: commanded)
    rig.cycle()
    assert rig.mode is Mode.FAULT
    assert quick_stops(rig) == {1, 2, 3}
    assert said in (rig.control.fault or "")
    assert not any(message.arbitration_id - frames.RPDO2 in (1, 2, 3) for message in rig.sent)
    assert np.abs(rig.setpoints()[-1, 0] - sent).max() < 1e-3  # what it would send is where the robot is


def test_quick_stop_is_latched_like_a_fault(rig: Rig) -> None:
    moving(rig)
    answer = rig.command("quick_stop")
    assert isinstance(answer, Confirmed)
    assert rig.mode is Mode.FAULT
    assert rig.outcomes() == [("g1", "faulted")]
    assert rig.control.fault == "quick_stop by ann"


def test_reset_waits_for_the_drives_to_stand(rig: Rig) -> None:
    moving(rig)
    rig.drives[0].fail(0x4310)
    rig.until(lambda: rig.mode is Mode.FAULT, 2)
    assert refusal(rig.command("reset")).code == "stopping"


# ---------------------------------------------------------------------- any sequence

POSE = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.5, 0.4))
STEP = st.tuples(st.one_of(POSE, st.sampled_from(["stop", "lost"])), st.integers(1, 400))


@settings(max_examples=60, deadline=None)
@given(st.lists(STEP, min_size=1, max_size=8))
def test_any_sequence_is_smooth_and_ends_every_goal_once(steps: list[tuple[object, int]]) -> None:
    rig = Rig()
    rig.enable()
    ids = []
    for number, (what, wait) in enumerate(steps):
        if isinstance(what, tuple):
            ids.append(f"g{number}")
            rig.goal(ids[-1], *what)
        elif what == "stop":
            rig.command("stop")
        else:
            rig.control.happen(Event.GATEWAY_LOST, "gone")
        rig.cycles(wait)
    rig.until(lambda: rig.mode is Mode.HOLDING)
    assert [said.kind for said in rig.happenings if said.kind == "fault"] == []
    rig.bus.shutdown()
    assert sorted(goal_id or "" for goal_id, _ in rig.outcomes()) == sorted(ids)
    assert_within_limits(rig)
