"""Calibration from moves: against exact cameras of all kinds, by its covariance, and what it refuses."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from alignment.cameras import Stage, camera
from hypothesis import assume, given
from hypothesis import strategies as st
from trirail.alignment import camera_calibration
from trirail.alignment.camera_calibration import (
    CalibrationSample,
    CameraCalibration,
    calibrate,
    check_moves,
    fit_cameras,
    to_base_frame,
)
from trirail.alignment.images import LENSES, Lens, locate_pixels, project_points, projection_jacobians
from trirail.alignment.misalignment import measure_misalignment
from trirail.alignment.procedure import DEFAULT_MOVES, calibrate_by_moves, calibration_moves
from trirail.errors import AlignmentError, AlignmentFault, RefusedError
from trirail_drivers.interface import Triple

SEEDS = st.integers(0, 2**32 - 1)
MORE: tuple[Triple, ...] = (
    *DEFAULT_MOVES,
    *(
        (x * 1e-3, y * 1e-3, math.radians(phi))
        for x, y, phi in ((2, 2, 0.5), (2, -2, -1), (-2, 2, -1), (-2, -2, 1), (0, 2, 2))
    ),
)
PART = {"left": (-0.06, 0.01), "right": (0.055, -0.005)}


def two_cameras(seed: int, lens: Lens = "affine", noise: float | Mapping[str, float] = 0.0) -> Stage:
    rng = np.random.default_rng(seed)
    return Stage({name: camera(rng, place, lens) for name, place in PART.items()}, PART, rng, noise)


def one_camera(seed: int, lens: Lens = "affine") -> Stage:
    rng = np.random.default_rng(seed)
    part = {"left": (0.019, 0.0105), "right": (0.021, 0.0095)}
    view = camera(rng, (0.02, 0.01), lens)
    return Stage(dict.fromkeys(part, view), part, rng)


@given(SEEDS, st.sampled_from(LENSES), st.booleans())
def test_exact_looks_give_the_exact_camera_and_marks(seed: int, lens: Lens, one: bool) -> None:
    stage = one_camera(seed, lens) if one else two_cameras(seed, lens)
    views = dict.fromkeys(stage.part, "camera") if one else None
    found = stage.drive(calibrate_by_moves(MORE, views, lens, (1000.0, 800.0)))
    assert found.noise < 1e-6
    for name, place in stage.part.items():
        assert found.marks[name].place == pytest.approx(place, abs=1e-9)
        view, true = found.views[found.marks[name].view], stage.views[name]
        near = np.array(place) + 1e-3 * np.array([(1.0, 1.0), (-1.0, 0.5), (0.2, -1.0)])
        assert project_points(view, near) == pytest.approx(project_points(true, near), abs=1e-4)
        assert view.mirrored == true.mirrored
    assert found.reach == pytest.approx(
        max(np.linalg.norm(to_base_frame(q, p) - np.array(q)) for q in stage.part.values() for p in MORE), rel=1e-6
    )


@pytest.mark.parametrize("lens", LENSES)
def test_only_a_radial_lens_needs_its_centre_and_is_refused_without_it_before_a_look(lens: Lens) -> None:
    stage = one_camera(1, lens)
    views = dict.fromkeys(stage.part, "camera")
    samples = [CalibrationSample(pose, stage.look()) for pose in MORE]
    if lens != "radial":
        assert stage.drive(calibrate_by_moves(MORE, views, lens)).noise < 1e-6
        return
    with pytest.raises(RefusedError, match=r"centre is None: expected the pixel \(u, v\) on the axis"):
        next(calibrate_by_moves(MORE, views, lens))
    with pytest.raises(RefusedError, match="centre is None"):
        calibrate(samples, views, lens)


@given(SEEDS, st.sampled_from(LENSES))
def test_places_are_the_inverse_of_pixels_and_slopes_their_derivative(seed: int, lens: Lens) -> None:
    rng = np.random.default_rng(seed)
    view = camera(rng, (0.01, -0.02), lens)
    points = np.array(view.origin) + rng.uniform(-2e-3, 2e-3, (5, 2))
    assert locate_pixels(view, project_points(view, points)) == pytest.approx(points, abs=1e-12)
    step = 1e-7
    for axis in range(2):
        d = step * np.eye(2)[axis]
        difference = (project_points(view, points + d) - project_points(view, points - d)) / (2 * step)
        assert projection_jacobians(view, points)[:, :, axis] == pytest.approx(difference, rel=1e-5, abs=1.0)


@given(SEEDS, st.floats(-9.0, -5.3))
def test_turns_within_the_noise_are_refused(seed: int, exponent: float) -> None:
    """The moves determine the centre of rotation, but the noise is as large as the displacement by the turn."""
    stage = two_cameras(seed, noise=0.1)
    with pytest.raises(AlignmentError, match="distance from the centre of rotation is uncertain by") as refused:
        stage.drive(calibrate_by_moves(calibration_moves("affine", 1e-3, 10.0**exponent)))
    assert refused.value.fault is AlignmentFault.MOVES


UNEQUAL = {"left": 0.05, "right": 1.0}
"""Noise of the pictures of two cameras [pixel]."""


@pytest.mark.parametrize("noise", [dict.fromkeys(PART, 0.1), UNEQUAL], ids=["equal", "unequal"])
@pytest.mark.long
def test_noise_and_deviations_of_each_camera_are_those_of_many_trials(noise: dict[str, float]) -> None:
    stage = two_cameras(0, noise=noise)
    trials = []
    for seed in range(300):
        stage.reseed(1000 + seed)
        trials.append(stage.drive(calibrate_by_moves()))
    for name, place in PART.items():
        noises = np.array([found.noise_of(name) for found in trials])
        errors = np.array([np.subtract(found.marks[name].place, place) for found in trials])
        deviations = np.array([found.marks[name].deviation for found in trials])
        assert (noises**2).mean() == pytest.approx(noise[name] ** 2, rel=0.15)
        assert (deviations**2).mean() == pytest.approx((errors**2).mean(), rel=0.3)
    assert np.mean([found.noise**2 for found in trials]) == pytest.approx(
        np.mean(np.square([*noise.values()])), rel=0.15
    )


def test_a_view_with_few_degrees_of_freedom_has_the_noise_of_all_views() -> None:
    """Seven looks of one mark leave six degrees of freedom, six looks leave four, and five leave two."""
    stage = two_cameras(0, noise=UNEQUAL)
    samples = []
    for pose in ((0.0, 0.0, 0.0), *DEFAULT_MOVES):
        stage.pose = pose
        samples.append(CalibrationSample(pose, stage.look()))
    for hidden in ((), (2,), (2, 4)):
        looks = [
            each._replace(marks={name: at for name, at in each.marks.items() if name == "right" or n not in hidden})
            for n, each in enumerate(samples, 1)
        ]
        found = calibrate(looks)
        assert found.noise_of("right") == pytest.approx(1.0, rel=0.6)
        assert (found.noise_of("left") < 0.1) == (len(hidden) < 2)
        assert (found.noise_of("left") == pytest.approx(found.noise)) == (len(hidden) == 2)


def test_an_alignment_weighs_each_camera_by_its_own_noise() -> None:
    """The errors are as large as is said, and no larger than those of the two marks that are seen precisely."""
    part = {**PART, "middle": (0.0, 0.03)}
    rng = np.random.default_rng(0)
    views = {name: camera(rng, place) for name, place in part.items()}
    stage = Stage(views, part, rng, noise={"left": 0.05, "middle": 0.05, "right": 1.0})
    calibration = stage.drive(calibrate_by_moves(looks=16))
    targets = {name: (float(u), float(v)) for name, (u, v) in Stage(views, part, rng).look().items()}
    turns, places, said = [], [], []
    for _ in range(200):
        found = measure_misalignment(calibration, stage.look(), targets)
        turns.append(found.motion.turn)
        places.append(found.motion.displacements(found.positions))
        said.append(found.deviations(math.sqrt(calibration.looks)))
    place, turn = np.sqrt(np.mean(np.square(said), axis=0))
    assert np.std(turns) == pytest.approx(turn, rel=0.3)
    coarsest = min(views[name].scale for name in ("left", "middle"))
    precise = math.sqrt(2.0) * 0.05 / coarsest / math.dist(part["left"], part["middle"])
    assert np.std(turns) < 1.3 * precise
    assert np.std(places, axis=0).max(axis=0).max() == pytest.approx(place, rel=0.3)


def test_marks_that_stand_still_are_refused() -> None:
    stage = two_cameras(3)
    frozen = stage.look()
    stage.look = lambda: frozen  # type: ignore[method-assign]
    with pytest.raises(AlignmentError) as refused:
        stage.drive(calibrate_by_moves())
    assert refused.value.fault is AlignmentFault.STILL


@pytest.mark.parametrize(
    "moves",
    [
        DEFAULT_MOVES[:2],
        [(x * 1e-4, 0.0, 0.0) for x in range(1, 9)],
        [(x * 1e-4, 2e-4 * x, 0.0) for x in range(1, 9)],
        [(0.0, 0.0, x * 1e-3) for x in range(1, 9)],
        [(x * 1e-4, 1e-4 * x * x, 0.0) for x in range(1, 9)],
    ],
    ids=["too few", "along x", "along a line", "turns alone", "no turn"],
)
def test_moves_that_do_not_tell_it_are_refused(moves: list[Triple]) -> None:
    stage = two_cameras(4)
    with pytest.raises(AlignmentError) as refused:
        stage.drive(calibrate_by_moves(moves))
    assert refused.value.fault is AlignmentFault.MOVES
    assert stage.motions == 0


@pytest.mark.parametrize("lens", LENSES)
@given(SEEDS, st.floats(5e-4, 1e-2), st.floats(3e-3, 0.05), st.booleans())
def test_moves_that_tell_it_are_not_refused_before_they_are_made(
    lens: Lens, seed: int, by: float, turn: float, one: bool
) -> None:
    """At any place on the table; for a single picture of both marks, and for two."""
    x, y, phi = np.random.default_rng(seed).uniform(-0.05, 0.05, 3).tolist()
    poses = [(x + a, y + b, phi + c) for a, b, c in ((0.0, 0.0, 0.0), *calibration_moves(lens, by, turn))]
    check_moves(poses, ["left", "right"], dict.fromkeys(PART, "camera") if one else None, lens)


def test_a_first_look_without_a_mark_is_refused_and_nothing_moves() -> None:
    stage = two_cameras(4)
    stage.look = dict  # type: ignore[method-assign]
    with pytest.raises(AlignmentError, match="first look") as refused:
        stage.drive(calibrate_by_moves())
    assert refused.value.fault is AlignmentFault.MISSING
    assert stage.motions == 0


@pytest.mark.parametrize("lens", LENSES)
def test_a_view_without_its_centre_is_refused_and_nothing_moves(lens: Lens) -> None:
    stage = two_cameras(4, lens)
    centre = {"left": (1000.0, 800.0), "rigth": (1000.0, 800.0)}
    with pytest.raises(AlignmentError, match="views without a centre: right;") as refused:
        stage.drive(calibrate_by_moves(calibration_moves(lens, 1e-3, 0.0175), lens=lens, centre=centre))
    assert refused.value.fault is AlignmentFault.MISSING
    assert stage.motions == 0


def test_a_lens_that_so_few_looks_cannot_tell_is_refused() -> None:
    with pytest.raises(AlignmentError) as refused:
        two_cameras(5, "perspective").drive(calibrate_by_moves(DEFAULT_MOVES[:4], lens="perspective"))
    assert refused.value.fault is AlignmentFault.MOVES


def test_a_mark_that_is_missing_in_a_look_is_missed_in_none_of_the_others() -> None:
    stage = two_cameras(6)
    sights = []
    for n, pose in enumerate(((0.0, 0.0, 0.0), *MORE)):
        stage.pose = pose
        seen = stage.look()
        if n == 3:
            del seen["left"]
        sights.append(CalibrationSample(pose, seen))
    found: CameraCalibration = calibrate(sights)
    assert found.marks["left"].place == pytest.approx(PART["left"], abs=1e-9)
    assert "left" not in found.residuals[3]


PLACES = {"a": (0.0, 0.0), "b": (0.0021, -0.0007), "c": (0.001, 0.0012)}
"""Mark a is at the centre of the rotations."""


def shared_camera(
    seed: int, hidden: set[tuple[str, int]], noise: float = 0.1, jitter: float = 0.0
) -> CameraCalibration:
    """Calibrate one camera with the looks of DEFAULT_MOVES; `hidden` are marks and looks, counted from 1."""
    rng = np.random.default_rng(seed)
    view, samples = camera(rng, (0.02, 0.01)), []
    for n, move in enumerate(((0.0, 0.0, 0.0), *DEFAULT_MOVES), 1):
        x, y, phi = (np.array(move) + jitter * rng.standard_normal(3)).tolist()
        seen = {
            name: project_points(view, to_base_frame(q, (x, y, phi))[None])[0] + 0.1 * rng.standard_normal(2)
            for name, q in PLACES.items()
            if (name, n) not in hidden
        }
        samples.append(CalibrationSample((x, y, phi), {name: (u, v) for name, (u, v) in seen.items()}))
    return calibrate(samples, dict.fromkeys(PLACES, "cam"))


@given(seed=SEEDS, name=st.sampled_from("abc"), others=st.sets(st.integers(2, 5)), jitter=st.sampled_from((0.0, 1e-8)))
def test_a_mark_that_is_hidden_at_every_rotation_is_named(
    seed: int, name: str, others: set[int], jitter: float
) -> None:
    with pytest.raises(AlignmentError) as refused:
        shared_camera(seed, {(name, look) for look in (*others, 6, 7)}, jitter=jitter)
    assert refused.value.fault is AlignmentFault.MISSING
    looks = ", ".join(map(str, sorted((*others, 6, 7))))
    assert f"view cam: mark {name} was not found in look {looks}, and" in str(refused.value)


@given(SEEDS)
def test_a_mark_that_moves_little_in_the_looks_that_show_it_does_not_fail_the_others(seed: int) -> None:
    found = shared_camera(seed, {("a", look) for look in (2, 3, 4, 5)})
    assert found.noise < 0.5
    assert found.marks["a"].place == pytest.approx(PLACES["a"], abs=1e-4)


@given(SEEDS, st.sampled_from(LENSES), st.booleans(), st.booleans(), st.integers(0, 2**31))
def test_marks_that_are_swapped_in_one_look_are_refused(
    seed: int, lens: Lens, one: bool, many: bool, look: int
) -> None:
    """A lens that bends absorbs most of a swap if the moves are few."""
    stage = one_camera(seed, lens) if one else two_cameras(seed, lens, noise=0.05)
    moves = MORE if many else calibration_moves(lens, 1e-3, math.radians(1.0))
    swapped = look % (len(moves) + 1)
    samples = []
    for n, pose in enumerate(((0.0, 0.0, 0.0), *moves)):
        stage.pose = pose
        seen = stage.look()
        apart = math.dist(seen["left"], seen["right"])
        if n == swapped:
            assume(apart > 20.0)
            seen = {"left": seen["right"], "right": seen["left"]}
        samples.append(CalibrationSample(pose, seen))
    views = dict.fromkeys(PART, "camera") if one else None
    with pytest.raises(AlignmentError, match=f"^look {swapped + 1}: marks left and right are swapped") as refused:
        calibrate(samples, views, lens, (1000.0, 800.0))
    assert refused.value.fault is AlignmentFault.SWAPPED


def looks_at_many_marks(seed: int, lens: Lens, count: int, noise: float) -> list[CalibrationSample]:
    """Return looks at marks anywhere in one picture, or each with its own camera."""
    rng = np.random.default_rng(seed)
    part = {str(n): (float(x), float(y)) for n, (x, y) in enumerate(rng.uniform(-4e-3, 4e-3, (count, 2)))}
    stage = Stage(dict.fromkeys(part, camera(rng, (0.0, 0.0), lens)), part, rng, noise)
    samples = []
    for stage.pose in ((0.0, 0.0, 0.0), *calibration_moves(lens, 1e-3, math.radians(1.0))):
        samples.append(CalibrationSample(stage.pose, stage.look()))
    return samples


@given(SEEDS, st.sampled_from(LENSES), st.integers(3, 9), st.booleans(), st.data())
def test_two_of_many_marks_that_are_swapped_are_found(
    seed: int, lens: Lens, count: int, one: bool, data: st.DataObject
) -> None:
    samples = looks_at_many_marks(seed, lens, count, 0.05)
    look = data.draw(st.integers(0, len(samples) - 1))
    a, b = sorted(data.draw(st.sets(st.sampled_from(sorted(samples[0].marks)), min_size=2, max_size=2)))
    marks = samples[look].marks
    assume(math.dist(marks[a], marks[b]) > 20.0)
    samples[look] = samples[look]._replace(marks={**marks, a: marks[b], b: marks[a]})
    views = dict.fromkeys(marks, "camera") if one else None
    with pytest.raises(AlignmentError, match=f"^look {look + 1}: marks {a} and {b} are swapped"):
        calibrate(samples, views, lens, (1000.0, 800.0))


def test_the_search_for_swapped_marks_does_not_grow_with_the_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    """With 20 marks, a fit to every pair of them in each look took 21 s, without a word."""
    count = 0

    def counted(*given: Any) -> CameraCalibration:
        nonlocal count
        count += 1
        return fit_cameras(*given)

    monkeypatch.setattr(camera_calibration, "fit_cameras", counted)
    samples = looks_at_many_marks(1, "affine", 20, 1.5)
    found = calibrate(samples, dict.fromkeys(samples[0].marks, "camera"))
    assert found.noise > 1.0
    assert 1 < count <= 20


@pytest.mark.parametrize("lens", LENSES)
@given(seed=SEEDS, by=st.floats(5e-4, 2e-3), turn=st.floats(5e-3, 0.05), data=st.data())
@pytest.mark.long
def test_a_late_picture_of_one_look_is_refused(
    lens: Lens, seed: int, by: float, turn: float, data: st.DataObject
) -> None:
    stage = two_cameras(seed, lens, noise=0.1)
    poses = [stage.pose, *calibration_moves(lens, by, turn)]
    samples = []
    for stage.pose in poses:
        samples.append(CalibrationSample(stage.pose, stage.look()))
    calibrate(samples, lens=lens, centre=(1000.0, 800.0))
    late = data.draw(st.integers(1, len(poses) - 1))
    pixels = np.array([list(sample.marks.values()) for sample in samples])
    travel, move = np.ptp(pixels, axis=0).max(), np.linalg.norm(pixels[late] - pixels[late - 1], axis=1).max()
    assume(move > 0.2 * travel)  # with a shorter move, it could be a lens that bends
    samples[late] = samples[late]._replace(marks=samples[late - 1].marks)
    with pytest.raises(AlignmentError):
        calibrate(samples, lens=lens, centre=(1000.0, 800.0))


@pytest.mark.parametrize("lens", LENSES)
@given(seed=SEEDS, one=st.booleans())
def test_a_lens_that_the_calibration_does_not_model_is_no_swap(lens: Lens, seed: int, one: bool) -> None:
    stage = one_camera(seed, lens) if one else two_cameras(seed, lens)
    views = dict.fromkeys(stage.part, "camera") if one else None
    assert stage.drive(calibrate_by_moves(MORE, views)).noise < 30.0


def test_no_mark_at_all_is_refused() -> None:
    with pytest.raises(AlignmentError) as refused:
        calibrate([CalibrationSample((0.0, 0.0, 0.0), {})])
    assert refused.value.fault is AlignmentFault.MISSING
