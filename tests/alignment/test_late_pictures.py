"""Cameras that deliver old pictures or noise: a part that does not lie right is never called so."""

import math
from collections.abc import Mapping
from decimal import Decimal

import msgspec
import numpy as np
import pytest
from alignment.cameras import Stage, part_at
from alignment.test_procedure import ready
from trirail.alignment.camera_calibration import to_base_frame
from trirail.alignment.fresh_pictures import NOISE_DEVIATIONS
from trirail.alignment.images import Pair
from trirail.alignment.procedure import DEFAULT_MOVES, AlignmentEnd, AlignmentTask, align, calibrate_by_moves
from trirail.errors import AlignmentError, AlignmentFault, TrirailError

Marks = Mapping[str, Pair]


class LateCamera:
    """Delivers the picture before, that of two before, or an old one at random, in place of a stage's look."""

    def __init__(self, stage: Stage, how: str, rng: np.random.Generator) -> None:
        self._take, self._how, self._rng = stage.look, how, rng
        self._taken: list[dict[str, Pair]] = []

    def __call__(self) -> dict[str, Pair]:
        self._taken.append(self._take())
        if self._how == "random":
            return self._taken[self._rng.integers(len(self._taken))] if self._rng.random() < 0.3 else self._taken[-1]
        return self._taken[max(0, len(self._taken) - 1 - int(self._how))]


def left(stage: Stage, part: Mapping[str, Pair], wanted: Mapping[str, Pair]) -> float:
    """How far a mark truly is from where it lay when the targets were taught [m]."""
    now = {name: to_base_frame(place, stage.pose) for name, place in part.items()}
    return max(float(np.linalg.norm(now[name] - np.array(wanted[name]))) for name in part)


@pytest.mark.parametrize("how", ["0", "1", "2", "4", "random"])
@pytest.mark.parametrize("noise", [0.0, 0.05, 0.5])
@pytest.mark.generated(*range(12))
def test_reached_is_never_said_of_a_part_that_lies_wrong(seed: int, noise: float, how: str) -> None:
    rng = np.random.default_rng((seed, int(noise * 100)))
    stage, calibration, targets = ready(seed, noise)
    wanted: dict[str, Pair] = {
        name: tuple(to_base_frame(place, stage.pose).tolist()) for name, place in stage.part.items()
    }
    looks = int(rng.choice([1, 2, 4]))
    far = 10.0 ** rng.uniform(-5.7, -3.0)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    if how == "random" or seed % 3:
        stage.look = LateCamera(stage, how, rng)  # type: ignore[method-assign]
        first_is_of_the_part_before = seed % 3 == 1 and how != "random"
        if first_is_of_the_part_before:
            for _ in range(3):
                stage.look()
        stage.part = part_at(stage.part, (far * math.cos(angle), far * math.sin(angle), rng.uniform(-4e-3, 4e-3)))
    else:
        stage.part = part_at(stage.part, (far * math.cos(angle), far * math.sin(angle), rng.uniform(-4e-3, 4e-3)))
        stage.look = LateCamera(stage, how, rng)  # type: ignore[method-assign]
    confirmed = msgspec.structs.replace(calibration, confirmed=bool(rng.integers(2)))
    try:
        found = stage.drive(align(AlignmentTask(confirmed, targets, tolerance=1e-6, angle=2.4e-5, looks=looks)))
    except AlignmentError as error:
        assert error.fault in (AlignmentFault.STILL, AlignmentFault.DISTANCE)  # noqa: PT017 - or it has a result
        assert how != "0"
        return
    if found.reached:
        scale = min(view.scale for view in calibration.views.values())
        assert left(stage, stage.part, wanted) < 1e-6 + NOISE_DEVIATIONS * 1.5 * noise / scale
    if how in ("0", "1", "2") and noise < 0.1:
        assert found.reached
    if how == "0":
        assert found.why is not AlignmentEnd.GROWING


@pytest.mark.parametrize("how", ["0", "1", "2", "4"])
@pytest.mark.parametrize("looks", [1, 4])
@pytest.mark.generated(*range(20))
def test_a_late_camera_and_a_correction_within_the_noise_end_at_the_right_place(
    seed: int, looks: int, how: str
) -> None:
    """An old picture agrees with so small a motion, and would show the part right after a correction too many."""
    rng = np.random.default_rng(seed)
    stage, calibration, targets = ready(seed, noise := 0.05)
    wanted = stage.part
    angle, far = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(2e-6, 3e-6)
    stage.part = part_at(wanted, (far * math.cos(angle), far * math.sin(angle), 0.0))
    stage.look = LateCamera(stage, how, rng)  # type: ignore[method-assign]
    for _ in range(5):
        stage.look()
    confirmed = msgspec.structs.replace(calibration, confirmed=True)
    found = stage.drive(align(AlignmentTask(confirmed, targets, tolerance=1e-6, angle=2.4e-5, looks=looks)))
    assert found.reached
    scale = min(view.scale for view in calibration.views.values())
    assert left(stage, stage.part, wanted) < 1e-6 + 3.0 * noise / scale


@pytest.mark.generated(*range(12))
def test_reached_after_a_correction_is_repeated_by_further_pictures(seed: int) -> None:
    """Also if a camera delivers a single old picture, which shows the part where the correction should bring it."""
    stage, calibration, targets = ready(seed, noise=0.02)
    stage.part = part_at(stage.part, (5e-5, -3e-5, 2e-4))
    drawn, taken = stage.look, 0

    def look() -> dict[str, Pair]:
        nonlocal taken
        taken += 1
        return dict(targets) if taken == 2 else drawn()

    stage.look = look  # type: ignore[method-assign]
    stage._moved = lambda by: (0.9 * by[0], 0.9 * by[1], 0.9 * by[2])
    before = stage.motions
    found = stage.drive(align(AlignmentTask(msgspec.structs.replace(calibration, confirmed=True), targets)))
    assert found.reached
    assert stage.motions >= before + 2


@pytest.mark.generated(*range(20))
def test_a_camera_that_shows_the_same_picture_again_is_told_after_one_motion(seed: int) -> None:
    stage, calibration, targets = ready(seed, noise=0.05)
    stage.part = part_at(stage.part, (5e-4, -3e-4, 2e-3))
    frozen = stage.look()
    stage.look = lambda: frozen  # type: ignore[method-assign]
    before = stage.motions
    with pytest.raises(AlignmentError, match="new picture at each look") as refused:
        stage.drive(align(AlignmentTask(calibration, targets)))
    assert refused.value.fault is AlignmentFault.STILL
    assert stage.motions == before + 1


@pytest.mark.parametrize("how", ["1", "2", "random"])
@pytest.mark.generated(*range(6))
def test_a_calibration_with_late_pictures_is_refused(seed: int, how: str) -> None:
    stage, _, _ = ready(seed, noise=0.05)
    stage.look = camera = LateCamera(stage, how, np.random.default_rng(seed + 1))  # type: ignore[method-assign]
    camera()
    camera()
    try:
        found = stage.drive(calibrate_by_moves())
    except AlignmentError as error:
        assert error.fault in (AlignmentFault.STILL, AlignmentFault.MOVES)  # noqa: PT017 - or it has a result
    else:
        assert how == "random"  # it may have taken new pictures alone
        assert found.noise < 0.1


@pytest.mark.generated(*range(10))
def test_noise_ends_as_noise_and_not_as_an_error_that_grows(seed: int) -> None:
    stage, calibration, targets = ready(seed, noise=0.5)
    stage.part = part_at(stage.part, (2e-6, 1e-6, 0.0))
    found = stage.drive(align(AlignmentTask(calibration, targets, corrections=6)))
    assert found.why in (AlignmentEnd.NOISE, AlignmentEnd.CORRECTIONS)


@pytest.mark.generated(*range(30))
def test_marks_too_near_to_tell_the_angle_are_not_called_right(seed: int) -> None:
    part = {"left": (0.02, 0.01), "right": (0.021, 0.01)}
    stage, calibration, targets = ready(seed, noise=0.1, part=part)
    stage.part = part_at(part, (3e-4, -2e-4, 1e-3))
    found = stage.drive(align(AlignmentTask(calibration, targets, distance=0.01)))
    assert not found.reached
    many = stage.drive(align(AlignmentTask(calibration, targets, tolerance=5e-6, angle=5e-3, distance=0.01)))
    assert many.reached


BAD_TASKS = {
    "looks": (0, -1, 1.5, "2", None, math.nan, True, Decimal("2"), np.float32(2.0)),
    "tolerance": (-1, 0.0, math.nan, "1um", None, [1.0]),
    "angle": (-1e-5, math.nan, "5arcsec", None),
    "distance": (-1.0, math.nan, None),
    "corrections": (-1, 1.5, "3", None),
    "approach": ((1.0, 2.0), (math.nan, 0.0, 0.0), "far", 3.0, ("a", "b", "c")),
    "targets": (
        None,
        3,
        {"left": None},
        {"left": (1e155, 0.0)},
        {"left": (math.nan, 1.0)},
        {"left": (1.0, 2.0, 3.0)},
        {"nobody": (1.0, 2.0)},
    ),
    "calibration": (None, "camera.json", {}),
}
BAD_CALIBRATIONS = {
    "moves": (3, "abc", [(1e-3, 0.0)], [(math.nan, 0.0, 0.0)], [None], *((m, "x") for m in DEFAULT_MOVES[:1])),
    "views": ([1], {"left": 3}, {"left": "one"}),
    "lens": ("fisheye", None, 3, [], np.zeros(2)),
    "centre": ((1.0,), (math.nan, 0.0)),
    "looks": BAD_TASKS["looks"],
    "approach": BAD_TASKS["approach"],
}


@pytest.mark.parametrize(("what", "value"), [(what, value) for what in BAD_TASKS for value in BAD_TASKS[what]])
def test_an_alignment_with_an_impossible_argument_moves_nothing(what: str, value: object) -> None:
    stage, calibration, targets = ready(0)
    stage.part = part_at(stage.part, (5e-4, -3e-4, 2e-3))
    before = stage.motions
    task = AlignmentTask(calibration, targets, approach=(1e-3, 0.0, 0.0))._replace(**{what: value})  # type: ignore[arg-type]
    with pytest.raises(TrirailError, match=what if what != "targets" else "target|nobody"):
        stage.drive(align(task))
    assert stage.motions == before


@pytest.mark.parametrize(
    ("what", "value"), [(what, value) for what in BAD_CALIBRATIONS for value in BAD_CALIBRATIONS[what]]
)
def test_a_calibration_with_an_impossible_argument_moves_nothing(what: str, value: object) -> None:
    stage, _, _ = ready(0)
    before = stage.motions
    with pytest.raises(TrirailError, match=what if what != "views" else "view"):
        stage.drive(calibrate_by_moves(**{what: value}))  # type: ignore[arg-type]
    assert stage.motions == before


@pytest.mark.parametrize(
    "seen",
    [
        None,
        3,
        [(1.0, 2.0)],
        {"left": (1.0, 2.0, 3.0)},
        {"left": None},
        {"left": "ab"},
        {"left": (math.inf, 0.0)},
        {"left": (1e20, 0.0)},
        {"left": (0.0, -1e155)},
        {3: (1.0, 2.0)},
    ],
)
@pytest.mark.parametrize("calibrates", [False, True])
def test_what_is_no_look_is_refused_with_what_was_returned(seen: object, calibrates: bool) -> None:
    stage, calibration, targets = ready(0)
    before = stage.motions
    stage.look = lambda: seen  # type: ignore[method-assign, assignment, return-value, unused-ignore]
    with pytest.raises(AlignmentError, match="expected"):
        stage.drive(calibrate_by_moves() if calibrates else align(AlignmentTask(calibration, targets)))
    assert stage.motions == before


def test_numbers_of_another_library_are_taken() -> None:
    stage, calibration, targets = ready(0)
    task = AlignmentTask(calibration, targets, np.float64(1e-6), np.float32(1e-4), np.int64(2), looks=np.int32(1))  # type: ignore[arg-type]
    assert stage.drive(align(task)).reached
