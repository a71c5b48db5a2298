"""Places of marks on planned paths, compared with an integration that shares nothing with theirs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec import structs
from numpy.typing import NDArray
from trirail.config import SIM, corrected_geometry, load
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.robot import inverse
from trirail.motion.goal_planner import GoalPlanner
from trirail.motion.marks import BISECTIONS, MAX_SWITCHES, GoalMarks, Placed, place_marks
from trirail.motion.runs import ZERO_RATES, Run, rest
from trirail.motion.schedule import Schedule
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal, TrajectoryGoal, TrajectoryPoint
from trirail.wire.marks import Crossing, Mark
from trirail.wire.packed_trajectory import packed

ROBOTS = {"3-PRP": load(SIM), "3-PPR": load(SIM.with_name("uvw-ppr.toml"))}
FINE = 20_000
"""Samples of a path by which a test measures it."""


def planned(kind: str, goal: Goal) -> Run:
    """Return the motion from the middle of the workspace to a goal."""
    config = ROBOTS[kind]
    planner = GoalPlanner(corrected_geometry(config), config.limits, config.period)
    return planner.plan(goal, Schedule(rest(ZERO_RATES), config.period), 1.0, 3).run


def traced(run: Run, tool: tuple[float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return times along the path (n,), poses of the platform's centre (n, 3), and places of the tool (n, 2)."""
    s = np.linspace(0.0, run.path.duration, FINE)
    poses = np.array([run.state(at, ZERO_RATES).pose for at in s])
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return s, poses, poses[:, :2] + np.stack([cos * tool[0] - sin * tool[1], sin * tool[0] + cos * tool[1]], axis=1)


def placed(kind: str, run: Run, *marks: Mark) -> Placed:
    return place_marks(marks, run.path, corrected_geometry(ROBOTS[kind]).packed(), ZERO_RATES, ROBOTS[kind].period)


def random_goal(kind: str, rng: np.random.Generator) -> tuple[Goal, tuple[float, float]]:
    """Return a goal within reach, and its tool [m]."""
    x, y, phi = rng.uniform(-1.0, 1.0, 3) * ((0.05, 0.05, 0.3) if kind == "3-PRP" else (0.004, 0.004, 0.02))
    speed = rng.uniform(0.1, 1.0)
    match rng.integers(3):
        case 0:
            u, v = map(float, rng.uniform(-0.05, 0.05, 2))  # where the tool is at its start, so that it moves by x, y
            return PoseGoal(u + x, v + y, phi, tool=(u, v), speed=speed), (u, v)
        case 1:
            return PoseGoal(x, y, phi, speed=speed), (0.0, 0.0)
        case _:
            a, b, c = inverse(corrected_geometry(ROBOTS[kind]), (x, y, phi)).position.tolist()
            return SlidersGoal((a, b, c), speed=speed), (0.0, 0.0)


@pytest.mark.parametrize("kind", ROBOTS)
@pytest.mark.generated(*range(20))
def test_marks_lie_where_an_independent_integration_has_them(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    goal, tool = random_goal(kind, rng)
    run = planned(kind, goal)
    s, poses, places = traced(run, tool)
    lengths = np.append(0.0, np.cumsum(np.hypot(*np.diff(places, axis=0).T)))
    share, time = rng.uniform(0.02, 0.98), rng.uniform(0.0, run.path.duration)
    coordinate = int(np.argmax(np.abs(poses[-1])))
    tool_poses = np.column_stack([places, poses[:, 2]])
    value = float(
        tool_poses[0, coordinate] + rng.uniform(0.1, 0.9) * (tool_poses[-1, coordinate] - tool_poses[0, coordinate])
    )
    marks = (
        Mark("a", after_start=share * lengths[-1]),
        Mark("b", before_target=share * lengths[-1]),
        Mark("c", at_path_fraction=share),
        Mark("d", after_start_s=time),
        Mark("e", before_target_s=time),
        Mark("f", at=Crossing(**{("x", "y", "phi")[coordinate]: value})),
    )
    found = placed(kind, run, *marks)
    step = float(np.max(np.diff(lengths))) + 1e-9
    for mark, length in zip(found.marks[:3], (share, 1.0 - share, share), strict=True):
        assert mark.path == pytest.approx(length * lengths[-1], abs=step)
        assert float(np.interp(mark.time, s, lengths)) == pytest.approx(length * lengths[-1], abs=2 * step)
    assert found.marks[3].time == pytest.approx(time)
    assert found.marks[4].time == pytest.approx(run.path.duration - time)
    crossed = float(np.interp(found.marks[5].time, s, tool_poses[:, coordinate]))
    assert crossed == pytest.approx(value, abs=1e-7)
    for mark in found.marks:
        assert mark.pose == pytest.approx([np.interp(mark.time, s, poses[:, i]) for i in range(3)], abs=1e-6)
    times = found.switches["s"]
    assert np.all(np.diff(times) >= 0.0)


def test_the_planner_shows_that_it_lives_while_it_places_marks_on_a_path_of_the_sliders() -> None:
    """Thousands of them take seconds, and a planner that seems to hang is killed."""
    config, beats = ROBOTS["3-PRP"], []
    legs = corrected_geometry(config).packed()
    run = planned("3-PRP", SlidersGoal((0.08, -0.02, 0.03), speed=0.05))
    mark = Mark("valve", start=0.0, increment=1e-4, pulse_width=0.001)
    found = place_marks((mark,), run.path, legs, ZERO_RATES, config.period, lambda: beats.append(1))
    assert len(found.switches) > 300
    assert len(beats) > BISECTIONS


@pytest.mark.parametrize("kind", ROBOTS)
@pytest.mark.parametrize("coordinate", range(3))
@pytest.mark.generated(*range(10))
def test_a_mark_may_be_at_the_start_or_the_target(kind: str, coordinate: int, seed: int) -> None:
    """Rounding may end the path a little before the target."""
    rng = np.random.default_rng(seed)
    begin, target = (np.round(rng.uniform(-1.0, 1.0, 3) * (0.004, 0.004, 0.02), 4).tolist() for _ in range(2))
    config = ROBOTS[kind]
    planner = GoalPlanner(corrected_geometry(config), config.limits, config.period)
    run = planner.plan(PoseGoal(*target), Schedule(rest(begin), config.period), 1.0, 3).run
    name = ("x", "y", "phi")[coordinate]
    marks = [Mark("valve", at=Crossing(**{name: pose[coordinate]})) for pose in (begin, target)]
    first, last = placed(kind, run, *marks).marks
    assert first.time == 0.0
    assert last.pose[coordinate] == pytest.approx(target[coordinate], abs=1e-9)


@pytest.mark.parametrize("kind", ROBOTS)
def test_a_repetition_has_its_pulses_an_increment_apart(kind: str) -> None:
    run = planned(kind, PoseGoal(0.004, 0.0, 0.0, speed=0.2))
    s, _, places = traced(run, (0.0, 0.0))
    lengths = np.append(0.0, np.cumsum(np.hypot(*np.diff(places, axis=0).T)))
    found = placed(kind, run, Mark("laser", start=0.001, end=0.003, increment=0.0005, pulse_width=0.002))
    assert found.marks[0].number == len(found.switches) == 5
    assert np.interp(found.switches["s"], s, lengths) == pytest.approx(np.arange(1, 3.1, 0.5) * 1e-3, abs=1e-6)
    assert np.all(found.switches["width"] == 0.002)


def test_a_stretch_opens_and_closes() -> None:
    run = planned("3-PRP", PoseGoal(0.05, 0.0, 0.0))
    found = placed("3-PRP", run, Mark("valve", start=0.01, end=0.03))
    assert found.switches["on"].tolist() == [1, 0]
    assert placed("3-PRP", run, Mark("valve", value=False, start=0.01)).switches["on"].tolist() == [0, 1]


@pytest.mark.parametrize(
    "inner",
    [
        Mark("valve", value=False, start=0.02, end=0.025),
        Mark("valve", value=False, start=0.02, end=0.04),
        Mark("valve", after_start=0.02),
        Mark("valve", value=False, after_start=0.02, pulse_width=0.004),
        Mark("valve", start=0.02, end=0.025, increment=0.002, pulse_width=0.001),
    ],
)
def test_a_section_with_another_switch_of_its_output_is_refused(inner: Mark) -> None:
    """Otherwise, a stop behind the inner switch would leave the output on."""
    run = planned("3-PRP", PoseGoal(0.05, 0.0, 0.0))
    section = Mark("valve", start=0.01, end=0.03)
    with pytest.raises(RefusedError, match="mark 1 of output 'valve' switches inside the section of mark 0: use"):
        placed("3-PRP", run, section, inner)
    other = structs.replace(inner, output="light")
    assert len(placed("3-PRP", run, section, other).marks) == 2


@pytest.mark.parametrize(
    ("mark", "words"),
    [
        (Mark("valve", after_start=0.06), "mark 0 of output 'valve' is at after_start = 60 mm; the path is 50 mm long"),
        (Mark("valve", before_target_s=60.0), "is at before_target_s = 60 s; the path takes"),
        (Mark("valve", at=Crossing(y=0.01)), "is at y = 10 mm; the path goes from 0 to 0 mm"),
        (
            Mark("valve", start=0.0, increment=1e-6, pulse_width=1e-3),
            "has 50,001 pulses; the maximum for a goal is 10,000",
        ),
        (Mark("valve", start=0.0, increment=1e-5, pulse_width=1e-3), " ms: lower the speed, or move"),
    ],
)
def test_marks_that_the_path_does_not_pass_are_refused(mark: Mark, words: str) -> None:
    run = planned("3-PRP", PoseGoal(0.05, 0.0, 0.0))
    with pytest.raises(RefusedError) as refused:
        placed("3-PRP", run, mark)
    assert refused.value.code is RefusalCode.BAD_MARK
    assert words in str(refused.value)


@pytest.mark.parametrize("below", [1e-7, 2e-6, 5e-5])
@pytest.mark.generated(0, 1, 2)
def test_a_mark_just_before_the_path_turns_round_is_passed_there(below: float, seed: int) -> None:
    """Not at a later place with this coordinate; and the path turns where its length has a corner."""
    rng = np.random.default_rng(seed)
    peak, after = rng.uniform(0.01, 0.03), rng.uniform(3.0, 5.0)
    points = (
        TrajectoryPoint(0.0, 0.0, 0.0, 0.0),
        TrajectoryPoint(2.0, peak, 0.0, 0.0, velocity=(0.02, 0.0, 0.0)),
        TrajectoryPoint(2.0 + after, peak, 0.0, 0.0, velocity=(-0.02, 0.0, 0.0)),
        TrajectoryPoint(12.0, 0.0, 0.0, 0.0),
        TrajectoryPoint(18.0, 0.06, 0.02, 0.0),
    )
    run = planned("3-PRP", packed(TrajectoryGoal(points)))
    s, _, tool = traced(run, (0.0, 0.0))
    first = int(np.argmax(tool[s < 10.0, 0]))
    value = float(tool[first, 0]) - below
    found = placed("3-PRP", run, Mark("valve", at=Crossing(x=value)))
    assert found.switches["s"][0] == pytest.approx(s[np.argmax(tool[:, 0] > value)], abs=2.0 * run.path.duration / FINE)
    lengths = np.cumsum(np.hypot(*np.diff(tool, axis=0).T))
    share = placed("3-PRP", run, Mark("valve", after_start=float(lengths[-1]) * 0.9))
    assert share.switches["s"][0] == pytest.approx(s[1 + np.searchsorted(lengths, 0.9 * lengths[-1])], abs=2e-3)


@pytest.mark.parametrize("kind", ROBOTS)
@pytest.mark.generated(*range(10))
def test_a_path_that_begins_at_zero_is_said_to_begin_there(kind: str, seed: int) -> None:
    """The pose of a robot that has come back to x = 0 follows from its sliders, and is wrong in the last digits."""
    rng = np.random.default_rng(seed)
    begin, target = (rng.uniform(-1.0, 1.0, 3) * (0.004, 0.004, 0.02) for _ in range(2))
    begin[0], target[0] = rng.choice([-1e-18, 1e-18]), abs(target[0])
    config = ROBOTS[kind]
    planner = GoalPlanner(corrected_geometry(config), config.limits, config.period)
    run = planner.plan(PoseGoal(*target.tolist()), Schedule(rest(begin.tolist()), config.period), 1.0, 3).run
    with pytest.raises(RefusedError) as refused:
        placed(kind, run, Mark("valve", at=Crossing(x=-0.01)))
    assert "the path goes from 0 to " in str(refused.value)


def test_a_path_on_which_the_tool_only_turns_has_no_share_of_its_length() -> None:
    run = planned("3-PRP", PoseGoal(0.0, 0.0, 0.2))
    with pytest.raises(RefusedError, match="the tool does not travel"):
        placed("3-PRP", run, Mark("valve", at_path_fraction=0.5))
    assert placed("3-PRP", run, Mark("valve", at=Crossing(phi=0.1))).marks[0].pose[2] == pytest.approx(0.1)


@pytest.mark.parametrize("kind", ROBOTS)
@pytest.mark.generated(*range(10))
def test_the_end_of_the_path_is_the_target_although_the_tool_does_not_travel(kind: str, seed: int) -> None:
    phi = float(np.random.default_rng(seed).uniform(0.002, 0.02))
    run = planned(kind, PoseGoal(0.0, 0.0, phi))
    found = placed(kind, run, Mark("valve", start=0.0), Mark("light", before_target=0.0))
    assert found.switches["s"] == pytest.approx([0.0, run.path.duration, run.path.duration], abs=1e-6)
    assert found.marks[1].pose[2] == pytest.approx(phi)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"after_start": 0.01, "before_target": 0.01},
        {"start": 0.0, "increment": 0.01},
        {"start": 0.02, "end": 0.01},
        {"end": 0.01, "after_start": 0.0},
        {"start": 0.0, "pulse_width": 0.1},
        {"after_start": math.nan},
    ],
)
def test_a_mark_that_says_no_place_or_two_is_refused(given: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"valve|finite"):
        Mark("valve", **given)  # type: ignore[arg-type]


def test_switches_of_other_marks_are_refused() -> None:
    run = planned("3-PRP", PoseGoal(0.05, 0.0, 0.0))
    switches = placed("3-PRP", run, Mark("valve", after_start=0.01)).switches.tobytes()
    assert GoalMarks("g", (Mark("valve", after_start=0.01),), switches).has_switches
    with pytest.raises(ValueError, match="do not belong to the 0 marks"):
        GoalMarks("g", (), switches)
    assert MAX_SWITCHES > 1
