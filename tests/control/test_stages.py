"""Alignment stages: whole sessions of shipped configurations, in simulated time, on simulated drives."""

from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
from conftest import Rig
from numpy.testing import assert_allclose
from trirail.config import SIM, Config, geometry, load, parse
from trirail.config.tables import OneSlider
from trirail.errors import ConfigError
from trirail.kinematics.robot import inverse
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal
from trirail.wire.packets import Accepted, Refused

STAGES = ("uvw", "xxy", "uvw-ppr")
POSES = ((0.003, -0.002, 0.05), (-0.004, 0.001, -0.03), (0.0, 0.0, 0.0))


@pytest.fixture(params=STAGES)
def stage(request: pytest.FixtureRequest) -> Iterator[Rig]:
    rig = Rig(load(SIM.with_name(f"{request.param}.toml")))
    rig.enable()
    yield rig
    rig.bus.shutdown()


def with_own(config: Config, **own: OneSlider) -> Config:
    slider = msgspec.structs.replace(config.limits.slider, **own)
    return msgspec.structs.replace(config, limits=msgspec.structs.replace(config.limits, slider=slider))


WEAK = OneSlider(position=(-0.005, 0.004), velocity=0.008, acceleration=0.2, jerk=6.0)


@pytest.mark.parametrize("slider", [0, 1, 2])
def test_each_slider_keeps_its_own_limits(slider: int) -> None:
    """Goals in pose and in slider space, made as fast as they go: the weak slider at its limits, the others not."""
    rig = Rig(with_own(load(SIM.with_name("uvw-ppr.toml")), **{"ABC"[slider]: WEAK}))
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
    rig.bus.shutdown()


def test_a_sliders_own_limits_are_read_from_its_table() -> None:
    text = SIM.with_name("uvw.toml").read_text()
    own = "\n[limits.slider.C]\nposition = [-0.005, 0.005]\njerk = 20.0\n\n[limits.in_position]"
    slider = parse(text.replace("\n[limits.in_position]", own)).limits.slider
    assert slider.positions == ((-0.01, 0.01), (-0.01, 0.01), (-0.005, 0.005))
    assert (slider.velocities, slider.accelerations, slider.jerks) == ((0.03,) * 3, (1.0,) * 3, (40.0, 40.0, 20.0))
    with pytest.raises(ConfigError, match=r"limits\.slider\.C\.position = \[0\.005, -0\.005\]: the lower limit"):
        parse(text.replace("\n[limits.in_position]", own.replace("[-0.005, 0.005]", "[0.005, -0.005]")))


def test_goals_end_in_their_windows_and_within_limits(stage: Rig) -> None:
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


def test_sliders_go_where_they_are_to_go_together(stage: Rig) -> None:
    """A straight path of the sliders runs through the forward kinematics in every cycle."""
    target = tuple(inverse(geometry(stage.config.geometry), (0.002, 0.004, -0.04)).position.tolist())
    assert isinstance(stage.send("s", SlidersGoal(target)), Accepted)
    stage.until(stage.holds)
    assert_allclose(stage.setpoints()[-1][0], target, atol=1e-9)
    assert_allclose(stage.control.measured.record["pose"][0], (0.002, 0.004, -0.04), atol=3e-6)
    assert stage.outcomes() == [("s", "done")]


def test_a_goal_beyond_a_sliders_stroke_is_refused_with_the_slider(stage: Rig) -> None:
    answer = stage.goal("far", 0.0099, -0.0099, 0.087)
    assert isinstance(answer, Refused)
    assert answer.slider in {"A", "B", "C"}
    assert answer.limit is not None
    assert abs(answer.limit) == 0.01
