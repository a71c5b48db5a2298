"""Relative moves, tools and frames by name: what they mean, from where they count, and that they add up."""

from __future__ import annotations

import cmath
import math

import msgspec
import numpy as np
import pytest
from control.test_control import PERIOD, assert_within_limits
from control_rig import CONFIG, ControlRig
from hypothesis import given
from hypothesis import strategies as st
from refusals import refusal
from trirail.config import Config, FramesTable
from trirail.errors import RefusedError
from trirail.motion.goal_planner import resolve_goal
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.goals import Goal, MoveGoal, PoseGoal, SlidersGoal, TrajectoryGoal, VelocityGoal
from trirail.wire.packets import Accepted
from trirail.wire.vocabulary import Mode

Pose = tuple[float, float, float]

TABLE = FramesTable(tool={"camera": (0.03, -0.02)}, work={"part": (0.02, 0.01, math.pi / 2.0)})
NAMED: Config = msgspec.structs.replace(CONFIG, frames=TABLE)
STEPS = st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.floats(-0.1, 0.1))
TOOLS = st.none() | st.just("camera") | st.tuples(*[st.floats(-0.1, 0.1)] * 2)


def turned(x: float, y: float, angle: float) -> complex:
    """By complex numbers, as nobody else computes it here."""
    return complex(x, y) * complex(math.cos(angle), math.sin(angle))


def arrive(rig: ControlRig, name: str, goal: Goal) -> Pose:
    answer = rig.send(name, goal)
    assert isinstance(answer, Accepted), answer
    rig.until(rig.holds, 20_000)
    x, y, phi = rig.control.commanded.pose
    return x, y, phi


# ---------------------------------------------------------------------- what they mean


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


@given(STEPS, STEPS, st.sampled_from(["base", "platform", "part"]), TOOLS)
def test_a_move_is_along_the_axes_of_its_frame_about_its_tool(
    place: Pose, step: Pose, frame: str, tool: str | tuple[float, float] | None
) -> None:
    goal = resolve_goal(MoveGoal(*step, frame=frame, tool=tool, speed=0.5), NamedFrames(TABLE), lambda _: place)
    assert isinstance(goal, PoseGoal)
    u, v = TABLE.tool["camera"] if tool == "camera" else tool if isinstance(tool, tuple) else (0.0, 0.0)
    begins = complex(place[0], place[1]) + turned(u, v, place[2])
    along = {"base": 0.0, "platform": place[2], "part": math.pi / 2.0}[frame]
    moved = complex(goal.x, goal.y) - begins
    assert abs(moved - turned(step[0], step[1], along)) < 1e-15
    assert goal.phi == place[2] + step[2]
    assert (goal.tool, goal.frame, goal.speed) == ((u, v), "base", 0.5)


@given(STEPS, TOOLS)
def test_a_pose_in_a_work_frame_is_where_the_frame_is(pose: Pose, tool: str | tuple[float, float] | None) -> None:
    goal = resolve_goal(PoseGoal(*pose, frame="part", tool=tool), NamedFrames(TABLE), lambda _: pose)
    assert isinstance(goal, PoseGoal)
    assert complex(goal.x, goal.y) == pytest.approx(complex(0.02, 0.01) + turned(pose[0], pose[1], math.pi / 2.0))
    assert goal.phi == pytest.approx(math.remainder(math.pi / 2.0 + pose[2], math.tau))


@pytest.mark.parametrize("angle", [-2.0, 0.0, 1e-9, 1.0, math.pi])
def test_a_frame_may_be_turned_by_any_angle(angle: float) -> None:
    table = FramesTable(work={"part": (0.02, 0.01, angle)})
    goal = resolve_goal(PoseGoal(0.03, -0.01, 0.1, frame="part"), NamedFrames(table), lambda _: (0.0, 0.0, 0.0))
    assert isinstance(goal, PoseGoal)
    assert complex(goal.x, goal.y) == pytest.approx(complex(0.02, 0.01) + turned(0.03, -0.01, angle))


@given(st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi), st.sampled_from([-1, 0, 1]))
def test_an_angle_in_a_work_frame_means_the_same_after_whole_turns(angle: float, phi: float, turns: int) -> None:
    table = FramesTable(work={"part": (0.02, 0.01, angle)})
    sent = PoseGoal(0.03, -0.01, phi - angle + turns * math.tau, frame="part")
    goal = resolve_goal(sent, NamedFrames(table), lambda _: (0.0, 0.0, 0.0))
    assert isinstance(goal, PoseGoal)
    assert abs(goal.phi) <= math.pi
    assert cmath.rect(1.0, goal.phi) == pytest.approx(cmath.rect(1.0, phi))


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        (PoseGoal(0.0, 0.0, 0.0, tool="laser"), "no tool 'laser': known are camera"),
        (PoseGoal(0.0, 0.0, 0.0, frame="table"), "no frame 'table': known are base, part"),
        (PoseGoal(0.0, 0.0, 0.0, frame="platform"), "send a move in that frame"),
        (MoveGoal(0.0, 0.0, 0.0, tool="laser"), "no tool 'laser'"),
        (MoveGoal(0.0, 0.0, 0.0, frame="table"), "no frame 'table'"),
    ],
)
def test_a_name_that_there_is_not_is_refused_with_those_that_there_are(goal: Goal, said: str) -> None:
    rig = ControlRig(NAMED)
    rig.enable()
    answer = refusal(rig.send("g1", goal))
    assert (answer.code, said in answer.message) == ("unknown_frame", True), answer.message
    assert rig.mode is Mode.HOLDING
    assert rig.outcomes() == [("g1", "rejected")]


def test_without_tools_a_point_is_asked_for() -> None:
    with pytest.raises(RefusedError, match=r"give a point, \[u, v\]"):
        resolve_goal(PoseGoal(0.0, 0.0, 0.0, tool="camera"), NamedFrames(FramesTable()), lambda _: (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (SlidersGoal, '{"kind":"sliders","position":[0,0,0]%s}'),
        (
            TrajectoryGoal,
            '{"kind":"trajectory","points":[{"t":0,"x":0,"y":0,"phi":0},{"t":1,"x":0,"y":0,"phi":0}]%s}',
        ),
    ],
)
def test_what_has_no_tool_refuses_one(kind: type[Goal], message: str) -> None:
    assert type(msgspec.json.decode(message % "", type=Goal)) is kind
    with pytest.raises(msgspec.ValidationError, match="unknown field `tool`"):
        msgspec.json.decode(message % ',"tool":[0.1,0]', type=Goal)


def test_from_is_its_name_on_the_wire() -> None:
    sent = b'{"kind":"move","x":0.001,"y":0.0,"phi":0.002,"frame":"platform","tool":[0.02,0.0],"from":"measured"}'
    goal = msgspec.json.decode(sent, type=Goal)
    assert goal == MoveGoal(0.001, 0.0, 0.002, frame="platform", tool=(0.02, 0.0), origin="measured")
    assert msgspec.json.decode(msgspec.json.encode(goal), type=Goal) == goal


# ---------------------------------------------------------------------- from where


STEP = 1e-6, 0.0, 10e-6


@pytest.mark.parametrize("tool", [None, (0.05, -0.03)])
@pytest.mark.parametrize("waits", [True, False])
def test_ten_corrections_land_where_one_ten_times_as_large_does(
    rig: ControlRig, tool: tuple[float, float] | None, waits: bool
) -> None:
    """From commanded to rounding, whether each waits for the one before it or preempts it."""
    rig.enable()
    begin = arrive(rig, "g0", PoseGoal(0.02, -0.01, 0.1))
    whole = arrive(rig, "g1", MoveGoal(10e-6, 0.0, 100e-6, tool=tool))
    arrive(rig, "g2", PoseGoal(*begin))
    for number in range(10):
        goal = MoveGoal(*STEP, tool=tool)
        if waits:
            arrive(rig, f"m{number}", goal)
        else:
            rig.post(f"m{number}", goal)
    rig.until(lambda: rig.holds() and rig.control.goal_queue.idle)
    assert rig.control.commanded.pose == pytest.approx(whole, abs=1e-13)
    assert {outcome for _, outcome in rig.outcomes()} <= {"done", "preempted"}
    assert_within_limits(rig)


def test_from_measured_each_correction_begins_where_the_robot_is() -> None:
    """The last of them lands within what its measurement was off, whatever the ones before did."""
    rig = ControlRig(CONFIG)
    rig.enable()
    arrive(rig, "g0", PoseGoal(0.02, -0.01, 0.1))
    for number in range(10):
        measured = rig.control.measured.pose
        landed = arrive(rig, f"m{number}", MoveGoal(*STEP, origin="measured"))
        assert landed == pytest.approx(np.add(measured, STEP).tolist(), abs=1e-6)
    assert landed == pytest.approx((0.02 + 10e-6, -0.01, 0.1 + 100e-6), abs=5e-6)


def test_a_move_under_way_counts_from_where_the_goal_leads(rig: ControlRig) -> None:
    rig.enable()
    rig.send("g1", PoseGoal(0.03, 0.0, 0.0))
    rig.cycles(50)
    assert rig.mode is Mode.MOVING
    assert arrive(rig, "m1", MoveGoal(0.0, 0.01, 0.0)) == pytest.approx((0.03, 0.01, 0.0), abs=1e-12)
    assert rig.outcomes() == [("g1", "preempted"), ("m1", "done")]


def test_a_move_that_waits_counts_from_where_the_goals_before_it_lead(rig: ControlRig) -> None:
    rig.enable()
    rig.send("g1", PoseGoal(0.03, 0.0, 0.0, blend=0.005))
    assert isinstance(answer := rig.send("m1", MoveGoal(0.0, 0.01, 0.1, blend=0.005)), Accepted)
    assert answer.reply.queued
    assert arrive(rig, "m2", MoveGoal(-0.01, 0.0, 0.0)) == pytest.approx((0.02, 0.01, 0.1), abs=1e-12)
    assert rig.outcomes() == [("g1", "done"), ("m1", "done"), ("m2", "done")]


def test_a_move_after_a_stop_or_in_a_jog_counts_from_where_the_robot_is(rig: ControlRig) -> None:
    rig.enable()
    rig.send("g1", PoseGoal(0.05, 0.0, 0.0))
    rig.cycles(80)
    rig.command("stop")
    stopped = rig.control.commanded.pose[0]
    assert arrive(rig, "m1", MoveGoal(0.001, 0.0, 0.0))[0] == pytest.approx(stopped + 0.001, abs=1e-12)
    rig.send("j1", VelocityGoal(0.02, 0.0, 0.0, timeout=0.5))
    rig.cycles(100)
    here = rig.control.commanded.pose[0]
    landed = arrive(rig, "m2", MoveGoal(0.01, 0.0, 0.0))[0]
    assert here + 0.01 - 1e-12 <= landed <= here + 0.01 + 0.02 * 5 * PERIOD


@pytest.mark.parametrize("how", ["pause", "override"])
def test_a_move_while_a_goal_waits_half_way_is_refused_unless_it_is_from_where_the_robot_is(how: str) -> None:
    """It would count from the end of the goal that waits: who asks for 5 mm would get all that was left, too."""
    rig = ControlRig(NAMED)
    rig.enable()
    rig.goal("g1", 0.1, 0.0, 0.0)
    rig.cycles(300)
    if how == "pause":
        rig.command("pause")
    else:
        rig.command("override", 0.0)
    rig.cycles(1000)
    stood = rig.control.commanded.pose[0]
    assert 0.0 < stood < 0.1
    answer = refusal(rig.send("m1", MoveGoal(0.005, 0.0, 0.0)))
    assert (answer.code, "send stop or resume first" in answer.message) == ("moving", True)
    assert rig.control.commanded.pose[0] == stood
    if how == "pause":
        arrive(rig, "m2", MoveGoal(0.005, 0.0, 0.0, origin="measured"))
        assert rig.control.commanded.pose[0] == pytest.approx(stood + 0.005, abs=1e-5)
