"""The compiled cycle: the mathematics that everybody else uses, to the last bit, and no memory that a cycle takes."""

from __future__ import annotations

import math
from collections import deque
from typing import Any, cast

import numpy as np
import pytest
from conftest import Followers, Rig, alone, what_memory_takes
from control_rig import CONFIG
from hypothesis import assume, given
from hypothesis import strategies as st
from trirail.config import geometry
from trirail.control.cycle import AT_REST, PASSED
from trirail.control.feedback import MeasuredState
from trirail.control.setpoints import Setpoints
from trirail.errors import KinematicsError
from trirail.kinematics.robot import forward, inverse
from trirail.motion.limits import Bounds
from trirail.motion.paths import LAST_PIECE_S, Path
from trirail.motion.runs import Run, Seam, rest
from trirail.motion.schedule import Schedule
from trirail.wire.goals import PoseGoal, SlidersGoal
from trirail.wire.vocabulary import Mode
from trirail_drivers.interface import DriveGroup, Feedback, PowerState

ROBOT = geometry(CONFIG.geometry)
LEGS = ROBOT.packed()
PERIOD = CONFIG.period
STEP = CONFIG.limits.slider.velocities[0] * PERIOD
ON = (PowerState.OPERATION_ENABLED,) * 3

PLACES = st.tuples(*[st.floats(-0.03, 0.03)] * 2, st.floats(-0.2, 0.2))
TERMS = st.tuples(*[st.floats(-0.05, 0.05)] * 3)
RATES = st.floats(0.1, 2.0)
ANYWHERE = np.full(9, np.inf)
"""Where the robot may stand."""


def bits(values: object) -> bytes:
    return np.array(values, dtype=np.float64).tobytes()


def boundless() -> Bounds:
    """Return a gate that lets everything through."""
    bounds = Bounds(CONFIG.limits, PERIOD)
    for name in ("edge", "step", "slider_jerk", "platform"):
        bounds.packed[name] = math.inf
    bounds.packed["rows"][..., 2] = math.inf
    return bounds


@given(
    start=PLACES,
    terms=st.tuples(TERMS, TERMS, TERMS, TERMS, TERMS),
    in_sliders=st.booleans(),
    rate=RATES,
    change=st.floats(-0.5, 0.5),
    time=st.floats(0.0, 0.5),
    seam=st.none() | st.floats(0.05, 0.3),
)
def test_what_is_commanded_is_what_everybody_elses_mathematics_says(
    start: tuple[float, float, float],
    terms: tuple[tuple[float, float, float], ...],
    in_sliders: bool,
    rate: float,
    change: float,
    time: float,
    seam: float | None,
) -> None:
    begin = inverse(ROBOT, start).position.tolist() if in_sliders else start
    path = Path(np.array([0.0, 0.4]), np.array([np.transpose([begin, *terms])]), in_sliders)
    law = Path(np.array([0.0, 0.1, LAST_PIECE_S]), np.zeros((2, 1, 6)))
    law.pieces[0, 0, :3] = 0.0, rate, change
    law.pieces[1, 0, :2] = 0.1 * rate + 0.01 * change, rate + 0.2 * change
    run = Run(LEGS, path, law, float(law.pieces[1, 0, 1]))
    if seam is not None:
        run.seams.append(Seam(seam, path))
    run.time = time
    schedule = Schedule(rest(start), PERIOD)
    schedule.replace_runs(deque([run]))
    measured = MeasuredState(LEGS, PERIOD, STEP)
    measured.start(Feedback((0.0, 0.0, 0.0), ON, None))
    setpoints = Setpoints(LEGS, boundless(), ANYWHERE, measured, STEP)

    assert schedule.begin_cycle() is run
    expected = run.state(0.0, start)
    assume(np.isfinite(expected).all())
    found = setpoints.solve(schedule, run)
    assert setpoints.refusal(found) is None
    solved = inverse(ROBOT, *expected)
    assert bits(schedule.commanded) == bits(expected)
    assert bits(setpoints.rows) == bits(solved)
    record = measured.record[0]
    assert bits(record["commanded_pose"]) == bits(expected.pose)
    assert bits(record["commanded_pose_velocity"]) == bits(expected.velocity)
    assert bits(record["commanded_pose_acceleration"]) == bits(expected.acceleration)
    assert bits(record["commanded_position"]) == bits(solved.position)
    assert bits(record["commanded_velocity"]) == bits(solved.velocity)
    assert bits(record["commanded_acceleration"]) == bits(solved.acceleration)
    assert bits(record["passive_position"]) == bits(solved.passive_position)
    assert bits([record["progress"], record["remaining"]]) == bits([run.progress, run.remaining])
    assert bool(found) is (run.at_rest or (seam is not None and run.law_state.s >= seam))
    assert schedule.end_cycle(run) == (seam is not None and run.law_state.s >= seam)


@pytest.mark.parametrize(
    ("rate", "change", "target", "stands"),
    [(0.0, 0.0, 0.0, True), (0.1, 0.0, 0.0, False), (0.0, 0.1, 0.0, False), (0.0, 0.0, 0.5, False)],
)
def test_a_motion_stands_on_its_way_where_its_law_does(rate: float, change: float, target: float, stands: bool) -> None:
    path = Path(np.array([0.0, 1.0]), np.zeros((1, 3, 6)))
    law = Path(np.array([0.0, LAST_PIECE_S]), np.zeros((1, 1, 6)))
    law.pieces[0, 0, :3] = 0.5, rate, change / 2.0
    run = Run(LEGS, path, law, target)
    schedule = Schedule(rest((0.0, 0.0, 0.0)), PERIOD)
    schedule.replace_runs(deque([run]))
    setpoints = Setpoints(LEGS, boundless(), ANYWHERE, MeasuredState(LEGS, PERIOD, STEP), STEP)
    found = setpoints.solve(schedule, schedule.begin_cycle())
    assert setpoints.refusal(found) is None
    assert run.at_rest is stands
    assert bool(found & AT_REST) is stands
    assert not found & PASSED


@given(start=PLACES, terms=TERMS)
def test_what_the_gate_refuses_leaves_the_setpoints_as_they_are(
    start: tuple[float, float, float], terms: tuple[float, float, float]
) -> None:
    """A motion that begins with a velocity: a jerk that no limit allows."""
    assume(max(map(abs, terms)) > 0.01)
    bounds, measured = Bounds(CONFIG.limits, PERIOD), MeasuredState(LEGS, PERIOD, STEP)
    setpoints, schedule = Setpoints(LEGS, bounds, ANYWHERE, measured, STEP), Schedule(rest(start), PERIOD)
    a, b, c = inverse(ROBOT, start).position.tolist()
    measured.start(Feedback((a, b, c), ON, None))
    setpoints.start()
    assert setpoints.refusal(setpoints.solve(schedule, None)) is None
    rows = setpoints.rows
    pieces = np.zeros((1, 3, 6))
    pieces[0, :, 0], pieces[0, :, 1] = start, terms
    law = Path(np.array([0.0, LAST_PIECE_S]), np.array([[[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]]]))
    schedule.replace_runs(deque([Run(LEGS, Path(np.array([0.0, 1.0]), pieces), law, 1.0)]))
    refused = setpoints.refusal(setpoints.solve(schedule, schedule.begin_cycle()))
    assert refused is not None
    assert "jerk" in refused
    assert setpoints.rows == rows
    assert bits(measured.record["commanded_position"][0]) == bits(rows[0])


@given(place=PLACES, shares=st.tuples(*[st.floats(-1.9, 1.9)] * 3))
def test_the_measured_pose_is_forwards_to_the_last_bit(
    place: tuple[float, float, float], shares: tuple[float, float, float]
) -> None:
    a, b, c = inverse(ROBOT, place).position.tolist()
    measured = MeasuredState(LEGS, PERIOD, STEP)
    measured.start(Feedback((a, b, c), ON, None))
    measured.update(Feedback((a, b, c), ON, None))
    assert bits(measured.pose) == bits(forward(ROBOT, (a, b, c)))
    moved = (a + shares[0] * STEP, b + shares[1] * STEP, c + shares[2] * STEP)
    before = measured.pose
    measured.update(Feedback(moved, ON, None))
    try:
        assert bits(measured.pose) == bits(forward(ROBOT, moved, near=before))
    except KinematicsError:
        assert measured.pose == before
    assert bits(measured.velocity) == bits([(now - last) / PERIOD for now, last in zip(moved, (a, b, c), strict=True)])
    assert bits(measured.record["position"][0]) == bits(moved)


# ---------------------------------------------------------------------- memory

KEPT = 256
"""Bytes by which memory may differ between two cycles: integers and floats have sizes."""
IN_USE = 4096
"""Bytes that a cycle may have in use for a moment: numbers and tuples, no array, no buffer, no list that grows."""


@pytest.mark.long
@pytest.mark.parametrize(
    "goal", [None, PoseGoal(0.1, 0.02, 0.1, speed=0.02), SlidersGoal((0.08, 0.0, 0.0), speed=0.02)]
)
def test_a_cycle_that_changes_nothing_takes_no_memory(rig: Rig, goal: Any) -> None:
    rig.enable()
    if goal is not None:
        rig.send("g1", goal)
        rig.cycles(100)
    assert rig.mode is (Mode.MOVING if goal else Mode.HOLDING)
    alone(lambda: takes_no_memory(rig))


@pytest.mark.long
def test_a_cycle_in_which_a_goal_waits_to_settle_takes_no_memory(rig: Rig) -> None:
    rig.enable()
    rig.send("g1", PoseGoal(0.01, 0.0, 0.0))
    settling = rig.control.measured.settling
    settling.monitored["window"] = -1.0  # nothing is ever inside
    settling._timeout = 10**6
    rig.until(lambda: settling.under_way)

    def waits() -> None:
        takes_no_memory(rig)
        assert settling.under_way

    alone(waits)


def takes_no_memory(rig: Rig) -> None:
    """Run many cycles in which nothing changes, on drives that take no memory themselves."""
    control = rig.control
    mode = control.state.mode
    drives = Followers(control.measured.feedback)
    control._drives = cast(DriveGroup, drives)

    def cycle() -> None:
        drives.sync()
        control.cycle(drives.read)

    for _ in range(10):  # the followers are in step then
        cycle()
    grown, in_use = what_memory_takes(cycle, 500)
    assert control.state.mode is mode
    assert grown <= KEPT
    assert in_use <= IN_USE
