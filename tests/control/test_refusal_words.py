"""What people read of a refusal, of a goal of any kind: millimetres and degrees, and no rows of digits."""

from __future__ import annotations

import re

import pytest
from control_rig import CONFIG, ControlRig
from hypothesis import given, settings
from hypothesis import strategies as st
from trirail.config import geometry
from trirail.control.ledger import Ledger
from trirail.errors import KinematicsError, RefusalCode, RefusedError
from trirail.kinematics.robot import forward, inverse
from trirail.wire.goals import (
    Goal,
    MoveGoal,
    OwnLimits,
    PoseGoal,
    SlidersGoal,
    TrackGoal,
    TrajectoryGoal,
    TrajectoryPoint,
    VelocityGoal,
)
from trirail.wire.packets import CommandRequest, GoalRequest, Refused
from trirail.wire.vocabulary import Command

FAR = st.floats(-3.0, 3.0)
"""Metres or radians: most are out of reach."""
EDGES = (*CONFIG.limits.platform.x, *CONFIG.limits.platform.phi, *CONFIG.limits.slider.positions[0])
HARDLY = st.builds(lambda edge, more: edge * (1.0 + more), st.sampled_from(EDGES), st.floats(-1e-3, 1e-3))
VALUES = FAR | HARDLY
THREE = st.tuples(VALUES, VALUES, VALUES)
POINTS = st.lists(THREE, min_size=2, max_size=4).map(
    lambda poses: tuple(TrajectoryPoint(0.1 * n, *pose) for n, pose in enumerate(poses))
)
LIMITS = st.builds(OwnLimits, velocity=st.tuples(*[st.floats(1e-3, 10.0)] * 3))
GOALS: st.SearchStrategy[Goal] = st.one_of(
    st.builds(PoseGoal, VALUES, VALUES, VALUES, limits=st.none() | LIMITS),
    st.builds(MoveGoal, VALUES, VALUES, VALUES),
    st.builds(SlidersGoal, THREE),
    st.builds(VelocityGoal, VALUES, VALUES, VALUES, timeout=st.just(0.2)),
    st.builds(TrackGoal, VALUES, VALUES, VALUES, THREE),
    st.builds(TrajectoryGoal, POINTS),
)
SI = re.compile(r"\d (rad|m)(?![a-zµ²³])")
"""A number in metres, or in radians."""


def assert_readable(words: str) -> None:
    assert not SI.search(words), words
    numbers = re.findall(r"-?\d+\.?\d*(?:e[-+]?\d+)?", words)
    digits = [len(number.split("e")[0].replace(".", "").lstrip("-0")) for number in numbers]
    # Two that are to be told apart have as many digits as that takes: it is said by how much wherever that can be.
    told_apart = re.search("above the limit|the robot's limit|begins at", words)
    assert max(digits, default=0) <= (17 if told_apart else 6), words


@pytest.fixture(scope="module")
def enabled() -> ControlRig:
    rig = ControlRig()
    rig.enable()
    return rig


@settings(max_examples=300)
@given(goal=GOALS)
def test_a_refusal_has_millimetres_and_degrees(enabled: ControlRig, goal: Goal) -> None:
    answered = len(enabled.answers)
    enabled.post(f"g{answered}", goal)
    enabled.until(lambda: len(enabled.answers) > answered)
    for answer in enabled.answers[answered:]:
        if isinstance(answer, Refused):
            assert_readable(answer.message)
    for notice in enabled.notices:
        assert_readable(re.sub(r"goal g\d+", "", notice.message))
    enabled.notices.clear()
    enabled.command("stop")
    enabled.until(enabled.holds)


@given(pose=THREE)
def test_so_have_the_words_of_the_kinematics(pose: tuple[float, float, float]) -> None:
    for compute in (inverse, forward):
        said = ""
        try:
            compute(geometry(CONFIG.geometry), pose)
        except KinematicsError as error:
            said = str(error)
        assert not SI.search(said), said


@pytest.mark.parametrize("code", list(RefusalCode))
def test_every_refusal_is_told_to_all_with_its_code_and_values(code: RefusalCode) -> None:
    """The page says it in its own language by these."""
    ledger = Ledger()
    refusal = RefusedError(code, "why", slider="B", value=2.0, limit=1.0)
    ledger.refuse(GoalRequest(1, "ann", "g", PoseGoal(0.0, 0.0, 0.0), 0), refusal)
    ledger.refuse(CommandRequest(2, "ann", Command.RESET), refusal)
    assert [(said.code, said.slider, said.value, said.limit) for said in ledger.notices] == [(code, "B", 2.0, 1.0)] * 2
