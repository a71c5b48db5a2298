"""Goals of every kind at any moment: they arrive in time, wait for each other, and end exactly once."""

from __future__ import annotations

import itertools
import math
import random
from collections import Counter

import msgspec
import numpy as np
import pytest
from conftest import Rig
from control.test_control import PERIOD, ROBOT, SLOW, assert_within_limits, slower
from control_rig import CONFIG, ControlRig, expected_duration
from numpy.typing import NDArray
from refusals import refusal
from ruckig import InputParameter, Ruckig, Synchronization, Trajectory
from trirail.config import Config
from trirail.errors import KinematicsError
from trirail.kinematics.geometry import LEGS
from trirail.kinematics.robot import forward, inverse
from trirail.motion.goal_planner import GoalPlanner, PlannedMotion
from trirail.motion.path_planner import TOO_FAST_IN_MOTION
from trirail.motion.quintic import Point, quintic
from trirail.motion.schedule import Schedule
from trirail.wire.goals import (
    Goal,
    OwnLimits,
    PoseGoal,
    SlidersGoal,
    TrackGoal,
    TrajectoryGoal,
    TrajectoryPoint,
    VelocityGoal,
)
from trirail.wire.packets import Accepted, Answer, CommandRequest, GoalRequest
from trirail.wire.vocabulary import Command, Mode, Stop

MEDIUM = slower(CONFIG, velocity=0.3, acceleration=4.5, jerk=120.0)
"""Sliders for which the platform's motions are a little too fast."""

DIRECTIONS = [np.array(d) * (0.15, 0.15, 0.85) for d in itertools.product((-1, 0, 1), repeat=3) if any(d)]


def outermost(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """The last pose inside every limit on the straight way from the centre."""
    platform, slider = CONFIG.limits.platform, CONFIG.limits.slider
    low, high = 0.0, 2.0
    for _ in range(60):
        middle = (low + high) / 2.0
        pose = middle * direction
        try:
            solved = inverse(ROBOT, pose)
        except KinematicsError:
            high = middle
            continue
        inside = all(
            limits[0] <= value <= limits[1]
            for values, bounds in (
                (pose, (platform.x, platform.y, platform.phi)),
                (solved.position, slider.positions),
                (solved.passive_position, [slider.passive] * 3),
            )
            for value, limits in zip(values, bounds, strict=True)
        )
        low, high = (middle, high) if inside else (low, middle)
    return low * direction


def accepted(answer: Answer) -> Accepted:
    assert isinstance(answer, Accepted), answer
    return answer


def stands(rig: ControlRig) -> bool:
    return rig.mode is Mode.HOLDING and rig.control.goal_queue.idle


def bare(start: tuple[float, float, float], end: tuple[float, float, float]) -> float:
    """How long Ruckig itself takes from rest to rest, within what plans use of the platform's limits."""
    limits = CONFIG.limits.platform
    request, trajectory = InputParameter(3), Trajectory(3)
    request.current_position, request.target_position = list(start), list(end)
    request.max_velocity = [0.995 * v for v in limits.velocity]
    request.max_acceleration = [0.98 * a for a in limits.acceleration]
    request.max_jerk = [0.957 * j for j in limits.jerk]
    request.synchronization = Synchronization.Phase
    Ruckig(3).calculate(request, trajectory)
    return float(trajectory.duration)


# ---------------------------------------------------------------------- arrival


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


@pytest.mark.parametrize("end", [(0.05, 0.0, 0.0), (0.02, -0.06, 0.1), (-0.1, 0.03, -0.4), (0.0, 0.0, 0.02)])
def test_no_later_than_ruckig_itself(rig: ControlRig, end: tuple[float, float, float]) -> None:
    rig.enable()
    answer = accepted(rig.goal("g1", *end))
    assert answer.reply.slowed == 1.0
    taken = 1 + rig.until(rig.holds)
    dwell = CONFIG.limits.in_position.dwell
    assert taken <= math.ceil((bare((0.0, 0.0, 0.0), end) + dwell) / PERIOD) + 2


@pytest.mark.long
@pytest.mark.parametrize("config", [CONFIG, SLOW], ids=["as shipped", "slow sliders"])
def test_the_corners_of_the_workspace(config: Config) -> None:
    rig = ControlRig(config)
    rig.enable()
    for number, direction in enumerate(DIRECTIONS):
        corner = outermost(direction)
        beyond = corner + 1e-5 * direction / np.linalg.norm(direction)
        assert refusal(rig.goal(f"beyond{number}", *beyond.tolist())).code == "out_of_workspace"
        assert rig.mode is Mode.HOLDING
        accepted(rig.goal(f"corner{number}", *corner.tolist()))
        rig.until(rig.holds)
        assert rig.control.commanded.pose == pytest.approx(corner.tolist(), abs=1e-9)
        accepted(rig.goal(f"back{number}", 0.0, 0.0, 0.0))
        rig.until(rig.holds)
    assert rig.control.fault is None
    assert_within_limits(rig)


@pytest.mark.parametrize("leg", range(3))
@pytest.mark.parametrize("beyond", [-1e-5, 0.0, 2e-6])
def test_the_very_end_of_a_sliders_travel(rig: ControlRig, leg: int, beyond: float) -> None:
    limits = CONFIG.limits.slider.positions[leg]
    target = inverse(ROBOT, np.array([0.02, -0.01, 0.2])).position
    target[leg] = limits[0] - beyond
    rig.enable()
    answer = rig.send("g1", SlidersGoal(tuple(target.tolist())))
    if beyond > 0.0:
        assert (refusal(answer).slider, refusal(answer).limit) == (LEGS[leg], limits[0])
    elif isinstance(answer, Accepted):
        rig.until(rig.holds)
        assert rig.outcomes() == [("g1", "done")]
    else:  # the platform's own limits are nearer
        assert "platform" in refusal(answer).message or "passive" in refusal(answer).message


@pytest.mark.long
@pytest.mark.parametrize(("coordinate", "end"), [(0, 0), (0, 1), (1, 1)])
@pytest.mark.parametrize("at", [1.38, 1.40, 1.42, 1.44])  # of these at most one peak can be where it is looked anyway
def test_a_path_may_not_peak_beyond_a_limit_between_its_ends(
    rig: ControlRig, at: float, coordinate: int, end: int
) -> None:
    """Both ends inside, and by how much the middle is outside is less than what lies between two looks."""
    rig.enable()
    limit = (CONFIG.limits.platform.x, CONFIG.limits.platform.y)[coordinate][end]
    ends = TrajectoryPoint(0.0, 0.0, 0.0, 0.0), TrajectoryPoint(3.0, 0.0, 0.0, 0.0)

    def through(place: float) -> tuple[TrajectoryPoint, ...]:
        x, y, phi = (np.eye(3)[coordinate] * place).tolist()
        velocity, acceleration = (0.3 * x, 0.3 * y, 0.0), (-2.0 * x, -2.0 * y, 0.0)
        return ends[0], TrajectoryPoint(at, x, y, phi, velocity=velocity, acceleration=acceleration), ends[1]

    points = [Point(p.t, (p.x, p.y, p.phi), p.velocity, p.acceleration) for p in through(1.0)]
    path, t = quintic(points, (0.0, 0.0, 0.0)), np.linspace(0.0, 3.0 - at, 200_001)
    highest = float((path.pieces[1, coordinate] @ t ** np.arange(6.0)[:, None]).max())  # a while after the point
    room = math.copysign(2e-6, limit)
    beyond = refusal(rig.send("g1", TrajectoryGoal(through((limit + room) / highest))))
    assert (beyond.code, f"platform {'xy'[coordinate]}: position" in beyond.message) == ("out_of_workspace", True)
    accepted(rig.send("g2", TrajectoryGoal(through((limit - room) / highest))))
    rig.until(rig.holds)
    assert rig.control.fault is None


@pytest.mark.parametrize("by", [1.002, 1.005, 1.009])
@pytest.mark.parametrize("quantity", ["velocity", "acceleration"])
def test_a_path_that_is_hardly_too_fast_is_slowed(quantity: str, by: float) -> None:
    """For sliders whose limit is so many times less than what it takes at the platform's own."""
    row = ("velocity", "acceleration").index(quantity)

    def used(config: Config) -> float:
        rig = ControlRig(config)
        rig.enable()
        rig.goal("g1", 0.1, 0.02, 0.2)
        rig.until(rig.holds)
        return float(np.abs(rig.setpoints()[:, 1 + row]).max())

    planned = used(CONFIG) / by ** (1 + row)
    assert used(slower(CONFIG, **{quantity: planned / 0.98})) <= planned * (1.0 + 2e-3)  # between two looks


def test_slowed_is_said(rig: ControlRig) -> None:
    rig.enable()
    rig.goal("g1", 0.0, 0.0, 0.84)
    rig.until(rig.holds)
    answer = accepted(rig.goal("g2", 0.03, 0.03, 0.84))
    assert answer.reply.slowed > 1.05
    assert expected_duration(answer) == pytest.approx(
        answer.reply.slowed * bare((0.0, 0.0, 0.84), (0.03, 0.03, 0.84)), rel=1e-3
    )
    half = accepted(rig.goal("g3", 0.0, 0.0, 0.84, speed=0.1))
    assert half.reply.slowed == 1.0  # slow enough as it is


# ---------------------------------------------------------------------- a goal's own limits


@pytest.mark.parametrize(
    ("own", "most"),
    [
        (OwnLimits(velocity=(0.02, 0.02, 0.1)), (0.02, math.inf, math.inf)),
        (OwnLimits(acceleration=(0.1, 0.1, 1.0)), (math.inf, 0.1, math.inf)),
        (OwnLimits(jerk=(2.0, 2.0, 20.0)), (math.inf, math.inf, 2.0)),
        (OwnLimits((0.02, 0.02, 0.1), (0.1, 0.1, 1.0), (2.0, 2.0, 20.0)), (0.02, 0.1, 2.0)),
    ],
)
def test_own_limits_are_kept_and_made_use_of(rig: ControlRig, own: OwnLimits, most: tuple[float, float, float]) -> None:
    rig.enable()
    accepted(rig.send("g1", PoseGoal(0.05, 0.0, 0.0, limits=own)))
    motion = []
    while rig.mode is Mode.MOVING:
        motion.append((rig.control.commanded.velocity[0], rig.control.commanded.acceleration[0]))
        rig.cycle()
    velocity, acceleration = np.transpose(motion)
    used = np.array([np.abs(row).max() for row in (velocity, acceleration, np.diff(acceleration) / PERIOD)]) / most
    assert used.max() == pytest.approx(1.0, rel=1e-3)


def test_own_limits_above_the_robots_are_refused(rig: ControlRig) -> None:
    rig.enable()
    answer = refusal(rig.send("g1", PoseGoal(0.05, 0.0, 0.0, limits=OwnLimits(velocity=(0.1, 0.3, 1.0)))))
    assert (answer.code, answer.value, answer.limit) == ("above_limit", 0.3, 0.25)
    assert "limits.velocity of y" in answer.message
    assert rig.mode is Mode.HOLDING


# ---------------------------------------------------------------------- goals that wait


SQUARE = [(0.05, 0.0, 0.0), (0.05, 0.05, 0.1), (0.0, 0.05, 0.0), (0.0, 0.0, 0.0)]


def square(rig: ControlRig, blend: float | None, speed: float = 1.0) -> int:
    """Send a square at once; return how many cycles it takes."""
    for number, pose in enumerate(SQUARE):
        accepted(rig.send(f"q{number}", PoseGoal(*pose, blend=blend, speed=speed)))
    begun = len(rig.rows)
    rig.until(rig.holds, 20_000)
    return len(rig.rows) - begun


@pytest.mark.parametrize("blend", [0.0, 0.005, 0.02])
def test_goals_wait_and_blend_within_their_radius(rig: ControlRig, blend: float) -> None:
    rig.enable()
    square(rig, blend)
    assert rig.outcomes() == [(f"q{number}", "done") for number in range(4)]
    poses = forward(ROBOT, rig.setpoints()[:, 0])
    for pose in SQUARE:
        near = np.hypot(*(poses[:, :2] - pose[:2]).T) + 0.3 * np.abs(poses[:, 2] - pose[2])
        assert near.min() <= blend + 2e-8  # from motion Ruckig's own ends are off by up to ten nanometres
    assert_within_limits(rig)


def test_a_wider_blend_is_quicker() -> None:
    taken = []
    for blend in (0.0, 0.005, 0.02):
        rig = ControlRig()
        rig.enable()
        taken.append(square(rig, blend))
    assert taken[0] > taken[1] > taken[2]


@pytest.mark.parametrize("valid_for", [0.1, 0.25])
def test_a_waiting_goal_is_valid_for_its_time_and_not_a_cycle_longer(rig: ControlRig, valid_for: float) -> None:
    rig.enable()
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0, speed=0.2, blend=0.01))
    goal = PoseGoal(0.05, 0.05, 0.0, valid_for=valid_for)
    rig.cycle(GoalRequest(99, "ann", "g2", goal, round((rig.now + PERIOD) * 1e9)))  # it comes as it is sent
    sent = rig.control.cycles
    rig.until(lambda: ("g2", "expired") in rig.outcomes())
    assert rig.control.cycles - sent == round(valid_for / PERIOD) + 1


def test_what_waits_no_more_slows_nothing(rig: ControlRig) -> None:
    """An override may take back a goal's own slowness, as far as what waits behind it can be taken so."""
    rig.enable()
    rig.send("slow", PoseGoal(0.1, 0.0, 0.0, speed=0.5, blend=0.0))
    rig.send("fast", PoseGoal(0.0, 0.0, 0.0))
    rig.cycles(100)
    rig.command("override", 2.0)
    rig.cycles(50)
    assert rig.control.schedule.runs[0].target == pytest.approx(1.0, rel=1e-3)
    rig.cycle(CommandRequest(99, "ann", Command.STOP, Stop("fast")))
    rig.until(lambda: rig.control.schedule.runs[0].target > 1.9, 50)
    rig.until(rig.holds)
    assert rig.outcomes() == [("fast", "stopped"), ("slow", "done")]
    assert_within_limits(rig)


def test_what_is_over_slows_nothing(rig: ControlRig) -> None:
    """How fast the rest of a path can be taken is what the rest of it says, not what lies behind."""
    rig.enable()
    rig.send("fast", PoseGoal(0.05, 0.0, 0.0, blend=0.0))
    rig.send("slow", PoseGoal(0.0, 0.0, 0.0, speed=0.5))
    rig.until(lambda: ("fast", "done") in rig.outcomes())
    rig.cycles(50)
    rig.command("override", 2.0)
    rig.until(lambda: rig.control.schedule.runs[0].target > 1.2, 50)
    rig.until(rig.holds)
    assert_within_limits(rig)


def test_without_blend_the_next_goal_preempts(rig: ControlRig) -> None:
    rig.enable()
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0))
    rig.cycles(50)
    assert not accepted(rig.send("g2", PoseGoal(0.0, 0.05, 0.0))).reply.queued
    assert rig.outcomes() == [("g1", "preempted")]


def test_the_queue_has_an_end(rig: ControlRig) -> None:
    rig.enable()
    depth = CONFIG.motion.queue
    for number in range(depth + 1):
        answer = accepted(rig.send(f"g{number}", PoseGoal(0.001, 0.0, 0.1 * (1 + number % 3), blend=0.0)))
        assert answer.reply.queued == (number > 0)
    refused = refusal(rig.send("more", PoseGoal(0.0, 0.0, 0.0)))
    assert (refused.code, refused.limit) == ("queue_full", depth)
    rig.until(rig.holds, 20_000)
    done = [(f"g{number}", "done") for number in range(depth + 1)]
    assert rig.outcomes() == [("more", "rejected"), *done]


@pytest.mark.parametrize("name", ["stop", "pause", "quick_stop"])
@pytest.mark.parametrize("wait", [20, 150, 260])
def test_a_queue_is_stopped_or_paused_as_a_whole(rig: ControlRig, name: str, wait: int) -> None:
    rig.enable()
    for number, pose in enumerate(SQUARE):
        rig.send(f"q{number}", PoseGoal(*pose, blend=0.01))
    rig.cycles(wait)
    rig.command(name)
    if name == "pause":
        rig.cycles(30)
        assert rig.control.commanded.at_rest
        rig.command("resume")
        rig.until(rig.holds)
        assert rig.outcomes() == [(f"q{number}", "done") for number in range(4)]
    else:
        end = {"stop": "stopped", "quick_stop": "faulted"}[name]
        assert [goal_id for goal_id, _ in rig.outcomes()] == [f"q{number}" for number in range(4)]
        assert {outcome for _, outcome in rig.outcomes()} <= {"done", end}
        assert rig.outcomes()[-1][1] == end
    if name != "quick_stop":
        assert_within_limits(rig)


def test_a_waiting_goal_can_be_stopped_alone(rig: ControlRig) -> None:
    rig.enable()
    for number, pose in enumerate(SQUARE):
        rig.send(f"q{number}", PoseGoal(*pose, blend=0.01))
    rig.cycle(CommandRequest(99, "ann", Command.STOP, Stop("q2")))
    rig.until(rig.holds)
    assert sorted(rig.outcomes()) == [("q0", "done"), ("q1", "done"), ("q2", "stopped"), ("q3", "stopped")]
    assert rig.control.commanded.pose == pytest.approx(SQUARE[1], abs=1e-9)
    rig.cycle(CommandRequest(100, "ann", Command.STOP, Stop("q2")))
    assert refusal(rig.answers[-1]).code == "no_goal"
    assert_within_limits(rig)


def test_a_waiting_goal_expires(rig: ControlRig) -> None:
    rig.enable()
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0, speed=0.2, blend=0.01))
    accepted(rig.send("g2", PoseGoal(0.05, 0.05, 0.0, valid_for=0.3)))
    rig.until(rig.holds)
    assert rig.outcomes() == [("g2", "expired"), ("g1", "done")]
    assert rig.control.commanded.pose == pytest.approx((0.05, 0.0, 0.0), abs=1e-9)
    assert_within_limits(rig)


# ---------------------------------------------------------------------- thousands

KINDS = ("pose", "pose", "pose", "sliders", "velocity", "track", "trajectory")
ORDERS = ("stop", "pause", "resume", "override", "disable", "quick_stop", "enable", "reset", "break")


def random_goal(rnd: random.Random, rig: ControlRig) -> Goal:
    """A goal of any kind, reachable or not."""
    pose = rnd.uniform(-0.16, 0.16), rnd.uniform(-0.16, 0.16), rnd.uniform(-1.0, 0.8)
    if rnd.random() < 0.6:
        pose = pose[0] / 3.0, pose[1] / 3.0, pose[2] / 2.0
    valid = rnd.choice((None, None, None, 0.01, 1.0))
    match rnd.choice(KINDS):
        case "pose":
            blend = rnd.choice((None, None, 0.0, 0.01))
            return PoseGoal(*pose, speed=rnd.choice((1.0, 1.0, 0.3)), blend=blend, valid_for=valid)
        case "sliders":
            return SlidersGoal(tuple(inverse(ROBOT, np.array(pose)).position.tolist()), valid_for=valid)
        case "velocity":
            return VelocityGoal(pose[0], pose[1], 2.0 * pose[2], timeout=0.05)
        case "track":
            return TrackGoal(*pose, velocity=(pose[1], pose[0], pose[2]), timeout=0.05)
        case _:
            start = rig.control.commanded.pose
            end = [value + rnd.uniform(-0.01, 0.01) for value in start]
            points = TrajectoryPoint(0.0, start[0], start[1], start[2]), TrajectoryPoint(0.3, end[0], end[1], end[2])
            return TrajectoryGoal(points, stretch=rnd.random() < 0.5)


def meddle(rnd: random.Random, rig: Rig) -> None:
    """Send a command at random, or break a drive; bring the robot back where it has been taken out of service."""
    if rig.mode is Mode.FAULT:
        for drive in rig.drives:
            drive.silent = False
        rig.cycles(20)
        rig.order("reset")
        rig.cycles(250)
    elif rig.mode is Mode.DISABLED:
        rig.order("enable")
        rig.cycles(20)
    else:
        what = rnd.choices(ORDERS, (6, 6, 9, 9, 1, 1, 2, 2, 1))[0]
        if what == "break":
            rig.drives[rnd.randrange(3)].fail(0x4310)
        else:
            rig.order(what, rnd.choice((0.3, 1.0, 1.0, 1.6)) if what == "override" else None)


@pytest.mark.slow
@pytest.mark.generated(20_090_901, 20_090_902, 20_090_903, 20_090_904)
def test_thousands_of_goals_have_as_many_endings(seed: int) -> None:
    rig, rnd = Rig(), random.Random(seed)
    rig.enable()
    number = 1_000
    for k in range(number):
        rig.post(f"g{k}", random_goal(rnd, rig))
        rig.cycles(600 if k % 100 == 50 else rnd.choice((0, 0, 1, 3, 10, 30)))
        if rnd.random() < 0.1:
            meddle(rnd, rig)
        if k % 100 == 0:
            rig.rows.clear()
            rig.seen.clear()
    rig.until(lambda: rig.control.goal_queue.idle, 50_000)
    rig.order("override", 1.0)
    rig.order("stop")
    rig.until(lambda: rig.mode in (Mode.HOLDING, Mode.DISABLED, Mode.FAULT))
    counted = Counter(goal_id for goal_id, _ in rig.outcomes())
    assert set(counted.values()) == {1}
    assert len(counted) == number
    assert {outcome for _, outcome in rig.outcomes()} == {
        "done",
        "rejected",
        "preempted",
        "stopped",
        "expired",
        "faulted",
    }
    answered = Counter(getattr(answer, "ticket", None) for answer in rig.answers)
    assert set(answered.values()) == {1}
    said = [notice.message for notice in rig.notices if notice.kind == "fault"]
    assert all("emergency 0x4310" in message or message == "quick_stop by ann" for message in said), set(said)
    rig.bus.shutdown()


# ---------------------------------------------------------------------- while a goal is being planned


@pytest.mark.parametrize("name", ["stop", "disable", "quick_stop"])
def test_what_is_being_planned_does_not_begin_after_a_stop(name: str) -> None:
    rig = ControlRig(SLOW)
    rig.enable()
    rig.goal("g1", 0.08, 0.0, 0.0)
    rig.cycles(300)
    rig.post("g2", PoseGoal(-0.05, 0.05, 0.4))
    assert rig.control._planner.busy  # from this motion it takes more than a step
    rig.order(name)
    rig.until(lambda: rig.mode in (Mode.HOLDING, Mode.DISABLED, Mode.FAULT))
    end = "faulted" if name == "quick_stop" else "stopped"
    assert sorted(rig.outcomes()) == [("g1", end), ("g2", end)]
    moved = rig.control.commanded.pose
    rig.cycles(300)
    if name == "stop":
        assert rig.control.commanded.pose == moved


PLAIN_SET_OUT = GoalPlanner._plan_from_motion


def only_from_rest(goals: GoalPlanner, goal: Goal, schedule: Schedule, rate: float) -> PlannedMotion:
    """Plan from no motion, so that the robot stops first."""
    if not schedule.commanded.at_rest:
        raise TOO_FAST_IN_MOTION
    return PLAIN_SET_OUT(goals, goal, schedule, rate)


@pytest.mark.long
@pytest.mark.parametrize(
    ("config", "first", "second"),
    [
        (SLOW, (0.08, 0.02, 0.3), (-0.05, 0.05, -0.3)),  # in motion too fast for these sliders: it stops first
        (MEDIUM, (0.063, 0.068, -0.238), (-0.047, 0.06, -0.507)),
        (MEDIUM, (-0.064, 0.034, -0.46), (0.054, -0.018, -0.191)),
    ],
)
def test_of_two_ways_the_sooner_is_taken(
    monkeypatch: pytest.MonkeyPatch, config: Config, first: tuple[float, ...], second: tuple[float, ...]
) -> None:
    """From the same motion, with lower limits or after a stop: each where the other is not to be had, and then both."""
    plain_stop_first = GoalPlanner._plan_after_stop

    def no_stop(goals: GoalPlanner, goal: Goal, schedule: Schedule, rate: float) -> PlannedMotion:
        raise TOO_FAST_IN_MOTION

    def asked(wait: int, way: str) -> tuple[ControlRig, Answer]:
        monkeypatch.setattr(GoalPlanner, "_plan_from_motion", only_from_rest if way == "stop" else PLAIN_SET_OUT)
        monkeypatch.setattr(GoalPlanner, "_plan_after_stop", no_stop if way == "lower" else plain_stop_first)
        rig = ControlRig(config)
        rig.enable()
        rig.goal("g1", *first)
        rig.cycles(wait)
        return rig, rig.goal("g2", *second)

    thought = 0.002  # durations count from the answer on, which comes a cycle or two after the question
    differing = 0
    for wait in range(150, 500, 50):
        durations = {False: math.inf, True: math.inf}
        for way in ("lower", "stop"):
            rig, answer = asked(wait, way)
            if isinstance(answer, Accepted):
                durations[way == "stop"] = expected_duration(answer)
        rig, free = asked(wait, "either")
        began = len(rig.rows)
        answer = accepted(free)
        assert expected_duration(answer) == pytest.approx(durations[answer.reply.stops_first], abs=thought)
        assert expected_duration(answer) < min(durations.values()) + thought
        differing += min(durations.values()) + thought < max(durations.values())
        rig.until(rig.holds)
        assert (len(rig.rows) - began) * PERIOD == pytest.approx(expected_duration(answer), abs=0.03)
        assert rig.outcomes() == [("g1", "preempted"), ("g2", "done")]
        assert_within_limits(rig)
    assert differing >= 3


@pytest.mark.parametrize("later", range(4))
def test_a_stop_is_kept_though_the_rate_of_the_goal_to_come_is_thought_about(
    monkeypatch: pytest.MonkeyPatch, later: int
) -> None:
    """The robot stops for a goal that is then to run at an override; it is told to stop as that is being looked at."""
    monkeypatch.setattr(GoalPlanner, "_plan_from_motion", only_from_rest)
    rig = ControlRig(SLOW)
    rig.enable()
    rig.goal("g1", 0.08, 0.02, 0.3)
    rig.cycles(400)
    rig.command("override", 0.7)
    rig.cycles(100)
    assert accepted(rig.goal("g2", -0.05, 0.05, -0.3)).reply.stops_first
    rig.order("override", 1.5)
    schedule = rig.control.schedule
    rig.cycles(later)
    assert len(schedule.runs) == 2
    assert rig.control._planner._change is not None or later
    rig.command("stop")
    rig.until(lambda: rig.mode is Mode.HOLDING, 2000)
    assert rig.outcomes() == [("g1", "preempted"), ("g2", "stopped")]
    assert np.linalg.norm(np.array(rig.control.commanded.pose) - (0.08, 0.02, 0.3)) > 0.01
    rig.cycles(200)
    assert rig.control.commanded.at_rest
    assert_within_limits(rig)


def test_a_renewed_goal_request_is_held_until_the_one_before_is_planned() -> None:
    rig = ControlRig(SLOW)
    rig.enable()
    rig.goal("g1", 0.08, 0.0, 0.0)
    rig.cycles(300)
    for k in range(5):
        rig.post(f"p{k}", PoseGoal(-0.05 + 0.01 * k, 0.05, 0.4))
    rig.until(lambda: stands(rig))
    ends = rig.outcomes()
    assert ends[-1] == ("p4", "done")
    assert [goal_id for goal_id, _ in ends] == ["g1", "p0", "p1", "p2", "p3", "p4"]
    assert_within_limits(rig)


def test_a_goal_that_came_before_a_stop_but_waits_is_stopped(rig: ControlRig) -> None:
    rig.enable()
    request = GoalRequest(7, "ann", "late", PoseGoal(0.05, 0.0, 0.0), round(rig.now * 1e9))
    rig.cycle(msgspec.structs.replace(request, withdrawn="stop by ann"))
    assert refusal(rig.answers[-1]).code == "stopped"
    assert rig.outcomes() == [("late", "stopped")]
    rig.cycles(20)
    assert rig.control.commanded.at_rest


def test_a_goal_that_waits_for_its_turn_is_not_done_where_another_would_have_begun() -> None:
    """A waiting goal's seam is passed between the acceptance of a goal that preempts it and that goal's turn."""
    for before in range(1, 40, 3):
        rig = ControlRig(SLOW)
        rig.enable()
        rig.send("q0", PoseGoal(0.05, 0.02, 0.3, blend=0.01))
        rig.send("q1", PoseGoal(-0.05, 0.05, -0.3))
        run = rig.control.schedule.runs[0]
        while run.law_state.s <= run.seams[0].s - before * PERIOD:
            rig.cycle()
        answer = accepted(rig.goal("g2", 0.0, -0.05, 0.4))
        rig.until(rig.holds)
        assert rig.outcomes()[-1] == ("g2", "done")
        assert Counter(rig.outcomes()).most_common(1)[0][1] == 1
        assert {goal_id for goal_id, _ in rig.outcomes()} == {"q0", "q1", "g2"}
        assert rig.control.commanded.pose == pytest.approx((0.0, -0.05, 0.4), abs=1e-9)
        assert expected_duration(answer) > 0.0
