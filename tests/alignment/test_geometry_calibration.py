"""The stage's own geometry by its cameras: exact looks give exact corrections, and what looks cannot tell is named."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import msgspec
import numpy as np
import pytest
from alignment.cameras import FIELD, BuiltStage, wide_camera
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.alignment import stage_fit
from trirail.alignment.calibration_diff import compare_views
from trirail.alignment.camera_calibration import to_base_frame
from trirail.alignment.geometry_calibration import (
    GeometryCalibration,
    GeometryTask,
    _Scatter,
    calibrate_geometry,
    plan,
    start_model,
)
from trirail.alignment.images import Lens, Pair, project_points
from trirail.alignment.pose_plan import choose_poses, find_candidates
from trirail.alignment.procedure import AlignmentTask, Observation, StageMotion, align, poses_within, repeat_calibration
from trirail.alignment.rigid_motion import Floats
from trirail.alignment.stage_model import StageLook, StageModel
from trirail.client.stage_as_built import built_otherwise
from trirail.config import SIM, geometry, load, room
from trirail.errors import AlignmentError, AlignmentFault, RefusedError
from trirail.kinematics.calibration import corrected
from trirail.kinematics.correction import Correction
from trirail.kinematics.geometry import Geometry, travels
from trirail.kinematics.robot import forward, inverse
from trirail_drivers.interface import Triple

SEEDS = st.integers(0, 2**32 - 1)
STAGES = {name: load(SIM.with_name(f"{name}.toml")) for name in ("uvw", "uvw-ppr", "xxy")}
PART: dict[str, Pair] = {"left": (-0.06, 0.0), "right": (0.06, 0.0)}
LENSES: tuple[Lens, ...] = ("affine", "perspective", "radial")
names = st.sampled_from(sorted(STAGES))


def stage(
    name: str, seed: int, noise: float = 0.0, part: Mapping[str, Pair] = PART, lens: Lens = "radial"
) -> tuple[BuiltStage, GeometryTask]:
    """Return a stage that is built otherwise, and the task to calibrate it."""
    rng = np.random.default_rng(seed)
    robot, limits = geometry(STAGES[name].geometry), room(STAGES[name].limits)
    built = built_otherwise(robot, rng, 50e-6, 1e-4)
    views = {mark: wide_camera(rng, at, lens) for mark, at in part.items()}
    made = BuiltStage(robot, built, rng.uniform(-2e-4, 2e-4, 3).tolist(), views, part, rng, noise)
    return made, GeometryTask(robot, limits, FIELD, lens=lens, looks=1)


def unseen(task: GeometryTask, count: int, seed: int = 1) -> Floats:
    """Return poses anywhere in the travel, (count, 3)."""
    rng = np.random.default_rng(seed)
    poses = 0.95 * rng.uniform(task.room.low, task.room.high, (40 * count, 3))
    reached: Floats = poses[task.room.holds(travels(task.start, poses))][:count]
    return reached


def misses(made: BuiltStage, found: GeometryCalibration, poses: Floats) -> Floats:
    """Return how far marks are from where the calibration computes them, for poses by the configuration [pixel]."""
    distances = []
    for pose in poses:
        x, y, phi = pose.tolist()
        made.pose = (x, y, phi)
        sliders = inverse(made.configured, pose).position * (1.0 + np.array(found.scales))
        computed = forward(found.geometry, sliders)
        for name, seen in made.look().items():
            fit = found.cameras.marks[name]
            at = project_points(found.cameras.views[fit.view], to_base_frame(fit.place, computed.tolist())[None])[0]
            distances.append(float(np.linalg.norm(at - seen)))
    return np.array(distances)


@pytest.mark.parametrize("lens", LENSES)
@given(name=names, seed=SEEDS)
def test_derivatives_are_those_of_the_pixels(name: str, seed: int, lens: Lens) -> None:
    made, task = stage(name, seed, lens=lens)
    rng = np.random.default_rng(seed)
    poses = unseen(task, 4, seed)
    looks = []
    for pose in poses:
        a, b, c = inverse(task.start, pose).position.tolist()
        x, y, phi = pose.tolist()
        looks.append(StageLook((a, b, c), (x, y, phi), dict.fromkeys(PART, (0.0, 0.0))))
    model = StageModel(task.start, poses, made.views, PART, {mark: mark for mark in PART})
    unknowns = model.initial()
    unknowns[: model.legs] += 0.1 * rng.standard_normal(model.legs)
    jacobian = model.jacobian(unknowns, looks)
    for number in range(model.size):
        step = np.zeros(model.size)
        step[number] = 1e-4 / max(float(np.abs(jacobian[..., number]).max()), 1e-9)
        change = model.residuals(unknowns - step, looks) - model.residuals(unknowns + step, looks)
        assert change / 2e-4 == pytest.approx(jacobian[..., number] * step[number] / 1e-4, abs=2e-4)


@pytest.mark.parametrize("name", sorted(STAGES))
def test_exact_looks_tell_every_mark_in_the_whole_travel(name: str) -> None:
    made, task = stage(name, 7)
    found = made.drive(calibrate_geometry(task))
    assert len(found.looks) == 30
    assert found.outliers == ()
    assert misses(made, found, unseen(task, 20)).max() < 0.05


@pytest.mark.parametrize("name", ["uvw", "uvw-ppr"])
def test_one_correction_anywhere_in_the_travel(name: str) -> None:
    made, task = stage(name, 3, noise=0.02)
    found = made.drive(calibrate_geometry(task))
    begin, end = unseen(task, 2, 5).tolist()
    made.configured, made.scales = found.geometry, (1.0 + made.scales) / (1.0 + np.array(found.scales)) - 1.0
    made.pose = (end[0], end[1], end[2])
    targets, aim = made.look(), made.true_pose
    made.pose = (begin[0], begin[1], begin[2])
    result = made.drive(align(AlignmentTask(found.cameras, targets, tolerance=2e-6)))
    assert (result.reached, len(result.corrections)) == (True, 1)
    assert made.true_pose == pytest.approx(aim, abs=2e-6)


@settings(max_examples=30)  # each is a whole calibration of the stage
@given(seed=SEEDS, name=names)
@example(seed=0, name="uvw")
@example(seed=678, name="uvw")
@pytest.mark.long
def test_lost_swapped_and_wrong_marks_are_named_and_change_nothing(seed: int, name: str) -> None:
    made, task = stage(name, seed, noise=0.05)
    look, count = made.look, 0

    def damaged() -> dict[str, Pair]:
        nonlocal count
        count += 1
        seen = look()
        if count in (3, 14) and len(seen) == 2:
            return {"left": seen["right"], "right": seen["left"]}
        if count in (9, 20):
            return {name: pixel for name, pixel in seen.items() if name != "left"}
        if count == 17 and "right" in seen:
            return seen | {"right": (seen["right"][0] + 3.0, seen["right"][1])}
        return seen

    made.look = damaged  # type: ignore[method-assign]
    found = made.drive(calibrate_geometry(task))
    made.look = look  # type: ignore[method-assign]
    swapped = {(each.look, each.mark, each.swapped_with) for each in found.outliers if each.swapped_with}
    assert swapped >= {(3, "left", "right"), (3, "right", "left")}
    assert {each.look for each in found.outliers} >= {3, 14}
    others = [each for each in found.outliers if each.look not in (3, 14, 17)]
    assert len(others) <= 1
    assert all(each.distance < 0.3 for each in others), (
        "noise is rarely five times its standard deviation, and never six times"
    )
    assert found.noise < 0.1
    assert misses(made, found, unseen(task, 10)).max() < 1.5


SMALL_FIELD = (2448.0, 2048.0)


@pytest.mark.parametrize("how", ["late", "late from look 8", "names exchanged from look 8", "one camera late"])
@pytest.mark.parametrize("field", [FIELD, SMALL_FIELD])
@pytest.mark.generated(*range(12))
def test_wrong_pictures_are_refused_with_the_residual_and_what_to_check(seed: int, field: Pair, how: str) -> None:
    name = sorted(STAGES)[seed % 3]
    made, task = stage(name, seed, noise=0.05)
    made.field, rng = field, np.random.default_rng(seed)
    made.views = {mark: wide_camera(rng, at, field=field) for mark, at in PART.items()}
    taken, take = list[dict[str, Pair]](), made.look

    def wrong() -> dict[str, Pair]:
        taken.append(now := take())
        before = taken[max(0, len(taken) - 2)]
        if how == "one camera late":
            return {mark: seen[mark] for mark, seen in (("left", before), ("right", now)) if mark in seen}
        if how == "late" or (how == "late from look 8" and len(taken) > 7):
            return before
        if len(taken) > 7:
            return {mark: now[other] for mark, other in (("left", "right"), ("right", "left")) if other in now}
        return now

    made.look = wrong  # type: ignore[method-assign]
    with pytest.raises(AlignmentError, match=r"check that|check the names|take a new picture") as refused:
        made.drive(calibrate_geometry(task._replace(field=field)))
    assert refused.value.fault is AlignmentFault.STILL


@pytest.mark.generated(*range(6))
def test_names_that_are_exchanged_in_one_camera_from_some_look_on_are_refused(seed: int) -> None:
    """The fit explains either names, since the camera is the same."""
    part: dict[str, Pair] = {"left": (-0.06, 0.0), "right": (-0.058, 0.001)}
    made, task = stage(sorted(STAGES)[seed % 3], seed, noise=0.05, part=part)
    made.views = dict.fromkeys(part, made.views["left"])
    take, looks = made.look, 0

    def exchanged() -> dict[str, Pair]:
        nonlocal looks
        looks += 1
        now = take()
        return now if looks <= 7 else {mark: now[o] for mark, o in (("left", "right"), ("right", "left")) if o in now}

    made.look = exchanged  # type: ignore[method-assign]
    with pytest.raises(AlignmentError, match="exchanged in looks 1, 2, 3, 4, 5, 6, 7, compared") as refused:
        made.drive(calibrate_geometry(task._replace(views=dict.fromkeys(part, "camera"))))
    assert refused.value.fault is AlignmentFault.SWAPPED


@settings(max_examples=6)  # each is a whole calibration of the stage
@given(
    name=names,
    seed=SEEDS,
    off=st.sampled_from(((5e-4, 2e-3, 0.0), (1e-3, 5e-3, 0.0), (50e-6, 1e-4, 1e-3))),
)
@example(name="uvw-ppr", seed=10, off=(1e-3, 5e-3, 0.0))
@example(name="uvw", seed=107, off=(50e-6, 1e-4, 2e-3))
@example(name="xxy", seed=11, off=(50e-6, 1e-4, 2e-3))
@pytest.mark.long
def test_legs_far_from_their_configuration_leave_no_more_than_the_noise_of_the_pictures(
    name: str, seed: int, off: tuple[float, float, float]
) -> None:
    """Legs or home positions that are several standard deviations off their drawings."""
    place, angle, home = off
    made, task = stage(name, seed, noise=0.05)
    rng = np.random.default_rng(seed)
    built = built_otherwise(task.start, rng, place, angle)
    made.built = dataclasses.replace(
        built,
        legs=tuple(dataclasses.replace(leg, home=leg.home + rng.choice((-1.0, 1.0)) * home) for leg in built.legs),
    )
    found = made.drive(calibrate_geometry(task._replace(looks=4)))
    assert not found.is_systematic
    made.end_noise()
    assert misses(made, found, unseen(task, 40)).max() < 0.2


@pytest.mark.parametrize("part", [PART, {"left": (-0.06, 0.0), "right": (-0.054, 0.0)}])
@pytest.mark.generated(0, 1, 2, 3, 4, 5, 6, 7)
def test_few_looks_at_a_stage_far_from_its_drawings_leave_no_more_than_the_noise(
    seed: int, part: Mapping[str, Pair]
) -> None:
    """A noise that is too high would keep configured values that the looks contradict."""
    made, task = stage(sorted(STAGES)[seed % 3], seed, noise=0.05, part=part)
    made.built = built_otherwise(task.start, np.random.default_rng(seed), 1e-3, 2e-3)
    found = made.drive(calibrate_geometry(task._replace(poses=14, looks=2)))
    assert found.noise < 1.7 * 0.05 / math.sqrt(2.0)


def test_a_fit_that_does_not_converge_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_fit, "MAX_ROUNDS", 2)
    made, task = stage("uvw", 1, noise=0.05)
    made.built = built_otherwise(task.start, np.random.default_rng(1), 1e-3, 5e-3)
    with pytest.raises(AlignmentError, match="did not converge in 2 rounds"):
        made.drive(calibrate_geometry(task))


def test_what_no_look_tells_is_named_and_stays_as_configured() -> None:
    """The rail's angle of a leg whose cross slide is square to it, and its encoder's scale, have the same effect."""
    made, task = stage("uvw-ppr", 2, noise=0.05)
    found = made.drive(calibrate_geometry(task))
    assert {f"{leg} rail_angle" for leg in "ABC"} <= set(found.undetermined)
    assert all(math.isinf(found.deviations[name]) for name in found.undetermined)
    assert found.parameters["A rail_angle"] == pytest.approx(0.0, abs=1e-9)
    told = [name for name, value in found.deviations.items() if math.isfinite(value)]
    assert told


@pytest.mark.long
def test_one_camera_tells_less_than_two_and_says_so() -> None:
    made, task = stage("uvw", 4, noise=0.05)
    alone, _ = stage("uvw", 4, noise=0.05, part={"left": PART["left"]})
    two = made.drive(calibrate_geometry(task)).undetermined
    one = alone.drive(calibrate_geometry(task)).undetermined
    assert len(one) > len(two)


def test_the_fewest_looks_of_one_mark_still_end_with_what_they_determine() -> None:
    made, task = stage("uvw", 4, noise=0.05, part={"left": PART["left"]})
    found = made.drive(calibrate_geometry(task._replace(poses=12)))
    assert len(found.looks) == 12
    assert len(found.undetermined) > 6
    assert all(math.isfinite(found.deviations[name]) for name in found.deviations.keys() - set(found.undetermined))


@pytest.mark.parametrize("poses", [12, 14, 16])
@pytest.mark.generated(*range(16))
def test_few_correct_looks_of_one_mark_are_not_called_wrong(seed: int, poses: int) -> None:
    made, task = stage(sorted(STAGES)[seed % 3], seed, noise=0.1, part={"left": PART["left"]})
    found = made.drive(calibrate_geometry(task._replace(poses=poses)))
    assert len(found.outliers) <= 1, "with few degrees of freedom, chance makes one of 48 noises too low"
    assert found.noise > 0.03


@pytest.mark.parametrize("marks", [("left", "right"), ("left",)])
@pytest.mark.long
def test_19_of_20_corrections_are_within_two_standard_deviations(marks: tuple[str, ...]) -> None:
    """Legs as uncertain as drawings. The truth is compared in the same frame, that of the least corrections."""
    ratios: list[float] = []
    for seed in range(18):
        made, task = stage(sorted(STAGES)[seed % 3], seed, noise=0.05, part={mark: PART[mark] for mark in marks})
        model = StageModel(task.start, unseen(task, 60), made.views, made.part, {mark: mark for mark in marks})
        built = model.doubts * np.random.default_rng(seed).standard_normal(18)
        made.built, made.scales = corrected(task.start, built.reshape(3, 6)[:, :5]), built.reshape(3, 6)[:, 5]
        found = made.drive(calibrate_geometry(task))
        right = model.doubts * (model.basis @ (model.basis.T @ (built / model.doubts)))
        deviations = np.array([*found.deviations.values()])
        told = np.isfinite(deviations) & (deviations > 1e-12)
        ratios += (np.abs([*found.parameters.values()] - right)[told] / deviations[told]).tolist()
    assert 0.88 < np.mean(np.array(ratios) < 1.96) < 0.99
    assert max(ratios) < 5.0


def test_the_frame_and_the_length_are_those_of_the_configuration() -> None:
    """A stage that stands elsewhere, or all of whose encoders count too little, shows the same pictures."""
    made, task = stage("uvw", 5)
    made.built, made.scales = task.start, np.full(3, 3e-4)
    found = made.drive(calibrate_geometry(task))
    assert sum(found.scales) == pytest.approx(0.0, abs=1e-12)
    assert max(abs(value) for value in found.parameters.values()) > 1e-6  # 300 ppm of 60 mm, in the legs

    made, task = stage("uvw", 5)
    made.built, made.scales = _elsewhere(task.start), np.zeros(3)
    found = made.drive(calibrate_geometry(task))
    assert max(abs(value) for value in found.parameters.values()) < 1e-6


def _elsewhere(robot: Geometry) -> Geometry:
    legs = [dataclasses.replace(leg, anchor=(leg.anchor[0] + 2e-4, leg.anchor[1] - 1e-4)) for leg in robot.legs]
    return dataclasses.replace(robot, legs=tuple(legs))


@pytest.mark.parametrize("name", sorted(STAGES))
@pytest.mark.generated(*range(4))
def test_a_check_after_the_calibration_of_the_geometry_tells_small_shifts(seed: int, name: str) -> None:
    """The legs are unknown to some micrometres, and the same in both. Cameras are told much better than the legs."""
    made, task = stage(name, seed, noise=0.05)
    found = made.drive(calibrate_geometry(task._replace(looks=4)))
    made.configured, made.scales = found.geometry, (1.0 + made.scales) / (1.0 + np.array(found.scales)) - 1.0
    made.pose = (0.0, 0.0, 0.0)
    right, way = made.views["right"], 1e-5
    made.views["right"] = msgspec.structs.replace(right, origin=(right.origin[0] - way, right.origin[1]))
    left, right_change = compare_views(found.cameras, made.drive(repeat_calibration(found.cameras, 4)))
    assert not left.is_changed
    assert right_change.is_shifted
    assert right_change.shift_deviation[0] < 1.5e-6
    assert abs(right_change.shift[0] - way) < 6.0 * right_change.shift_deviation[0]


@pytest.mark.parametrize("lens", ["affine", "radial"])
@pytest.mark.generated(4, 0, 3, 7)
def test_cameras_with_little_or_no_distortion_are_checked_as_precisely_as_others(seed: int, lens: Lens) -> None:
    """The lens of seed 4 has little distortion. The centre of such a lens is not determined, and was 90,000 px away."""
    made, task = stage("uvw", seed, noise=0.1, lens=lens)
    found = made.drive(calibrate_geometry(task._replace(lens="radial")))
    made.configured, made.scales = found.geometry, (1.0 + made.scales) / (1.0 + np.array(found.scales)) - 1.0
    made.pose = (0.0, 0.0, 0.0)
    poses = poses_within(task.room, found.geometry, found.cameras)
    changes = compare_views(found.cameras, made.drive(repeat_calibration(found.cameras, 1, poses)))
    assert len(changes) == 2
    for change in changes:
        assert not change.is_changed
        assert change.scale_deviation < 1e-4
    for view in found.cameras.views.values():
        assert math.dist(view.centre, (FIELD[0] / 2.0, FIELD[1] / 2.0)) < math.hypot(*FIELD) / 4.0


def test_planned_poses_tell_more_than_random_ones_and_keep_marks_in_the_pictures() -> None:
    made, task = stage("uvw", 6, noise=0.05)
    found = made.drive(calibrate_geometry(task))
    first = found.looks[:7]
    model, unknowns, noise = start_model(task, first)
    planned = plan(task, model, unknowns, first, noise)
    assert len(planned) == 23
    assert len({look.pose for look in planned}) == 23
    assert len({look.pose for look in plan(task._replace(poses=60), model, unknowns, first, noise)}) == 53
    assert all(set(look.marks) == set(found.looks[7 + n].marks) == set(PART) for n, look in enumerate(planned))
    poses = unseen(task, 200)
    sliders = inverse(task.start, poses).position
    candidates = find_candidates(model, unknowns, poses, sliders, dict.fromkeys(PART, FIELD))
    random = [each.look for each in candidates[:23]]

    def variance(looks: list[StageLook]) -> float:
        rows = model.jacobian(unknowns, [*first, *looks]).reshape(-1, model.size) / noise
        scales = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)  # the lens is straight at first: no centre yet
        inverse_information = np.linalg.inv((rows / scales).T @ (rows / scales) + 1e-9 * np.eye(model.size))
        every = np.concatenate([each.jacobian for each in candidates]) / scales
        return float(np.einsum("ij,jk,ik->i", every, inverse_information, every).mean())

    assert variance(planned) < 0.8 * variance(random)
    assert choose_poses(model, unknowns, first, candidates, 0, noise) == []


@pytest.mark.parametrize("looks", [2, 3, 4, 8])
def test_the_noise_of_pictures_at_rest_is_that_which_there_is(looks: int) -> None:
    """In each camera its own; a mark that is missing in a picture, or mistaken for another, does not matter."""
    rng, scatter, noises = np.random.default_rng(looks), _Scatter(), {"left": 0.05, "right": 0.2}
    for number in range(3000):
        pictures = []
        for picture in range(looks):
            seen = {name: (float(u), float(v)) for name, (u, v) in zip(noises, rng.normal(size=(2, 2)), strict=True)}
            marks = {name: (noises[name] * u, noises[name] * v) for name, (u, v) in seen.items()}
            if number % 3 == 1 and picture == 0:
                del marks["left"]
            if number % 50 == 2 and picture == 0:
                marks["right"] = (300.0, 200.0)
            pictures.append(Observation(marks, (0.0, 0.0, 0.0), 0.0))
        scatter.add(pictures)
    assert scatter.noise == pytest.approx(math.sqrt((0.05**2 + 0.2**2) / 2.0 / looks), rel=0.05)


def test_a_map_is_offered_for_errors_that_no_geometry_explains_where_it_helps_at_looks_that_it_does_not_know() -> None:
    made, task = stage("uvw", 8, noise=0.05)
    assert made.drive(calibrate_geometry(task)).map is None
    nodes = np.random.default_rng(8).uniform(-1.0, 1.0, (5, 5, 5, 3)) * (3e-5, 3e-5, 0.0)
    low, high = (-0.012, -0.012, -0.1), (0.012, 0.012, 0.1)
    made.built = dataclasses.replace(made.built, correction=Correction(low, high, nodes))
    bent = made.drive(calibrate_geometry(task._replace(poses=60)))
    assert bent.is_systematic
    assert bent.map is not None
    assert bent.map.helps
    assert bent.map.after[0] < 0.6 * bent.map.before[0]
    few = made.drive(calibrate_geometry(task._replace(poses=20)))
    assert few.is_systematic
    assert few.map is None


class UnevenStage(BuiltStage):
    """A stage with errors of 8 µm and 0.1 mrad that no geometry explains."""

    @property
    def true_pose(self) -> Triple:
        x, y, phi = super().true_pose
        return x + 8e-6 * math.sin(x / 4e-3), y + 6e-6 * math.cos(y / 5e-3), phi + 1e-4 * math.sin((x + y) / 7e-3)


@pytest.mark.parametrize("name", sorted(STAGES))
@pytest.mark.generated(*range(4))
def test_only_corrections_beyond_their_uncertainty_are_significant(seed: int, name: str) -> None:
    """Those of a stage that is as configured are noise, and errors of 8 µm that no geometry explains are no legs."""
    made, task = stage(name, seed, noise=0.1)
    made.__class__ = UnevenStage
    assert not made.drive(calibrate_geometry(task._replace(looks=4))).is_significant
    made, task = stage(name, seed, noise=0.1)
    made.built, made.scales = task.start, np.zeros(3)
    assert not made.drive(calibrate_geometry(task)).is_significant
    made.built = built_otherwise(task.start, np.random.default_rng(seed), 1e-3, 3e-3)
    found = made.drive(calibrate_geometry(task._replace(looks=4)))
    assert found.is_significant
    assert found.change > 1e-6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"field": (0.0, 100.0)}, "size of the pictures"),
        ({"poses": 5}, "poses is 5"),
        ({"looks": 0}, "looks is 0"),
        ({"lens": "fish"}, "lens is 'fish'"),
        ({"approach": (1.0,)}, "approach"),
    ],
)
def test_impossible_arguments_are_refused_before_a_move(change: dict[str, object], words: str) -> None:
    made, task = stage("uvw", 1)
    with pytest.raises(RefusedError, match=words):
        made.drive(calibrate_geometry(task._replace(**change)))  # type: ignore[arg-type]
    assert made.motions == 0


@pytest.mark.parametrize("wrong", [1e20, -1e155, 1e300])
@pytest.mark.parametrize("number", [1, 4, 20])
def test_an_absurd_pixel_is_refused_at_its_look(number: int, wrong: float) -> None:
    made, task = stage("uvw", 1, noise=0.05)
    take, looks = made.look, 0

    def look() -> dict[str, Pair]:
        nonlocal looks
        looks += 1
        return take() if looks != number else {"left": (wrong, 0.0)}

    made.look = look  # type: ignore[method-assign]
    with pytest.raises(AlignmentError, match=r"look returned .* for mark 'left': expected two pixels within ±1e7"):
        made.drive(calibrate_geometry(task))
    assert looks == number


@pytest.mark.parametrize("name", sorted(STAGES))
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_cameras_are_checked_within_the_travel_from_wherever_the_stage_stands(name: str, side: float) -> None:
    made, task = stage(name, 5)
    task = task._replace(approach=(2e-4, 2e-4, 1e-3))
    found = made.drive(calibrate_geometry(task))
    assert found.cameras.approach == task.approach
    made.pose = begun = (side * 8e-4, side * 6e-4, 0.0)
    visited: list[Floats] = []
    go = made.go

    def watched(motion: StageMotion) -> None:
        go(motion)
        visited.append(np.array(made.pose))
        if motion.approach is not None:
            visited.append(np.add(made.pose, motion.approach))

    made.go = watched  # type: ignore[method-assign]
    again = made.drive(repeat_calibration(found.cameras))
    assert again.approach == task.approach
    assert made.pose == begun
    poses = np.array(visited)
    assert ((poses >= task.room.low) & (poses <= task.room.high)).all()
    assert task.room.holds(travels(task.start, poses)).all()


@pytest.mark.parametrize("home", [3e-4, 1e-3, 2e-3])
@pytest.mark.generated(*range(6))
def test_a_check_after_an_error_of_homing_stays_within_the_limits(seed: int, home: float) -> None:
    """The calibration corrects the poses at which it looked, some of which were outside the limits."""
    made, task = stage(sorted(STAGES)[seed % 3], seed, noise=0.05, lens="perspective")
    signs = np.random.default_rng(seed).choice((-1.0, 1.0), 3).tolist()
    legs = [
        dataclasses.replace(leg, home=leg.home + sign * home) for leg, sign in zip(made.built.legs, signs, strict=True)
    ]
    made.built = dataclasses.replace(made.built, legs=tuple(legs))
    found = made.drive(calibrate_geometry(task._replace(looks=4)))
    poses = poses_within(task.room, found.geometry, found.cameras)
    assert len(poses) >= 12
    made.configured, made.scales = found.geometry, (1.0 + made.scales) / (1.0 + np.array(found.scales)) - 1.0
    made.pose, go = (0.0, 0.0, 0.0), made.go

    def watched(motion: StageMotion) -> None:
        go(motion)
        assert (np.abs(made.pose) <= np.add(task.room.high, 1e-12)).all()
        assert task.room.holds(travels(found.geometry, made.pose), 1e-12)

    made.go = watched  # type: ignore[method-assign]
    again = made.drive(repeat_calibration(found.cameras, 4, poses))
    assert not any(view.is_changed for view in compare_views(found.cameras, again))
    outside = task.room._replace(low=(0.02, 0.02, 0.0), high=(0.03, 0.03, 0.1))
    with pytest.raises(AlignmentError, match="all poses of the calibration are outside"):
        poses_within(outside, found.geometry, found.cameras)


@given(SEEDS, st.booleans())
@settings(deadline=None, max_examples=20)
def test_two_names_of_one_mark_are_refused_after_the_first_moves(seed: int, one: bool) -> None:
    made, task = stage("uvw", seed, 0.05)
    look = made.look
    made.look = lambda: (seen := look()) | ({"again": seen["left"]} if "left" in seen else {})  # type: ignore[method-assign]
    views = {"left": "a", "again": "a" if one else "b", "right": "c"}
    with pytest.raises(AlignmentError, match=r"marks (left and again|again and left) are at the same") as refused:
        made.drive(calibrate_geometry(task._replace(views=views)))
    assert refused.value.fault is AlignmentFault.MISSING
    assert made.motions == 6


def test_marks_that_do_not_move_and_a_field_without_marks_are_refused() -> None:
    made, task = stage("uvw", 1)
    pose: Triple = (0.0, 0.0, 0.0)
    seen = made.look()
    made.look = lambda: seen  # type: ignore[method-assign]
    with pytest.raises(AlignmentError) as still:
        made.drive(calibrate_geometry(task))
    assert still.value.fault is AlignmentFault.STILL
    made, task = stage("uvw", 1)
    assert made.pose == pose
    with pytest.raises(AlignmentError, match="check the field"):
        made.drive(calibrate_geometry(task._replace(field=(50.0, 50.0))))
