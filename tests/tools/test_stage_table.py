"""tools/stage_table.py: a stage in numbers, of either kind."""

import json
import math

import numpy as np
import pytest
import stage_table
from hypothesis import given
from hypothesis import strategies as st
from trirail.config import SIM, geometry, load
from trirail.kinematics.robot import inverse

STAGES = ("uvw", "xxy", "uvw-ppr")
PIVOTS = {"U": (57.5, -57.5), "V": (57.5, 57.5), "W": (-57.5, 57.5)}


@given(
    st.sampled_from(STAGES),
    st.lists(st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.floats(-0.5, 0.5)), min_size=1, max_size=3),
    st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-5.0, 5.0)),
)
def test_every_row_is_that_of_60_digits(
    name: str, poses: list[tuple[float, float, float]], velocity: tuple[float, float, float]
) -> None:
    robot = geometry(load(SIM.with_name(f"{name}.toml")).geometry)
    table = stage_table.rows(robot, poses, velocity)
    for row, pose in zip(table, poses, strict=True):
        motion = inverse(robot, pose, velocity)
        assert (row.sliders, row.velocity) == (motion.position.tolist(), motion.velocity.tolist())
        assert row.passive == motion.passive_position.tolist()
        assert row.difference < 1e-12


def test_a_wrong_closed_form_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = geometry(load(stage_table.STAGE).geometry)
    monkeypatch.setattr(stage_table, "inverse", lambda *told: inverse(*told)._replace(velocity=np.zeros(3)))
    (row,) = stage_table.rows(robot, [(0.001, 0.0, 0.01)], (0.0, 0.01, 0.0))
    assert row.difference == pytest.approx(0.01, rel=1e-3)


def test_what_small_angles_lose_is_by_their_equations() -> None:
    """Drives along x go x - py θ, those along y y + px θ."""
    robot = geometry(load(stage_table.STAGE).geometry)
    for row in stage_table.rows(robot, stage_table.POSES, stage_table.PLATFORM):
        x, y, turn = row.pose[0] * 1e3, row.pose[1] * 1e3, row.pose[2]
        simple = [x - PIVOTS["U"][1] * turn, x - PIVOTS["V"][1] * turn, y + PIVOTS["W"][0] * turn]
        assert row.small_angles * 1e3 == pytest.approx(np.abs(np.multiply(row.sliders, 1e3) - simple).max(), abs=1e-12)


def test_it_is_printed_for_people_and_for_programs(capsys: pytest.CaptureFixture[str]) -> None:
    pose = ["--pose", "3mm", "-2mm", "5deg"]
    assert stage_table.main([str(SIM.with_name("uvw.toml")), *pose, "--velocity", "1mm/s", "0", "-2arcsec/s"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("3-PRP, platform at 1 mm/s, 0 mm/s, -0.0005556 °/s")
    assert "3, -2, 5    8.075261   -1.985935   -7.073423" in said
    assert stage_table.main(["--json", *pose]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["kind"], len(told["rows"])) == ("3-PPR", 1)
    assert told["rows"][0]["pose"] == pytest.approx([0.003, -0.002, math.radians(5.0)])
    assert told["rows"][0]["sliders"] == pytest.approx([7.792650e-3, -2.230260e-3, -7.230260e-3], abs=5.1e-10)


@pytest.mark.parametrize(
    ("words", "said"),
    [(["nowhere.toml"], "nowhere.toml"), (["--pose", "1apple", "0", "0"], "'1apple' is not a length")],
)
def test_what_cannot_be_meant_is_an_error(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert stage_table.main(words) == 1
    assert said in capsys.readouterr().err
