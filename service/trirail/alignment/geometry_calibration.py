"""Calibration of a stage with its own cameras: procedure, result, and the parameters that remain undetermined.

The procedure is a generator like those of trirail.alignment.procedure. It looks at a few poses near the current one,
estimates cameras and marks, plans more poses over the whole travel, looks there, and fits everything together.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Generator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from msgspec import structs
from trirail_drivers.interface import Triple

from trirail.alignment import arguments
from trirail.alignment.alignment_request import AlignmentRequest, LookReport, Observation, StageMotion
from trirail.alignment.calibration_procedure import DEFAULT_MOVES, PLATFORM_CENTRE, ZERO_OFFSET
from trirail.alignment.camera_calibration import CalibrationSample, CameraCalibration, MarkFit, calibrate
from trirail.alignment.fresh_pictures import average, capture
from trirail.alignment.images import Lens, Pair
from trirail.alignment.pose_plan import choose_poses, find_candidates
from trirail.alignment.residual_map import ResidualMap, fit_residual_map
from trirail.alignment.rigid_motion import Floats
from trirail.alignment.stage_fit import StageFit, fit_stage
from trirail.alignment.stage_model import StageLook, StageModel, list_marks
from trirail.errors import AlignmentError, AlignmentFault, RefusalCode, RefusedError
from trirail.kinematics.geometry import Geometry, Room, travels
from trirail.kinematics.robot import inverse

DEFAULT_POSES, MIN_POSES = 30, 12
GRID = 7
"""Number of values of x, y and phi from which poses are chosen."""
TRAVEL_SHARE = 0.97
"""Share of the travel that is used, because the configured geometry may be slightly wrong."""
HELD_OUT = 5
"""One of this many planned looks is left out of a fit, to check its predictions."""
MIN_FIRST_LOOKS = 5
"""Number of the seven first looks in which a mark must be visible to be used."""
MAX_LEFT_OUT = 2
"""Greatest number of looks of the first moves that may be wrong."""
MAX_START_RESIDUAL_PX, MAX_START_SHARE = 1.0, 0.01
"""Residual up to which the first looks count as correct: in pixels, and as a share of a mark's travel."""
SYSTEMATIC = 1.5
"""Ratio of residual to picture noise above which the looks have systematic errors."""
MIN_NAMED_SHARE = 0.3
"""Least share of a parameter in an undetermined combination, in units of its doubt, to name it."""


class HeldOutResidual(NamedTuple):
    """Root mean square distance of marks from their computed positions, in looks that the fit did not use."""

    looks: int
    before: float
    """Distance with the configured geometry, and with cameras and marks fitted to it [pixel]."""
    after: float
    """Distance with the calibrated geometry [pixel]."""
    before_m: float
    """Distance with the configured geometry, on the table [m]."""
    after_m: float


class Outlier(NamedTuple):
    """Mark that was seen where it cannot have been. The fit does not use it."""

    look: int
    """Number of the look, counted from 1."""
    mark: str
    distance: float
    """Distance from its computed pixel [pixel]."""
    swapped_with: str | None
    """Mark at whose computed pixel this mark was seen."""


class GeometryCalibration(NamedTuple):
    """Differences of a stage from its configuration, and its cameras."""

    geometry: Geometry
    scales: Triple
    """Real travel of each slider per metre of its encoder, minus 1. Divide counts_per_metre by 1 plus this value."""
    parameters: dict[str, float]
    """Corrections to the configured values, by names such as "A rail_angle" [m, rad, share]."""
    deviations: dict[str, float]
    """Standard deviations of these corrections; infinite for undetermined parameters."""
    undetermined: tuple[str, ...]
    """Names of the parameters that the looks do not determine, or determine only in combination with others.
    Undetermined combinations keep their configured values."""
    residual: HeldOutResidual
    noise: float
    """Standard deviation of a mark's u or v, computed from the residuals [pixel]."""
    picture_noise: float
    """Standard deviation from the pictures alone, at rest [pixel]. If `noise` is greater, no geometry explains the
    rest."""
    cameras: CameraCalibration
    """Cameras and marks in the frame of the new geometry."""
    outliers: tuple[Outlier, ...]
    looks: tuple[StageLook, ...]
    map: ResidualMap | None
    """Map of the errors that remain after the fit; None if they are not systematic, or if there are too few looks."""

    @property
    def is_systematic(self) -> bool:
        """True if the errors of the marks exceed their noise, because of errors that no geometry explains."""
        return self.noise > SYSTEMATIC * self.picture_noise


class GeometryTask(NamedTuple):
    """Arguments of a calibration of the geometry."""

    start: Geometry
    """Geometry of the configuration, without a correction map."""
    room: Room
    """Limits of platform and sliders."""
    field: Pair
    """Columns and rows of the pictures."""
    views: Mapping[str, str] | None = None
    """View of each mark; if None each mark has a camera of its own."""
    lens: Lens = "radial"
    poses: int = DEFAULT_POSES
    looks: int = 4
    """Pictures averaged at each pose."""
    approach: Triple | None = None

    def check(self) -> None:
        """Raise RefusedError, with the value and the allowed range, for the first invalid argument."""
        arguments.check_count(self.poses, "poses", MIN_POSES)
        arguments.check_count(self.looks, "looks", 1)
        arguments.check_views(self.views)
        arguments.check_lens(self.lens, (0.0, 0.0))
        arguments.check_approach(self.approach)
        size = arguments.parse_pixel(self.field)
        if size is None or min(size) <= 0.0:
            text = f"field is {self.field!r:.100}: expected the size of the pictures, (columns, rows) in pixels"
            raise RefusedError(RefusalCode.MALFORMED, text)


def calibrate_geometry(task: GeometryTask) -> Generator[AlignmentRequest, Observation, GeometryCalibration]:
    """Look at planned poses, return to the first one, and return the calibration.

    Raises
    ------
    RefusedError
        An argument is invalid.
    AlignmentError
        The looks do not determine cameras and marks, or no such stage explains them.
    """
    task.check()
    if task.approach is not None:
        yield StageMotion(ZERO_OFFSET, PLATFORM_CENTRE, task.approach)
    try:
        scatter = _Scatter()
        first = yield from _observe(task, scatter)
        looks = [_stage_look(task.start, first)]
        for x, y, phi in DEFAULT_MOVES:
            yield StageMotion((first.pose[0] + x, first.pose[1] + y, first.pose[2] + phi), approach=task.approach)
            looks.append(_stage_look(task.start, (yield from _observe(task, scatter))))
        model, unknowns, noise = start_model(task, looks)
        for planned in plan(task, model, unknowns, looks, noise):
            yield StageMotion(planned.pose, approach=task.approach)
            looks.append(_stage_look(task.start, (yield from _observe(task, scatter))))
        yield StageMotion(first.pose, approach=task.approach)
        calibration = solve(task, model, looks, scatter.noise or noise)
    except AlignmentError as error:
        yield LookReport("calibration", end=error.fault, words=str(error))
        raise
    yield LookReport("calibration", end="calibrated", noise=calibration.noise)
    return calibration


class _Scatter:
    """Scatter of the marks at rest, between the pictures of a look."""

    def __init__(self) -> None:
        self._squares: list[float] = []
        self._pictures = 1

    def add(self, pictures: Sequence[Observation]) -> None:
        """Add the pictures of a look."""
        self._pictures = len(pictures)
        for name in {name for each in pictures for name in each.marks}:
            seen = np.array([each.marks[name] for each in pictures if name in each.marks])
            if len(seen) > 1:
                self._squares.append(float(seen.var(axis=0, ddof=1).mean()))

    @property
    def noise(self) -> float:
        """Standard deviation of a look's u or v, the mean of its pictures [pixel]; 0 if each is of one picture."""
        return math.sqrt(float(np.median(self._squares)) / self._pictures) if self._squares else 0.0


def _observe(task: GeometryTask, scatter: _Scatter) -> Generator[AlignmentRequest, Observation, Observation]:
    pictures = yield from capture(task.looks)
    scatter.add(pictures)
    look = average(pictures)
    yield LookReport("calibration", look)
    return look


def _stage_look(start: Geometry, seen: Observation) -> StageLook:
    if seen.sliders is not None:
        return StageLook(seen.sliders, seen.pose, seen.marks)
    a, b, c = inverse(start, seen.pose).position.tolist()
    return StageLook((a, b, c), seen.pose, seen.marks)


def start_model(task: GeometryTask, looks: Sequence[StageLook]) -> tuple[StageModel, Floats, float]:
    """Return the model, its unknowns and the noise [pixel] by the looks at the first moves. Raises AlignmentError."""
    counts = Counter(name for look in looks for name in look.marks)
    names = sorted(name for name, count in counts.items() if count >= min(MIN_FIRST_LOOKS, len(looks)))
    if not names:
        raise AlignmentError(
            AlignmentFault.MISSING,
            f"no mark was found in {MIN_FIRST_LOOKS} of the first {len(looks)} looks; check light, focus and threshold",
        )
    looks = [look._replace(marks={name: look.marks[name] for name in names if name in look.marks}) for look in looks]
    views = {name: name for name in names} if task.views is None else dict(task.views)
    if unknown := [name for name in names if name not in views]:
        raise AlignmentError(
            AlignmentFault.MISSING, f"marks without a view: {', '.join(unknown)}; give each mark a view"
        )
    cameras = _first_calibration([CalibrationSample(look.pose, look.marks) for look in looks], views)
    middle = (task.field[0] / 2.0, task.field[1] / 2.0)
    started = {
        name: structs.replace(view, lens=task.lens, bend=(0.0, 0.0), centre=middle)
        for name, view in cameras.views.items()
    }
    places = {name: mark.place for name, mark in cameras.marks.items()}
    model = StageModel(task.start, _travel(task), started, places, views)
    return model, model.initial(), max(cameras.noise, 0.01)


def _first_calibration(samples: Sequence[CalibrationSample], views: Mapping[str, str]) -> CameraCalibration:
    """Return the calibration from as many of the samples as match each other. Raises AlignmentError."""
    failure: AlignmentError | None = None
    for left_out in range(MAX_LEFT_OUT + 1):
        fits: list[CameraCalibration] = []
        for out in itertools.combinations(range(len(samples)), left_out):
            try:
                fits.append(calibrate([each for n, each in enumerate(samples) if n not in out], views))
            except AlignmentError as error:
                failure = failure or error
        right = [
            fit for fit in fits if fit.noise <= _allowed_residual(samples) and len(fit.marks) == len(fits[0].marks)
        ]
        if right:
            return min(right, key=lambda fit: fit.noise)
    raise failure or AlignmentError(
        AlignmentFault.STILL,
        "the marks do not follow the first moves, of 1 mm and 1°; take a new picture at each look, and check the names "
        "of the marks",
    )


def _allowed_residual(samples: Sequence[CalibrationSample]) -> float:
    """Return the residual up to which the first looks count as correct [pixel]."""
    spreads = []
    for name in {name for sample in samples for name in sample.marks}:
        seen = np.array([sample.marks[name] for sample in samples if name in sample.marks])
        # Use the median, so that a single misplaced mark does not raise the limit.
        spreads.append(float(np.median(np.linalg.norm(seen - np.median(seen, axis=0), axis=1))))
    return max(MAX_START_RESIDUAL_PX, MAX_START_SHARE * max(spreads))


def _travel(task: GeometryTask) -> Floats:
    """Return poses all over the travel, (N, 3) [m, rad], within reach also with the approach."""
    room = task.room
    axes = []
    for low, high in zip(room.low, room.high, strict=True):
        middle, half = (low + high) / 2.0, TRAVEL_SHARE * (high - low) / 2.0
        axes.append(np.linspace(middle - half, middle + half, GRID))
    poses = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    # A slider may go a little beyond both ends on the way between two poses: by 0.2 mm for 5° at 60 mm.
    margin = -(1.0 - TRAVEL_SHARE) / 2.0 * float(np.ptp(np.atleast_2d(room.position), axis=1).min())
    within = room.holds(travels(task.start, poses), margin)
    if task.approach is not None:
        beyond = poses + task.approach
        inside = (beyond >= room.low).all(axis=1) & (beyond <= room.high).all(axis=1)
        within &= inside & room.holds(travels(task.start, beyond), margin)
    reached: Floats = poses[within]
    if not len(reached):
        raise AlignmentError(
            AlignmentFault.MOVES, "the limits and the approach leave no pose at which the stage can be observed"
        )
    return reached


def plan(
    task: GeometryTask, model: StageModel, unknowns: Floats, looks: Sequence[StageLook], noise: float
) -> list[StageLook]:
    """Return the poses to look at after the first moves, with the marks to be expected. Raises AlignmentError."""
    poses = _travel(task)
    fields = dict.fromkeys(model.views, task.field)
    candidates = find_candidates(model, unknowns, poses, inverse(task.start, poses).position, fields)
    if not candidates:
        raise AlignmentError(
            AlignmentFault.MOVES,
            "no mark stays in its picture anywhere in the travel; check the field, (columns, rows) of the pictures",
        )
    known = [look._replace(marks={n: u for n, u in look.marks.items() if n in model.places}) for look in looks]
    return choose_poses(model, unknowns, known, candidates, max(0, task.poses - len(looks)), noise)


def solve(
    task: GeometryTask, model: StageModel, looks: Sequence[StageLook], picture_noise: float
) -> GeometryCalibration:
    """Return the calibration by looks; `picture_noise` is that of a mark at rest [pixel]. Raises AlignmentError."""
    known = tuple(look._replace(marks={n: u for n, u in look.marks.items() if n in model.places}) for look in looks)
    fit = fit_stage(model, known)
    state, geometry = model.state(fit.unknowns), model.geometry(fit.unknowns)
    deviations = model.doubts * np.sqrt(
        np.einsum("ij,jk,ik->i", model.basis, fit.covariance[: model.legs, : model.legs], model.basis)
    )
    names = [f"{leg} {name}" for leg, name in model.parameters]
    values = np.column_stack([state.corrections, state.scales]).ravel()
    unknown = _undetermined(model, fit)
    deviations[[names.index(name) for name in unknown]] = math.inf
    a, b, c = state.scales.tolist()
    is_systematic = fit.noise > SYSTEMATIC * picture_noise
    used = _used(known, fit)
    return GeometryCalibration(
        geometry,
        (a, b, c),
        dict(zip(names, values.tolist(), strict=True)),
        dict(zip(names, deviations.tolist(), strict=True)),
        unknown,
        _held_out(model, known, fit),
        fit.noise,
        picture_noise,
        calibrated_cameras(model, fit, known, task.looks),
        _outliers(fit, known),
        known,
        fit_residual_map(geometry, task.room, state, model.view_of, used) if is_systematic else None,
    )


def _undetermined(model: StageModel, fit: StageFit) -> tuple[str, ...]:
    """Return the names of parameters in combinations that these looks do not determine, or no looks can."""
    rest = np.eye(model.legs) - fit.determined @ fit.determined.T
    combinations = model.basis @ rest @ model.basis.T + model.held.T @ model.held
    shares = np.sqrt(np.maximum(np.diag(combinations), 0.0))
    names = [f"{leg} {name}" for leg, name in model.parameters]
    return tuple(name for name, share in zip(names, shares.tolist(), strict=True) if share > MIN_NAMED_SHARE)


def _used(looks: Sequence[StageLook], fit: StageFit) -> list[StageLook]:
    """Return the looks with outliers removed."""
    used = {each for each, is_used in zip(list_marks(looks), fit.used.tolist(), strict=True) if is_used}
    return [
        look._replace(marks={name: pixel for name, pixel in look.marks.items() if (number, name) in used})
        for number, look in enumerate(looks)
    ]


def _held_out(model: StageModel, looks: Sequence[StageLook], fit: StageFit) -> HeldOutResidual:
    """Return the residuals of every fifth look by fits to the others, with the configured geometry and without."""
    used = _used(looks, fit)
    first = len(DEFAULT_MOVES) + 1
    out = [look for number, look in enumerate(used) if number >= first and (number - first) % HELD_OUT == 2]
    rest = [look for number, look in enumerate(used) if number < first or (number - first) % HELD_OUT != 2]
    out = [look for look in out if look.marks]
    if not out:
        return HeldOutResidual(0, math.nan, math.nan, math.nan, math.nan)
    views = {name: model.views[model.view_of[name]].scale for name in model.places}
    scales = np.array([views[name] for _, name in list_marks(out)])
    errors = []
    for fixed in (True, False):
        try:
            trial = fit_stage(model, rest, fit.unknowns if not fixed else None, fixed_legs=fixed)
        except AlignmentError:  # too few looks remain
            return HeldOutResidual(0, math.nan, math.nan, math.nan, math.nan)
        distance = np.linalg.norm(model.residuals(trial.unknowns, out), axis=1)
        errors += [math.sqrt(np.mean(distance**2)), math.sqrt(np.mean((distance / scales) ** 2))]
    return HeldOutResidual(len(out), errors[0], errors[2], errors[1], errors[3])


def _outliers(fit: StageFit, looks: Sequence[StageLook]) -> tuple[Outlier, ...]:
    marks = list_marks(looks)
    computed = {
        each: np.array(looks[each[0]].marks[each[1]]) - residual
        for each, residual in zip(marks, fit.residuals, strict=True)
    }
    outliers = []
    for (number, name), residual, used in zip(marks, fit.residuals, fit.used.tolist(), strict=True):
        if used:
            continue
        seen, distance = np.array(looks[number].marks[name]), float(np.linalg.norm(residual))
        others = [
            other
            for look, other in marks
            if look == number and other != name and np.linalg.norm(seen - computed[look, other]) < 0.01 * distance
        ]
        outliers.append(Outlier(number + 1, name, distance, others[0] if others else None))
    return tuple(outliers)


def calibrated_cameras(
    model: StageModel, fit: StageFit, looks: Sequence[StageLook], pictures: int
) -> CameraCalibration:
    """Return cameras and marks in the form that trirail.alignment.procedure.align takes."""
    state, poses = model.state(fit.unknowns), model.poses(fit.unknowns, looks)
    marks, covariances = {}, {}
    every = np.arange(model.size)
    for view in state.views:
        shown = [name for name in model.places if model.view_of[name] == view]
        numbers = [every[model.view_unknowns(view)], *(every[model.mark_unknowns(name)] for name in shown)]
        covariances[view] = tuple(map(tuple, fit.covariance[np.ix_(*[np.concatenate(numbers)] * 2)].tolist()))
        for name in shown:
            x, y = np.sqrt(np.diag(fit.covariance)[model.mark_unknowns(name)]).tolist()
            marks[name] = MarkFit(view, state.places[name], (x, y))
    residuals: list[dict[str, Pair]] = [{} for _ in looks]
    for (number, name), residual, used in zip(
        list_marks(looks), fit.residuals.tolist(), fit.used.tolist(), strict=True
    ):
        if used:
            residuals[number][name] = (residual[0], residual[1])
    at = tuple((x, y, phi) for x, y, phi in poses.tolist())
    return CameraCalibration(dict(state.views), marks, fit.noise, tuple(residuals), at, covariances, looks=pictures)
