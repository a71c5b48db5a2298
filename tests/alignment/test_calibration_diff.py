"""Whether a camera stands as it was: a shift, a turn and another scale are told beyond their doubt, and no more."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from alignment.cameras import Stage, camera, part_at
from hypothesis import given
from hypothesis import strategies as st
from trirail.alignment.calibration_diff import ViewChange, compare_views, find_missing_views
from trirail.alignment.camera_calibration import CameraCalibration
from trirail.alignment.images import LENSES, CameraView, Lens, Pair
from trirail.alignment.procedure import StageMotion, calibrate_by_moves, calibration_moves, repeat_calibration
from trirail.alignment.rigid_motion import rotation_matrix
from trirail.client import calibration_file
from trirail_drivers.errors import FileError
from trirail_drivers.interface import Triple

PART: dict[str, Pair] = {"left": (-0.06, 0.01), "right": (0.06, 0.01)}
seeds = st.integers(0, 2**32 - 1)


def compared(
    seed: int,
    shift: Pair = (0.0, 0.0),
    turn: float = 0.0,
    scale: float = 0.0,
    noise: float | dict[str, float] = 0.1,
) -> list[ViewChange]:
    """Return the changes of two cameras, of which the left is shifted [m], turned and brought nearer; another part."""
    rng = np.random.default_rng(seed)
    views = {name: camera(rng, place) for name, place in PART.items()}
    stage = Stage(views, PART, rng, noise=noise)
    kept: CameraCalibration = stage.drive(calibrate_by_moves(looks=4))
    left = views["left"]
    (a, b), (c, d) = ((1.0 + scale) * rotation_matrix(turn) @ np.array(left.matrix)).tolist()
    x, y = np.subtract(left.origin, shift).tolist()
    stage.views["left"] = msgspec.structs.replace(left, origin=(x, y), matrix=((a, b), (c, d)))
    error = rng.uniform(-1.0, 1.0, 3) * (3e-4, 3e-4, 3e-3)
    stage.part = part_at(PART, (float(error[0]), float(error[1]), float(error[2])))
    return compare_views(kept, stage.drive(repeat_calibration(kept, 4)))


def stands(view: ViewChange) -> bool:
    """Whether chance explains the differences: it exceeds 8 deviations in one of 250,000 cases."""
    shifts = zip(view.shift, view.shift_deviation, strict=True)
    differences = (*shifts, (view.turn, view.deviation), (view.scale, view.scale_deviation))
    return all(abs(found) < 8.0 * deviation for found, deviation in differences)


@given(seeds, st.floats(2e-4, 5e-4), st.floats(-math.pi, math.pi))
def test_a_shift_is_told_though_the_part_is_another(seed: int, way: float, direction: float) -> None:
    shift = way * math.cos(direction), way * math.sin(direction)
    left, right = compared(seed, shift)
    assert (left.view, left.is_shifted) == ("left", True)
    for found, deviation, real in zip(left.shift, left.shift_deviation, shift, strict=True):
        assert abs(found - real) < 8.0 * deviation
        assert deviation < 3e-5
    assert stands(right)


@given(seeds, st.floats(2e-4, 5e-4))
def test_a_noisy_camera_hides_no_shift_of_another_and_gives_no_alarm(seed: int, way: float) -> None:
    left, right = compared(seed, (way, 0.0), noise={"left": 0.1, "right": 2.0})
    assert left.is_shifted
    assert abs(left.shift[0] - way) < 8.0 * left.shift_deviation[0]
    assert stands(right)


@given(seeds, st.sampled_from(((3e-3, 0.0), (-3e-3, 0.0), (0.0, 3e-3), (0.0, -3e-3))))
def test_a_turn_and_another_scale_are_told(seed: int, change: Pair) -> None:
    left, right = compared(seed, turn=change[0], scale=change[1])
    assert left.is_changed
    assert abs(left.turn - change[0]) < 8.0 * left.deviation
    assert abs(left.scale - change[1]) < 8.0 * left.scale_deviation
    assert stands(right)


@pytest.mark.generated(0, 1)
def test_cameras_that_stand_as_they_did_are_hardly_ever_told_of(seed: int) -> None:
    """Chance makes one of 2,000 pairs of cameras look changed."""
    changed = [any(view.is_changed for view in compared(100 * seed + number)) for number in range(100)]
    assert sum(changed) <= 1


@given(seeds, st.floats(-0.01, 0.01), st.floats(-0.01, 0.01))
def test_another_part_in_perspective_is_no_other_camera(seed: int, x: float, y: float) -> None:
    """The scale in the picture depends on the place of the part, and so does its doubt."""
    rng = np.random.default_rng(seed)
    views = {
        name: msgspec.structs.replace(camera(rng, place), lens="perspective", bend=(2.0, -1.0))
        for name, place in PART.items()
    }
    stage = Stage(views, PART, rng, noise=0.1)
    kept = stage.drive(calibrate_by_moves(calibration_moves("perspective", 1e-3, 0.02), lens="perspective"))
    stage.part = part_at(PART, (x, y, 0.0))
    assert all(map(stands, compare_views(kept, stage.drive(repeat_calibration(kept)))))


@given(seeds, st.floats(-100.0, 100.0), st.floats(-100.0, 100.0))
def test_each_radial_camera_keeps_its_own_centre(seed: int, u: float, v: float) -> None:
    """As the calibration of a stage's geometry finds them."""
    rng = np.random.default_rng(seed)
    views = {
        name: msgspec.structs.replace(
            view, lens="radial", bend=(1e-7, 0.0), centre=(view.pixel[0] + u, view.pixel[1] + v)
        )
        for name, view, (u, v) in zip(PART, (camera(rng, p) for p in PART.values()), ((u, v), (-u, -v)), strict=True)
    }
    stage = Stage(views, PART, rng, noise=0.1)
    centres = {name: view.centre for name, view in views.items()}
    kept = stage.drive(calibrate_by_moves(calibration_moves("radial", 1e-3, 0.02), lens="radial", centre=centres))
    again = stage.drive(repeat_calibration(kept))
    assert {name: view.centre for name, view in again.views.items()} == centres
    assert all(map(stands, compare_views(kept, again)))


@pytest.mark.parametrize(
    "other",
    [
        pytest.param((0.0, 0.0, 0.0), id="same part"),
        pytest.param((0.003, 0.002, 0.0), id="other part", marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize("lens", LENSES)
def test_deviations_are_those_of_many_trials(lens: Lens, other: Triple) -> None:
    """Shift, turn and scale scatter by their deviations, also if the lens gives turn and scale different ones."""
    rng = np.random.default_rng(1)
    view = camera(rng, PART["left"])
    bend = {"affine": (0.0, 0.0), "perspective": (0.5, 0.2), "radial": (2e-8, 0.0)}[lens]
    view = msgspec.structs.replace(view, lens=lens, bend=bend, centre=view.pixel)
    part = {"left": PART["left"]}
    stage = Stage({"left": view}, part, rng, noise=0.1)
    moves = calibration_moves(lens, 2e-3, 0.02)
    found = []
    for _ in range(150):
        stage.part = part
        kept = stage.drive(calibrate_by_moves(moves, lens=lens, centre=view.centre))
        stage.part = part_at(part, other)
        found += compare_views(kept, stage.drive(calibrate_by_moves(moves, lens=lens, centre=view.centre)))
    pairs = {
        "x": [(each.shift[0], each.shift_deviation[0]) for each in found],
        "y": [(each.shift[1], each.shift_deviation[1]) for each in found],
        "turn": [(each.turn, each.deviation) for each in found],
        "scale": [(each.scale, each.scale_deviation) for each in found],
    }
    for name, values in pairs.items():
        scatter, said = np.std([value for value, _ in values]), np.sqrt(np.mean([each**2 for _, each in values]))
        assert scatter == pytest.approx(said, rel=0.2), name


def test_views_that_are_in_one_alone_are_not_compared_and_lost_ones_are_named() -> None:
    rng = np.random.default_rng(1)
    views: dict[str, CameraView] = {name: camera(rng, place) for name, place in PART.items()}
    both = Stage(views, PART, rng).drive(calibrate_by_moves())
    one = Stage(views, {"left": PART["left"]}, rng).drive(calibrate_by_moves())
    assert [each.view for each in compare_views(both, one)] == ["left"]
    assert find_missing_views(both, one) == ["right"]
    assert find_missing_views(one, both) == []


class LooseStage(Stage):
    """A stage with backlash: the table follows its commanded pose only after a reversal has crossed the play."""

    def __init__(self, rng: np.random.Generator, play: Triple, views: dict[str, CameraView]) -> None:
        super().__init__(views, PART, rng, noise=0.1)
        self.table, self._half = np.zeros(3), np.abs(play) / 2.0
        self.visited: list[Triple] = []

    @property
    def true_pose(self) -> Triple:
        x, y, phi = self.table.tolist()
        return x, y, phi

    def go(self, motion: StageMotion) -> None:
        if motion.approach is not None:
            x, y, phi = np.add(motion.by, motion.approach).tolist()
            self._go_to(motion._replace(by=(x, y, phi)))
        by = motion.by if motion.tool is None or motion.approach is None else np.negative(motion.approach).tolist()
        self._go_to(motion._replace(by=(by[0], by[1], by[2])))

    def _go_to(self, motion: StageMotion) -> None:
        super().go(motion)
        self.visited.append(self.pose)
        self.table = np.clip(self.table, self.pose - self._half, self.pose + self._half)


def loose_stage(seed: int, play: float) -> LooseStage:
    rng = np.random.default_rng(seed)
    return LooseStage(rng, (play, play, 10.0 * play), {name: camera(rng, place) for name, place in PART.items()})


@given(seeds, st.floats(5e-5, 1e-4), st.sampled_from(((1, 1, 1), (-1, 1, 1), (1, -1, -1), (-1, -1, -1))))
def test_a_check_of_a_stage_with_backlash_arrives_from_the_side_of_the_calibration(
    seed: int, play: float, side: tuple[int, int, int]
) -> None:
    stage = loose_stage(seed, play)
    approach = side[0] * 3e-4, side[1] * 3e-4, side[2] * 3e-3
    kept: CameraCalibration = stage.drive(calibrate_by_moves(looks=4, approach=approach))
    assert kept.approach == approach
    again: CameraCalibration = stage.drive(repeat_calibration(kept, 4))
    assert again.approach == approach
    assert again.noise < 0.25, "the play is not in the pictures"
    assert all(map(stands, compare_views(kept, again)))
    left = stage.views["left"]
    stage.views["left"] = msgspec.structs.replace(left, origin=(left.origin[0] + 2e-4, left.origin[1]))
    changes = compare_views(kept, stage.drive(repeat_calibration(kept, 4)))
    assert [each.is_shifted for each in changes] == [True, False]


POSES = st.tuples(st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3), st.floats(-0.02, 0.02))


@given(seeds, POSES, POSES, st.one_of(st.none(), st.just((2e-4, -2e-4, 2e-3))))
def test_a_check_visits_the_poses_of_the_calibration_wherever_it_begins(
    seed: int, made: Triple, begun: Triple, approach: Triple | None
) -> None:
    """Moves over nearly the whole travel leave the limits if they are made around another pose."""
    stage = loose_stage(seed, 0.0)
    stage.pose, stage.table = made, np.array(made)
    kept = stage.drive(calibrate_by_moves(approach=approach))
    low, high = np.min(stage.visited, axis=0), np.max(stage.visited, axis=0)
    stage.pose, stage.table, stage.visited = begun, np.array(begun), []
    again = stage.drive(repeat_calibration(kept))
    assert np.array(again.poses) == pytest.approx(np.array(kept.poses), abs=1e-12)
    assert stage.pose == pytest.approx(begun, abs=1e-12), "the stage is where it was"
    visited = np.array(stage.visited[1:-1])  # without the begin and the end, where the stage stood
    assert (visited >= low - 1e-12).all()
    assert (visited <= high + 1e-12).all()


def test_a_calibration_of_an_earlier_version_has_no_approach() -> None:
    kept = loose_stage(1, 0.0).drive(calibrate_by_moves(approach=(1e-4, 1e-4, 1e-3)))
    fields = msgspec.to_builtins(kept)
    assert msgspec.convert(fields, CameraCalibration).approach == kept.approach
    del fields["approach"]
    assert msgspec.convert(fields, CameraCalibration) == msgspec.structs.replace(kept, approach=None)


def test_a_calibration_of_an_earlier_version_gets_the_noise_of_each_view(tmp_path: Path) -> None:
    """Its covariances follow from one noise of all views. The residuals in the file give those of each view."""
    rng = np.random.default_rng(3)
    stage = Stage({name: camera(rng, place) for name, place in PART.items()}, PART, rng, {"left": 0.1, "right": 2.0})
    found: CameraCalibration = stage.drive(calibrate_by_moves(looks=4))
    file = tmp_path / "camera.json"
    calibration_file.write(file, "robot", found, {})
    assert calibration_file.read(file).calibration == found
    content = json.loads(file.read_bytes())
    old = content["calibration"]
    del old["noises"]
    for view, covariance in old["covariances"].items():
        share = found.noise / found.noise_of(view)
        old["covariances"][view] = (share**2 * np.array(covariance)).tolist()
        old["marks"][view]["deviation"] = (share * np.array(old["marks"][view]["deviation"])).tolist()
    file.write_text(json.dumps(content))
    again = calibration_file.read(file).calibration
    assert again.noises == pytest.approx(found.noises)
    for name, mark in found.marks.items():
        assert again.marks[name].deviation == pytest.approx(mark.deviation)
        assert np.array(again.covariances[name]) == pytest.approx(np.array(found.covariances[name]))


DAMAGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "matrix of view left": lambda file: file["views"]["left"].update(matrix=[[2.0, 1.0], [4.0, 2.0]]),
    "unknown view left": lambda file: file["views"].pop("left"),
    "one picture a look": lambda file: file.update(looks=0),
    "one pose": lambda file: file.update(poses=[]),
    "one mark": lambda file: file.update(marks={}),
    "covariances: that of view left": lambda file: file["covariances"].update(left=[[1.0, 2.0]]),
    "covariances: that of view right": lambda file: file["covariances"].pop("right"),
    "noise is negative": lambda file: file["noises"].update(left=-1.0),
}


@pytest.mark.parametrize("problem", DAMAGES)
@pytest.mark.parametrize("lens", LENSES)
def test_a_damaged_file_is_refused_with_the_problem(problem: str, lens: Lens, tmp_path: Path) -> None:
    rng, file = np.random.default_rng(1), tmp_path / "camera.json"
    stage = Stage({name: camera(rng, place, lens) for name, place in PART.items()}, PART, rng, 0.1)
    moves = calibration_moves(lens, 1e-3, 0.02)
    found: CameraCalibration = stage.drive(calibrate_by_moves(moves, lens=lens, centre=(1000.0, 800.0)))
    calibration_file.write(file, "robot", found, {})
    assert calibration_file.read(file).calibration == found
    content = json.loads(file.read_bytes())
    DAMAGES[problem](content["calibration"])
    file.write_text(json.dumps(content))
    with pytest.raises(FileError, match=rf"camera\.json: calibration.*{problem}.*create it again"):
        calibration_file.read(file)


def test_an_approach_of_other_numbers_can_be_written() -> None:
    approach = np.array((1e-4, 1e-4, 1e-3), dtype=np.float64)
    kept = loose_stage(1, 0.0).drive(calibrate_by_moves(approach=approach))  # type: ignore[arg-type]
    assert msgspec.json.decode(msgspec.json.encode(kept), type=CameraCalibration).approach == (1e-4, 1e-4, 1e-3)
