"""Alignment stages: whole sessions of shipped configurations, in simulated time, on simulated drives."""

from collections.abc import Iterator

import numpy as np
import pytest
from conftest import Rig
from numpy.testing import assert_allclose
from trirail.config import SIM, geometry, load
from trirail.kinematics.robot import inverse
from trirail.wire.goals import SlidersGoal
from trirail.wire.packets import Accepted, Refused

STAGES = ("uvw", "xxy", "uvw-ppr")
POSES = ((0.003, -0.002, 0.05), (-0.004, 0.001, -0.03), (0.0, 0.0, 0.0))


@pytest.fixture(params=STAGES)
def stage(request: pytest.FixtureRequest) -> Iterator[Rig]:
    rig = Rig(load(SIM.with_name(f"{request.param}.toml")))
    rig.enable()
    yield rig
    rig.bus.shutdown()


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
