"""Of which kind a stage is: random stages of both, told apart by a mark that somebody reads, not exactly."""

import math
from pathlib import Path

import numpy as np
import pytest
from commissioning.test_guide import Beside, Run
from generated import thinned
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from trirail.commissioning import kind_step
from trirail.commissioning.mechanism_kind import (
    AMPLE_SEPARATION,
    MARK_RADIUS_M,
    MIN_SEPARATION,
    KindTestMove,
    MarkPrediction,
    find_test_move,
    judge_kind,
    predict_mark,
)
from trirail.commissioning.person import Question, ask_length
from trirail.config import SIM, geometry, load
from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import CrossLeg, Geometry, Leg, other_kind, travels
from trirail.kinematics.robot import forward

STAGE = load(SIM.with_name("uvw.toml"))
RIGHT = math.pi / 2.0
FILES = {name: load(SIM.with_name(f"{name}.toml")) for name in ("uvw", "xxy", "uvw-ppr", "sim")}


@st.composite
def stages(draw: st.DrawFn) -> Geometry:
    """Three rails along x or y, not all alike, none quite so, nor quite square to what they carry."""
    kind = draw(st.sampled_from((Leg, CrossLeg)))
    across = draw(st.integers(0, 2))
    legs = []
    for k in range(3):
        at = draw(st.tuples(st.floats(-0.08, 0.08), st.floats(-0.08, 0.08)))
        rail = (RIGHT if k == across else 0.0) + draw(st.floats(-0.05, 0.05))
        legs.append(kind(at, rail, 0.0, at, rail + RIGHT + draw(st.floats(-0.05, 0.05))))
    try:
        robot = Geometry((legs[0], legs[1], legs[2]))
        forward(other_kind(robot), (1e-4, 0.0, 0.0))
        forward(robot, (1e-4, 0.0, 0.0))
    except KinematicsError:
        assume(False)
    return robot


def mark(robot: Geometry, sliders: Array, at: tuple[float, float]) -> Array:
    """Where a point of the platform is, x and y [m]."""
    x, y, phi = forward(robot, sliders).tolist()
    u, v = at
    return np.array([x + u * math.cos(phi) - v * math.sin(phi), y + u * math.sin(phi) + v * math.cos(phi)])


@settings(max_examples=100)
@given(
    stages(), st.booleans(), st.sampled_from((1e-6, 5e-6, 2e-5, 3e-4)), st.floats(0.0, MARK_RADIUS_M),
    st.floats(0.0, 6.3), st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)), st.integers(0, 9),
)  # fmt: skip
def test_the_kind_is_told_whatever_the_instrument_and_the_stage(
    robot: Geometry, mistaken: bool, read_to: float, far: float, where: float, reading: tuple[float, float], seed: int
) -> None:
    """Encoders know the sliders to 0.1 µm, the instrument reads as finely as it can, the mark is near the centre."""
    other = other_kind(robot)
    start = travels(robot, (0.0, 0.0, 0.0))[0]
    found = find_test_move(STAGE, robot, other, start, read_to)
    if found is None:
        return
    way, expected = found
    kinds, real = (robot.kind, other.kind), other if mistaken else robot
    if expected.separation < MIN_SEPARATION * read_to:
        judged = judge_kind(kinds, way, expected, None, read_to)
        assert (judged.verdict, "too short to distinguish the kinds" in judged.words[1]) == ("skipped", True)
        return
    random, point = np.random.default_rng(seed), (far * math.cos(where), far * math.sin(where))
    first, second = (sliders + random.uniform(-1e-7, 1e-7, 3) for sliders in (way.first, way.second))
    before, after = (mark(real, sliders, point)[way.axis] for sliders in (way.first, way.second))
    moved = float(after - before) + read_to * (reading[1] - reading[0])
    try:
        seen = predict_mark(robot, other, first, second, way.axis)
    except KinematicsError:  # the step ends as failed
        return
    judged = judge_kind(kinds, way, seen, moved, read_to)
    assert judged.verdict == ("wrong" if mistaken else "ok"), judged
    assert judged.words[1].endswith(f"it is a {other.kind}, not a {robot.kind}" if mistaken else "as configured")
    assert (f'kind = "{other.kind}"' in judged.remedy) is mistaken


@settings(max_examples=50)
@given(stages(), st.sampled_from((1e-6, 1e-5)), st.tuples(*[st.floats(-0.4, 0.4)] * 3))
def test_either_kind_stays_within_its_limits_all_the_way(
    robot: Geometry, read_to: float, at: tuple[float, float, float]
) -> None:
    platform, other = STAGE.limits.platform, other_kind(robot)
    box = np.array([platform.x, platform.y, platform.phi])
    start = travels(robot, box.mean(axis=1) + np.multiply(at, np.ptp(box, axis=1)))[0]
    found = find_test_move(STAGE, robot, other, start, read_to)
    if found is None:
        return
    way, _ = found
    for a, b in ((start, way.first), (way.first, way.second), (way.second, start)):
        for share in np.linspace(0.0, 1.0, 21):
            sliders = a + share * (b - a)
            assert np.abs(sliders).max() <= 0.01 + 1e-9
            for each in (robot, other):
                pose = forward(each, sliders)
                assert np.all((pose >= box[:, 0] - 1e-6) & (pose <= box[:, 1] + 1e-6))
                assert np.abs(travels(each, pose)[1]).max() <= 0.018 + 1e-6


@pytest.mark.parametrize(("name", "coarse"), [("uvw", 5e-6), ("xxy", 5e-6), ("uvw-ppr", 5e-6), ("sim", 1e-4)])
def test_no_way_is_larger_than_it_has_to_be(name: str, coarse: float) -> None:
    config = FILES[name]
    robot = geometry(config.geometry)
    distances = []
    for read_to in (1e-6, coarse):
        found = find_test_move(config, robot, other_kind(robot), travels(robot, (0.0, 0.0, 0.0))[0], read_to)
        assert found is not None
        assert found[1].separation >= AMPLE_SEPARATION * read_to
        distances.append(found[0].distance)
    assert distances[0] < distances[1]


@given(st.sampled_from(("uvw", "xxy", "uvw-ppr", "sim")), st.floats(1e-6, 1e-5))
def test_the_separation_is_no_more_than_needed(name: str, read_to: float) -> None:
    config = FILES[name]
    robot = geometry(config.geometry)
    found = find_test_move(config, robot, other_kind(robot), travels(robot, (0.0, 0.0, 0.0))[0], read_to)
    assert found is not None
    assert AMPLE_SEPARATION <= found[1].separation / read_to < 1.5 * AMPLE_SEPARATION


def test_what_is_neither_kind_is_said() -> None:
    expected = MarkPrediction(0.0, 4e-4, 0.0)
    way = KindTestMove(np.zeros(3), np.zeros(3), 1, 0.05, 0, 0.01)
    for moved in (-4e-4, 2e-4, 1e-3):
        judged = judge_kind(("3-PRP", "3-PPR"), way, expected, moved, 1e-6)
        assert (judged.verdict, judged.words[1].endswith("it is neither")) == ("wrong", True)


@given(st.integers(1, 4999), st.sampled_from((("", 1000), ("mm", 1000), ("um", 1), (" µm", 1), ("μm", 1))))
def test_somebody_may_answer_in_microns(microns: int, written: tuple[str, int]) -> None:
    unit, per = written
    person = Beside(answers={"How far": [f"{microns / per:.3f}{unit}".replace(".", ",")]})
    assert ask_length(person, lambda: None, Question("How far?")) == pytest.approx(microns * 1e-6, rel=1e-12)


@pytest.mark.parametrize("name", thinned(["uvw", "uvw-ppr"]))
@pytest.mark.long
def test_a_stage_of_the_other_kind_is_found_by_the_guide(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the simulated instrument shows is the other kind's: the guide says which it is, and what to write."""
    robot = geometry(FILES[name].geometry)
    other = other_kind(robot)
    monkeypatch.setattr(kind_step, "forward", lambda _, sliders: forward(other, sliders))
    run = Run(tmp_path, FILES[name], person=Beside(["by hand"]), source=SIM.with_name(f"{name}.toml"))
    entry = run.of("kind")
    assert entry.verdict == "wrong", entry
    assert entry.words[1].endswith(f"it is a {other.kind}, not a {robot.kind}")
    assert f'kind = "{other.kind}"' in entry.remedy
    assert entry.measured["other"] == pytest.approx(entry.measured["moved"], abs=2e-6)
