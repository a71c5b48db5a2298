"""A map from measured poses: what it finds again, what it foretells, and which data it refuses in one line."""

from __future__ import annotations

import re
from pathlib import Path

import calibrate
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from trirail.kinematics.calibration import CalibrationError
from trirail.kinematics.correction import Correction
from trirail.kinematics.correction_fit import MIN_POSES, fit
from trirail.kinematics.geometry import Geometry, Room
from trirail.kinematics.robot import inverse

Array = NDArray[np.float64]

PLAIN = Geometry.symmetric(0.3)
LOW, HIGH = (-0.15, -0.15, -1.2), (0.15, 0.15, 0.85)
ROOM = Room(LOW, HIGH, (-0.17, 0.34), (-0.17, 0.34))


def reached(number: int, seed: int) -> Array:
    """Poses all over what the sliders' travel allows, the outermost first: a fit wants some near the ends."""
    poses = np.random.default_rng(seed).uniform(ROOM.low, ROOM.high, (20 * number, 3))
    joints = inverse(PLAIN, poses)
    places = np.hstack([joints.position, joints.passive_position])
    within: Array = poses[((places >= -0.17) & (places <= 0.34)).all(axis=1)]
    outermost = np.unique([within.argmin(axis=0), within.argmax(axis=0)])
    found: Array = np.vstack([within[outermost], np.delete(within, outermost, axis=0)])[:number]
    assert len(found) == number
    return found


def robot(seed: int, size: float = 5e-5) -> Geometry:
    """A robot that differs from the plain one by a map of a single cell."""
    nodes = np.random.default_rng(seed).uniform(-size, size, (4, 4, 4, 3))
    return Geometry(PLAIN.legs, Correction(LOW, HIGH, nodes))


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 2))
def test_a_smooth_error_is_found_again_and_foretold(seed: int) -> None:
    built, poses, others = robot(seed), reached(250, seed), reached(50, seed + 1)
    found = fit(PLAIN, poses, inverse(built, poses).position, ROOM, (3, 3, 3))
    assert np.abs(found.residuals).max() < 0.05 * np.abs(found.before).max()
    told = inverse(Geometry(PLAIN.legs, found.correction), others).position
    assert np.abs(told - inverse(built, others).position).max() < 3e-6


@given(seed=st.integers(0, 2**32 - 2))
@settings(max_examples=10)
def test_what_it_foretells_is_no_less_than_what_it_leaves(seed: int) -> None:
    """With noise that no map can know, it says so."""
    poses, random = reached(150, seed), np.random.default_rng(seed)
    sliders = inverse(robot(seed), poses).position
    found = fit(PLAIN, poses + random.normal(0.0, 1e-5, poses.shape), sliders, ROOM, (4, 4, 4))
    assert (found.predicted.std(axis=0) >= 0.8e-5).all()  # of 150 poses, the noise of 1e-5 itself spreads by 6 %
    assert (found.predicted.std(axis=0) >= found.residuals.std(axis=0)).all()


def wave(poses: Array) -> Array:
    """Pose errors that a map of few cells cannot follow everywhere."""
    u = (poses - LOW) / np.subtract(HIGH, LOW)
    return np.stack(
        [
            5e-5 * np.sin(7.0 * u[:, 0] + 5.0 * u[:, 1]),
            5e-5 * np.cos(6.0 * u[:, 1] + 4.0 * u[:, 2]),
            2e-4 * np.sin(6.0 * u[:, 2] + 5.0 * u[:, 0]),
        ],
        axis=1,
    )


@pytest.mark.long
def test_what_is_left_at_other_poses_is_foretold_also_if_each_pose_is_measured_repeatedly() -> None:
    said, true = [], []
    for seed in range(3):
        random, poses, others = np.random.default_rng(seed), reached(60, seed), reached(500, seed + 100)
        sliders = inverse(PLAIN, poses + wave(poses)).position
        once, repeated = (
            fit(
                PLAIN,
                np.tile(poses, (rounds, 1)) + random.normal(0.0, 1e-6, (60 * rounds, 3)),
                np.tile(sliders, (rounds, 1)),
                ROOM,
                (4, 4, 8),
            )
            for rounds in (1, 5)
        )
        assert once.distinct == repeated.distinct == 60
        said.append([(found.predicted**2).mean(axis=0) for found in (once, repeated)])
        true.append(((wave(others) - repeated.correction.at(others)) ** 2).mean(axis=0))
    once_said, repeated_said = np.sqrt(np.mean(said, axis=0))
    assert repeated_said == pytest.approx(once_said, rel=0.1)
    assert (repeated_said > 0.75 * np.sqrt(np.mean(true, axis=0))).all()


def test_repeats_of_a_pose_are_no_more_poses() -> None:
    poses = np.repeat(reached(MIN_POSES - 1, 1), 10, axis=0)
    with pytest.raises(CalibrationError, match=f"^{MIN_POSES - 1} poses are too few"):
        fit(PLAIN, poses, inverse(PLAIN, poses).position, ROOM, (2, 2, 2))


def table(path: Path, poses: Array, sliders: Array) -> Path:
    rows = [",".join(map(repr, row)) for row in np.hstack([poses, sliders]).tolist()]
    path.write_text("\n".join(["x,y,phi,A,B,C", *rows]) + "\n", encoding="utf-8")
    return path


def complaint(path: Path, poses: Array, sliders: Array, capsys: pytest.CaptureFixture[str]) -> str:
    assert calibrate.main([str(table(path, poses, sliders)), "--map"]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert line.startswith(f"calibrate: {path}: ")
    return line


def test_what_makes_no_map_is_said_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, poses = tmp_path / "poses.csv", reached(120, 1)
    sliders = inverse(robot(1), poses).position

    def said(poses: Array, sliders: Array) -> str:
        return complaint(path, poses, sliders, capsys)

    assert f"{MIN_POSES - 1} poses are too few for a map" in said(poses[: MIN_POSES - 1], sliders[: MIN_POSES - 1])
    inside = np.abs(poses[:, 0]) < 0.08
    assert re.search(
        r"x was measured from -0\.0\d+ to 0\.0\d+, but the robot moves from", said(poses[inside], sliders[inside])
    )
    assert "cannot be reached with the configured geometry" in said(poses, sliders * 10.0)
    wild = np.random.default_rng(2).normal(0.0, 3e-3, poses.shape)
    assert re.search("too steep near x|calibrate .geometry. first", said(poses + wild * [1.0, 1.0, 5.0], sliders))
    far = robot(1, 4e-2)
    assert re.search(
        r"of up to 0\.0\d+ (m in x|m in y|rad in phi), more than 0\.02: calibrate \[geometry\] first",
        said(poses, inverse(far, poses).position),
    )


def test_a_measured_angle_may_be_whole_turns_off_but_covers_nothing_there() -> None:
    poses = reached(120, 1)
    sliders = inverse(robot(1), poses).position
    turned = poses + np.outer(np.random.default_rng(1).integers(-2, 3, len(poses)), [0.0, 0.0, 2.0 * np.pi])
    found, same = (fit(PLAIN, each, sliders, ROOM, (2, 2, 2)) for each in (turned, poses))
    np.testing.assert_allclose(found.correction.nodes, same.correction.nodes, atol=1e-12)
    below = poses[:, 2] < 0.0
    turned = poses[below] + np.outer(np.arange(below.sum()) < 3, [0.0, 0.0, 2.0 * np.pi])
    with pytest.raises(CalibrationError, match=r"^phi was measured from"):
        fit(PLAIN, turned, sliders[below], ROOM, (2, 2, 2))


def test_the_report_says_what_to_expect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = reached(120, 1)
    path = table(tmp_path / "poses.csv", poses, inverse(robot(1), poses).position)
    assert calibrate.main([str(path), "--map", "--cells", "2", "2", "2", "--output", str(tmp_path / "map.toml")]) == 0
    said = capsys.readouterr()
    assert said.out == ""
    assert "120 poses; " in said.err
    assert "left if not measured" in said.err
    assert "calibrate.py --map" in (tmp_path / "map.toml").read_text(encoding="utf-8")
