"""Alignment stages: whole sessions of shipped configurations, in simulated time, on simulated drives."""

import msgspec
import numpy as np
import pytest
from control_rig import ControlRig
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from trirail.config import SIM, Config, SliderLimits, geometry, load, parse
from trirail.errors import ConfigError
from trirail.kinematics.geometry import travels
from trirail.kinematics.robot import inverse
from trirail.motion.limits import Bounds
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal
from trirail.wire.packets import Accepted, Refused
from trirail_drivers.interface import Triple

STAGES = ("uvw", "xxy", "uvw-ppr")
POSES = ((0.003, -0.002, 0.05), (-0.004, 0.001, -0.03), (0.0, 0.0, 0.0))


@pytest.fixture(params=STAGES)
def stage(request: pytest.FixtureRequest) -> ControlRig:
    rig = ControlRig(load(SIM.with_name(f"{request.param}.toml")))
    rig.enable()
    return rig


def with_own(config: Config, **own: object) -> Config:
    """The configuration with limits of its own for each slider."""
    slider = msgspec.structs.replace(config.limits.slider, **own)
    return msgspec.structs.replace(config, limits=msgspec.structs.replace(config.limits, slider=slider))


def weak(slider: int) -> dict[str, object]:
    """Limits of which those of one slider are by far the least."""
    weakest = {"position": (-0.005, 0.004), "velocity": 0.008, "acceleration": 0.2, "jerk": 6.0}
    others = {"position": (-0.01, 0.01), "velocity": 0.03, "acceleration": 1.0, "jerk": 40.0}
    return {key: tuple(weakest[key] if k == slider else others[key] for k in range(3)) for key in weakest}


@pytest.mark.parametrize("slider", [0, 1, 2])
def test_each_slider_keeps_its_own_limits(slider: int) -> None:
    """Goals in pose and in slider space, made as fast as they go: the weak slider at its limits, the others not."""
    rig = ControlRig(with_own(load(SIM.with_name("uvw-ppr.toml")), **weak(slider)))
    rig.enable()
    limits, robot = rig.config.limits.slider, geometry(rig.config.geometry)
    target = tuple(inverse(robot, (-0.002, -0.002, 0.01)).position.tolist())
    goals: tuple[Goal, ...] = (
        PoseGoal(x=0.0025, y=0.002, phi=0.01),
        SlidersGoal(target),
        PoseGoal(x=0.0, y=0.0, phi=0.0),
    )
    for number, goal in enumerate(goals):
        assert isinstance(rig.send(f"g{number}", goal), Accepted)
        rig.until(rig.holds)
    rows = rig.setpoints()
    rates = rows[:, 1], rows[:, 2], np.diff(rows[:, 2], axis=0) / rig.config.period
    shares = []
    for found, each in zip(rates, (limits.velocities, limits.accelerations, limits.jerks), strict=True):
        share = np.abs(found).max(axis=0) / each
        assert np.all(share <= 1.001)
        shares.append(share[slider])
        assert np.abs(found[:, slider]).max() < 0.5 * max(each)
    assert max(shares) > 0.8
    answer = rig.send("far", SlidersGoal(tuple(0.0045 if k == slider else 0.0 for k in range(3))))  # type: ignore[arg-type]
    assert isinstance(answer, Refused)
    assert (answer.slider, answer.limit) == ("ABC"[slider], 0.004)


def three(low: float, high: float) -> st.SearchStrategy[tuple[float, float, float]]:
    each = st.floats(low, high)
    return st.tuples(each, each, each)


WAYS = st.lists(st.tuples(st.floats(-0.008, 0.008), st.floats(-0.008, 0.008), st.floats(-0.06, 0.06)), max_size=3)


@settings(max_examples=30)
@given(
    st.sampled_from(STAGES), three(-0.01, -0.002), three(0.002, 0.01), three(0.006, 0.03), three(0.2, 1.0),
    three(8.0, 40.0), WAYS,
)  # fmt: skip
def test_whatever_limits_the_sliders_have_planner_and_gate_keep_them(
    stage: str, low: Triple, high: Triple, v: Triple, a: Triple, j: Triple, poses: list[Triple]
) -> None:
    """What is accepted never leaves them, what is refused is beyond one of them, and the gate lets nothing through."""
    config = with_own(
        load(SIM.with_name(f"{stage}.toml")),
        position=tuple(zip(low, high, strict=True)), velocity=v, acceleration=a, jerk=j,
    )  # fmt: skip
    rig, robot = ControlRig(config), geometry(config.geometry)
    rig.enable()
    for number, pose in enumerate(poses):
        sliders, passive = travels(robot, pose)
        beyond = bool((sliders < low).any() or (sliders > high).any())
        answer = rig.goal(f"g{number}", *pose)
        assert not beyond or isinstance(answer, Refused)
        if isinstance(answer, Refused):
            leg = "ABC".index(answer.slider or "")
            assert beyond or np.abs(passive).max() > config.limits.slider.passive[1]
            assert answer.limit in (low[leg], high[leg], *config.limits.slider.passive)
        rig.until(rig.holds)
    if poses:
        rows = rig.setpoints()
        assert np.all((rows[:, 0] >= np.subtract(low, 1e-9)) & (rows[:, 0] <= np.add(high, 1e-9)))
        for found, each in zip(
            (rows[:, 1], rows[:, 2], np.diff(rows[:, 2], axis=0) / config.period), (v, a, j), strict=True
        ):
            assert np.all(np.abs(found).max(axis=0) <= np.multiply(each, 1.001))
    bounds = Bounds(config.limits, config.period, 0.0)
    for leg in range(3):
        for row, limit in ((0, low[leg]), (0, high[leg]), (1, v[leg]), (1, -v[leg]), (2, a[leg])):
            rows = np.zeros((4, 3))
            for share, passes in ((0.999, True), (1.002, False)):
                rows[row, leg] = share * limit
                violation = bounds.setpoint_violation(rows)
                assert (violation is None) is passes
                assert violation is None or (violation.axis, violation.limit) == ("ABC"[leg], limit)


def read(**own: str) -> SliderLimits:
    """Return limits of uvw.toml, of which some are written otherwise."""
    lines = SIM.with_name("uvw.toml").read_text().split("[limits.slider]")
    rest = [
        f"{key} = {own.pop(key)}" if (key := line.partition(" ")[0]) in own else line for line in lines[1].split("\n")
    ]
    return parse("[limits.slider]".join((lines[0], "\n".join(rest)))).limits.slider


def test_a_limit_is_one_for_all_sliders_or_three() -> None:
    one = read()
    assert one.positions == ((-0.01, 0.01),) * 3
    assert (one.velocities, one.accelerations, one.jerks) == ((0.03,) * 3, (1.0,) * 3, (40.0,) * 3)
    own = read(
        position="[[-0.01, 0.01], [-0.01, 0.01], [-0.005, 0.004]]", velocity="[0.03, 0.03, 0.02]", jerk="[1, 2, 3]"
    )
    assert own.positions == ((-0.01, 0.01), (-0.01, 0.01), (-0.005, 0.004))
    assert (own.velocities, own.accelerations, own.jerks) == ((0.03, 0.03, 0.02), (1.0,) * 3, (1.0, 2.0, 3.0))
    assert own.fastest == 0.03


ONE, PAIR = (
    "expected one number for all sliders, or three: of A, B, C",
    "expected a pair for all sliders, or three pairs",
)
WRONG = {
    ("velocity", "[0.03, 0.02]"): f"limits.slider.velocity = [0.03, 0.02]: {ONE}",
    ("jerk", "[]"): f"limits.slider.jerk = []: {ONE}",
    ("acceleration", "{ A = 1.0 }"): f"limits.slider.acceleration = {{'A': 1.0}}: {ONE}",
    ("velocity", '"fast"'): f"limits.slider.velocity = 'fast': {ONE}",
    ("velocity", "250"): f"limits.slider.velocity = 250: {ONE}; each 1e-05 to 100",
    ("velocity", "true"): f"limits.slider.velocity = True: {ONE}",
    ("velocity", "[0.03, 0.02, -1]"): "limits.slider.velocity[2] = -1: expected number, 1e-05 to 100",
    ("velocity", "[0.03, nan, 0.1]"): "limits.slider.velocity[1] = nan: it must be a finite number",
    ("position", "[0.1]"): f"limits.slider.position = [0.1]: {PAIR}",
    ("position", "[-0.01, 0.01, 0.02]"): f"limits.slider.position = [-0.01, 0.01, 0.02]: {PAIR}",
    ("position", "[[-0.01, 0.01], [-0.01, 0.01]]"): f"limits.slider.position = [[-0.01, 0.01], [-0.01, 0.01]]: {PAIR}",
    ("position", "[-0.01, [0.0, 0.01]]"): f"limits.slider.position = [-0.01, [0.0, 0.01]]: {PAIR}",
    ("position", "0.01"): f"limits.slider.position = 0.01: {PAIR}",
    ("position", "[[-0.01, 0.01], [0.005, -0.005], [-0.01, 0.01]]"):
        "limits.slider.position[1] = [0.005, -0.005]: the lower limit must be below the upper one",
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG, ids=str)
def test_a_limit_of_another_shape_is_refused_with_what_is_allowed(wrong: tuple[str, str]) -> None:
    key, value = wrong
    with pytest.raises(ConfigError) as refused:
        read(**{key: value})
    assert str(refused.value).startswith(WRONG[wrong])


def test_goals_end_in_their_windows_and_within_limits(stage: ControlRig) -> None:
    robot, limits = geometry(stage.config.geometry), stage.config.limits
    for k, pose in enumerate(POSES):
        assert isinstance(stage.goal(f"g{k}", *pose), Accepted)
        stage.until(stage.holds)
        there = stage.control.measured.record[0]
        assert np.all(np.abs(there["pose"] - pose) <= limits.in_position.pose)
        expected = inverse(robot, pose)
        assert np.all(np.abs(there["position"] - expected.position) <= limits.in_position.sliders)
        assert_allclose(stage.setpoints()[-1][[0, 3]], expected[::3], atol=1e-12)
    assert stage.outcomes() == [(f"g{k}", "done") for k in range(len(POSES))]
    rows, slider = stage.setpoints(), limits.slider
    for row, limit in ((1, slider.velocity), (2, slider.acceleration)):
        assert np.all(np.abs(rows[:, row]) <= np.multiply(limit, 1.001))
    assert np.all(np.abs(np.diff(rows[:, 2], axis=0)) <= np.multiply(slider.jerk, 1.001 * stage.config.period))


def test_sliders_go_where_they_are_to_go_together(stage: ControlRig) -> None:
    """A straight path of the sliders runs through the forward kinematics in every cycle."""
    target = tuple(inverse(geometry(stage.config.geometry), (0.002, 0.004, -0.04)).position.tolist())
    assert isinstance(stage.send("s", SlidersGoal(target)), Accepted)
    stage.until(stage.holds)
    assert_allclose(stage.setpoints()[-1][0], target, atol=1e-9)
    assert_allclose(stage.control.measured.record["pose"][0], (0.002, 0.004, -0.04), atol=3e-6)
    assert stage.outcomes() == [("s", "done")]


def test_a_goal_beyond_a_sliders_stroke_is_refused_with_the_slider(stage: ControlRig) -> None:
    answer = stage.goal("far", 0.0099, -0.0099, 0.087)
    assert isinstance(answer, Refused)
    assert answer.slider in {"A", "B", "C"}
    assert answer.limit is not None
    assert abs(answer.limit) == 0.01
