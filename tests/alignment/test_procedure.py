"""Alignment on an ideal stage: one correction, and what ends it or is refused before anything moves."""

import contextlib
import math

import msgspec
import numpy as np
import pytest
from alignment.cameras import Stage, camera, part_at
from hypothesis import given
from hypothesis import strategies as st
from trirail.alignment.camera_calibration import CameraCalibration
from trirail.alignment.images import Pair
from trirail.alignment.procedure import (
    MAX_UNCONFIRMED_TRAVEL,
    Alignment,
    AlignmentEnd,
    AlignmentTask,
    align,
    calibrate_by_moves,
    measure_part,
)
from trirail.errors import AlignmentError, AlignmentFault
from trirail_drivers.interface import Triple

SEEDS = st.integers(0, 2**32 - 1)
PART = {"left": (-0.06, 0.01), "right": (0.055, -0.005)}
Ready = tuple[Stage, CameraCalibration, dict[str, Pair]]


def ready(seed: int, noise: float = 0.0, part: dict[str, Pair] = PART) -> Ready:
    """Return a stage, its calibration and the targets: where the marks of the part as it lies now are seen."""
    rng = np.random.default_rng(seed)
    stage = Stage({name: camera(rng, place) for name, place in part.items()}, part, rng, noise)
    calibration = stage.drive(calibrate_by_moves())
    return stage, calibration, stage.look()


def lay(stage: Stage, error: Triple, part: dict[str, Pair] = PART) -> None:
    stage.part = part_at(part, error)


ERRORS = st.tuples(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3), st.floats(-8e-3, 8e-3))


@given(SEEDS, ERRORS, st.integers(2, 4))
def test_exact_looks_need_one_correction_for_any_camera(seed: int, error: Triple, n: int) -> None:
    angles = 0.3 + 2 * math.pi / n * np.arange(n)
    part = {f"m{k}": (0.06 * math.cos(a), 0.05 * math.sin(a)) for k, a in enumerate(angles)}
    stage, calibration, targets = ready(seed, part=part)
    lay(stage, error, part)
    found = stage.drive(align(AlignmentTask(calibration, targets, tolerance=1e-9, angle=1e-8)))
    assert found.reached
    assert len(found.corrections) <= 1
    now = stage.look()
    assert all(now[name] == pytest.approx(targets[name], abs=1e-3) for name in targets)


@given(SEEDS, ERRORS)
def test_noisy_looks_leave_no_more_than_the_noise(seed: int, error: Triple) -> None:
    stage, calibration, targets = ready(seed, noise=0.1)
    lay(stage, error)
    found = stage.drive(align(AlignmentTask(calibration, targets, tolerance=2e-6)))
    assert found.reached
    assert len(found.measurements) == len(found.corrections) + 1


WRONG = {
    "x mirrored": lambda by: (-by[0], by[1], by[2]),
    "both signs": lambda by: (-by[0], -by[1], -by[2]),
    "turned about": lambda by: (by[1], -by[0], by[2]),
    "turn the other way": lambda by: (by[0], by[1], -by[2]),
}


@pytest.mark.parametrize("wrong", WRONG)
@given(SEEDS, ERRORS)
def test_a_stage_that_moves_otherwise_does_not_walk_away(wrong: str, seed: int, error: Triple) -> None:
    stage, calibration, targets = ready(seed)
    lay(stage, error)
    stage._moved = WRONG[wrong]
    found: Alignment = stage.drive(align(AlignmentTask(calibration, targets)))
    assert len(found.corrections) <= 3
    if found.why is AlignmentEnd.GROWING:  # by its first correction that went the wrong way
        assert found.measurements[-1].worst > found.measurements[-2].worst
        assert not found.confirmed
        assert found.measurements[-1].worst < 3.1 * found.measurements[0].worst
    if wrong == "both signs" and found.measurements[0].worst > 1e-5:
        assert found.why is AlignmentEnd.GROWING
        assert len(found.corrections) == 1


CHANGED = {
    "turned by 90°": np.array([(0.0, -1.0), (1.0, 0.0)]),
    "turned about": -np.eye(2),
    "mirrored": np.diag([-1.0, 1.0]),
}


@pytest.mark.parametrize("how", CHANGED)
@given(SEEDS, ERRORS)
def test_cameras_that_were_turned_or_mirrored_since_do_not_lead_away(how: str, seed: int, error: Triple) -> None:
    stage, calibration, targets = ready(seed)
    lay(stage, error)
    first = stage.drive(measure_part(AlignmentTask(calibration, targets))).worst
    for name, view in stage.views.items():
        (a, b), (c, d) = (CHANGED[how] @ np.array(view.matrix)).tolist()
        stage.views[name] = msgspec.structs.replace(view, matrix=((a, b), (c, d)))
    with contextlib.suppress(AlignmentError):
        stage.drive(align(AlignmentTask(calibration, targets)))
    truth = Stage({name: calibration.views[name] for name in PART}, stage.part, np.random.default_rng(0))
    truth.pose = stage.pose
    left = truth.drive(measure_part(AlignmentTask(calibration, targets, distance=1.0))).worst
    assert left <= 3.5 * first + 1e-9


def test_the_first_correction_of_a_fresh_calibration_is_bounded_and_the_others_are_not() -> None:
    stage, calibration, targets = ready(7)
    lay(stage, (0.004, 0.003, 0.0))
    found = stage.drive(align(AlignmentTask(calibration, targets)))
    assert stage.way <= 0.005
    assert found.corrections[0].share == pytest.approx(MAX_UNCONFIRMED_TRAVEL * calibration.reach / 0.005, rel=1e-3)
    assert [c.share for c in found.corrections[1:]] == [1.0]
    assert found.reached
    assert found.confirmed


def test_a_confirmed_calibration_goes_all_the_way() -> None:
    stage, calibration, targets = ready(7)
    lay(stage, (0.004, 0.003, 0.0))
    found = stage.drive(align(AlignmentTask(msgspec.structs.replace(calibration, confirmed=True), targets)))
    assert [c.share for c in found.corrections] == [1.0]


@given(SEEDS, st.booleans())
def test_two_names_of_one_mark_are_refused_and_nothing_moves(seed: int, seen_twice: bool) -> None:
    """Two windows on one mark, as they were calibrated and taught, or a target that was copied to another name."""
    rng = np.random.default_rng(seed)
    part = {"left": PART["left"], "right": PART["left"] if seen_twice else PART["right"]}
    stage = Stage(dict.fromkeys(part, camera(rng, part["left"])), part, rng)
    calibration = stage.drive(calibrate_by_moves())
    targets, moved = dict.fromkeys(part, stage.look()["left"]), stage.motions
    with pytest.raises(AlignmentError, match="left and right have their targets at the same place") as refused:
        stage.drive(align(AlignmentTask(calibration, targets)))
    assert (refused.value.fault, stage.motions) == (AlignmentFault.MISSING, moved)


@given(SEEDS, st.floats(1.05e-3, 0.05), st.booleans())
def test_a_part_of_another_size_is_refused_with_the_number_and_nothing_moves(
    seed: int, share: float, less: bool
) -> None:
    stage, calibration, targets = ready(seed)
    wrong = -share if less else share
    stage.part = {name: (x * (1 + wrong), y * (1 + wrong)) for name, (x, y) in PART.items()}
    moved = stage.motions
    with pytest.raises(AlignmentError) as refused:
        stage.drive(align(AlignmentTask(calibration, targets)))
    assert refused.value.fault is AlignmentFault.DISTANCE
    assert refused.value.value == pytest.approx(wrong, abs=1e-5)
    assert f"{wrong * 1e6:+.0f}"[:3] in str(refused.value)
    assert stage.motions == moved


def test_swapped_marks_of_one_camera_are_refused_and_nothing_moves() -> None:
    rng = np.random.default_rng(8)
    part = {"left": (0.018, 0.0105), "right": (0.021, 0.0095)}
    stage = Stage(dict.fromkeys(part, camera(rng, (0.02, 0.01))), part, rng)
    calibration = stage.drive(calibrate_by_moves(views=dict.fromkeys(part, "camera")))
    targets = stage.look()
    moved = stage.motions
    stage.part = {"left": part["right"], "right": part["left"]}
    with pytest.raises(AlignmentError) as refused:
        stage.drive(align(AlignmentTask(calibration, targets)))
    assert refused.value.fault is AlignmentFault.SWAPPED
    assert stage.motions == moved


@pytest.mark.parametrize("missing", ["left", "right"])
def test_a_mark_that_is_not_found_is_named(missing: str) -> None:
    stage, calibration, targets = ready(9)
    del stage.part[missing]
    with pytest.raises(AlignmentError, match=f"not found: {missing}") as refused:
        stage.drive(align(AlignmentTask(calibration, targets)))
    assert refused.value.fault is AlignmentFault.MISSING


def test_a_target_without_a_calibration_is_named() -> None:
    stage, calibration, targets = ready(9)
    with pytest.raises(AlignmentError, match="not in the calibration: third"):
        stage.drive(align(AlignmentTask(calibration, {**targets, "third": (1.0, 2.0)})))


def test_pictures_that_show_no_number_are_refused() -> None:
    stage, calibration, targets = ready(9)
    stage.look = lambda: {**targets, "left": (math.nan, 1.0)}  # type: ignore[method-assign]
    with pytest.raises(AlignmentError, match="two pixels within"):
        stage.drive(align(AlignmentTask(calibration, targets)))


def test_a_look_alone_moves_nothing_and_tells_the_same() -> None:
    stage, calibration, targets = ready(10)
    lay(stage, (2e-4, -1e-4, 1e-3))
    moved = stage.motions
    told = stage.drive(measure_part(AlignmentTask(calibration, targets)))
    assert stage.motions == moved
    assert told == stage.drive(align(AlignmentTask(calibration, targets))).measurements[0]


def test_more_pictures_are_less_noise() -> None:
    ratios = []
    for seed in range(60):
        stage, calibration, targets = ready(seed, noise=0.3)
        task = AlignmentTask(calibration, targets)
        one, many = (
            np.std([stage.drive(measure_part(task._replace(looks=looks))).shift for _ in range(8)], axis=0).mean()
            for looks in (1, 9)
        )
        ratios.append(many / one)
    assert np.median(ratios) == pytest.approx(1 / 3, rel=0.25)
