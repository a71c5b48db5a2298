"""What is made of the drives' answers: where none of a slider can be so soon is not taken for its place."""

from __future__ import annotations

import pytest
from control_rig import CONFIG
from hypothesis import example, given
from hypothesis import strategies as st
from trirail.config import geometry
from trirail.control.feedback import MeasuredState
from trirail.kinematics.robot import forward, inverse
from trirail_drivers.interface import Feedback, PowerState

PERIOD = CONFIG.period
ROBOT = geometry(CONFIG.geometry)
STEP = CONFIG.limits.slider.velocities[0] * PERIOD
ON = (PowerState.OPERATION_ENABLED,) * 3
Triple = tuple[float, float, float]


def standing(position: Triple) -> MeasuredState:
    measured = MeasuredState(ROBOT.packed(), PERIOD, STEP)
    measured.start(Feedback(position, ON, None))
    measured.update(Feedback(position, ON, None))
    return measured


PLACES = st.tuples(*[st.floats(-0.03, 0.03)] * 2, st.floats(-0.2, 0.2))
SHARES = st.floats(-1.999, 1.999) | st.floats(2.001, 60.0) | st.floats(-60.0, -2.001)
"""Of the way that a slider goes in a cycle at most."""


@example(place=(0.0, 0.0, 0.0), shares=(2.001, 0.0, 0.0))
@example(place=(0.0, 0.0, 0.0), shares=(0.0, -2.001, 0.0))
@given(place=PLACES, shares=st.tuples(SHARES, SHARES, SHARES))
def test_only_a_slider_that_goes_twice_as_far_as_one_can_has_jumped(place: Triple, shares: Triple) -> None:
    a, b, c = inverse(ROBOT, place).position.tolist()
    measured = standing((a, b, c))
    before = measured.pose
    moved = (a + shares[0] * STEP, b + shares[1] * STEP, c + shares[2] * STEP)
    measured.update(Feedback(moved, ON, None))
    assert measured.jumps == tuple(abs(share) > 2.0 for share in shares)
    if any(measured.jumps):
        assert measured.pose == before
    else:
        assert measured.pose == pytest.approx(forward(ROBOT, moved, near=before), abs=1e-9)
    assert measured.velocity == pytest.approx([share * STEP / PERIOD for share in shares], abs=1e-9)


@given(place=PLACES)
def test_the_first_cycle_is_no_jump_wherever_the_robot_stands(place: Triple) -> None:
    a, b, c = inverse(ROBOT, place).position.tolist()
    measured = MeasuredState(ROBOT.packed(), PERIOD, STEP)
    measured.start(Feedback((a, b, c), ON, None))
    measured.update(Feedback((a, b, c), ON, None))
    assert measured.jumps == (False, False, False)
    assert measured.velocity == measured.following_error == (0.0, 0.0, 0.0)
    assert measured.pose == pytest.approx(place, abs=1e-9)


def test_before_the_first_answer_nothing_has_jumped() -> None:
    assert MeasuredState(ROBOT.packed(), PERIOD, STEP).jumps == (False, False, False)


POSITION = st.floats(-0.01, 0.01)
TRIPLES = st.tuples(POSITION, POSITION, POSITION)


@given(
    written=st.lists(TRIPLES, min_size=1, max_size=12),
    position=TRIPLES,
    age=st.tuples(*[st.integers(0, 3)] * 3),
    follows=st.tuples(*[st.booleans()] * 3),
)
def test_following_error_is_to_the_setpoint_that_was_due_at_the_sync_of_the_position(
    written: list[Triple], position: Triple, age: tuple[int, int, int], follows: tuple[bool, bool, bool]
) -> None:
    """A setpoint is taken up at the SYNC after it was written, and reached at the one after that."""
    first = (0.001, -0.002, 0.003)
    measured = standing(first)
    for setpoint in written:
        measured.record["commanded_position"] = setpoint
        measured.update(Feedback(first, ON, None))
    measured.record["commanded_position"] = last = (0.004, 0.005, -0.006)
    measured.update(Feedback(position, ON, None, age=age, follows=follows))
    due = [first] * 6 + written + [last]
    expected = [due[-2 - age[n]][n] - position[n] if follows[n] else 0.0 for n in range(3)]
    assert measured.following_error == pytest.approx(expected, abs=1e-15)


def test_a_position_that_is_older_than_the_setpoints_that_are_kept_is_compared_with_none_of_them() -> None:
    """As of drives that a busy machine has kept waiting, where missed_positions lets them: it is no fault of theirs."""
    limit = CONFIG.limits.slider.following_error
    measured, step = MeasuredState(ROBOT.packed(), PERIOD, STEP, limit), 0.9 * limit
    measured.start(Feedback((0.0, 0.0, 0.0), ON, None))
    for age in range(30):
        measured.record["commanded_position"] = ((age + 1) * step, 0.0, 0.0)
        assert measured.update(Feedback((0.0, 0.0, 0.0), ON, None, age=(age, 0, 0))) == 0
        assert measured.following_error == (0.0, 0.0, 0.0)
    assert measured.update(Feedback((0.0, 0.0, 0.0), ON, None)) == 1


@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_following_error_is_beyond_its_limit_when_it_is_more(index: int, sign: float) -> None:
    limit = 2.0**-8  # [m], a number that is exact
    measured = MeasuredState(ROBOT.packed(), PERIOD, STEP, limit)
    measured.start(Feedback((0.0, 0.0, 0.0), ON, None))
    for error, beyond in ((limit, 0), (limit * (1.0 + 1e-9), 1 + index)):
        position = [0.0, 0.0, 0.0]
        position[index] = -sign * error
        a, b, c = position
        assert measured.update(Feedback((a, b, c), ON, None)) == beyond
        assert measured.following_error[index] == sign * error


def test_sliders_that_belong_to_no_pose_leave_the_pose_as_it_was() -> None:
    measured = MeasuredState(ROBOT.packed(), PERIOD, 10.0)  # none jumps
    measured.start(Feedback((0.0, 0.0, 0.0), ON, None))
    measured.update(Feedback((0.01, 0.0, 0.0), ON, None))
    before = measured.pose
    nowhere = (1.0, 1.0, 1.0)
    assert measured.pose_of(nowhere) is None
    measured.update(Feedback(nowhere, ON, None))
    assert not any(measured.jumps)
    assert measured.pose == before


THREE = st.tuples(*[st.booleans()] * 3)


@given(
    state=st.tuples(*[st.sampled_from(PowerState)] * 3),
    age=st.tuples(*[st.integers(0, 3)] * 3),
    follows=THREE,
    homed=THREE,
    homing=st.booleans(),
)
def test_the_record_has_what_each_drive_said(
    state: tuple[PowerState, PowerState, PowerState],
    age: tuple[int, int, int],
    follows: tuple[bool, bool, bool],
    homed: tuple[bool, bool, bool],
    homing: bool,
) -> None:
    measured = standing((0.0, 0.0, 0.0))
    measured.update(Feedback((1e-4, 2e-4, 3e-4), state, None, age=age, follows=follows, homed=homed, homing=homing))
    record = measured.record[0]
    assert record["position"].tolist() == [1e-4, 2e-4, 3e-4]
    assert tuple(record["drive_state"].tolist()) == state
    assert tuple(record["age"].tolist()) == age
    assert tuple(record["follows"].tolist()) == follows
    assert tuple(record["homed"].tolist()) == homed
    assert bool(record["homing"]) is homing


@pytest.mark.parametrize("index", range(3))
def test_a_robot_is_powered_while_any_drive_can_move_its_slider(index: int) -> None:
    measured = standing((0.0, 0.0, 0.0))
    can_move = {PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE}
    for state in PowerState:
        states = [PowerState.SWITCH_ON_DISABLED] * 3
        states[index] = state
        measured.update(Feedback((0.0, 0.0, 0.0), (states[0], states[1], states[2]), None))
        assert measured.powered == (state in can_move)
