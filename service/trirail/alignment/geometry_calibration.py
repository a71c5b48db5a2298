"""Calibration of the geometry of a stage with the cameras that are used for alignment.

The procedure is a generator like those in trirail.alignment.procedure. It first looks at a few poses near the current
pose, and estimates the cameras and the positions of the marks. It then plans poses over the whole travel, looks at
these poses, and fits geometry, encoder scales, cameras and marks to all looks.
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
from trirail.alignment.calibration_procedure import DEFAULT_MOVES, PLATFORM_CENTRE, ZERO_OFFSET, plain_approach
from trirail.alignment.camera_calibration import (
    CalibrationSample,
    CameraCalibration,
    MarkFit,
    fit_cameras,
    separate_noises,
)
from trirail.alignment.fresh_pictures import average, capture
from trirail.alignment.images import Lens, Pair
from trirail.alignment.misalignment import SAME_PLACE_M
from trirail.alignment.pose_plan import choose_poses, find_candidates
from trirail.alignment.residual_map import ResidualMap, fit_residual_map
from trirail.alignment.rigid_motion import Floats
from trirail.alignment.stage_fit import StageFit, camera_covariance, fit_stage
from trirail.alignment.stage_model import StageLook, StageModel, list_marks, mark_displacements
from trirail.errors import AlignmentError, AlignmentFault, RefusalCode, RefusedError
from trirail.kinematics.geometry import Geometry, Room, travels
from trirail.kinematics.robot import inverse

DEFAULT_POSES, MIN_POSES = 30, 12
GRID = 7
"""Number of values of x, of y and of phi in the grid from which poses are chosen."""
TRAVEL_SHARE = 0.97
"""Fraction of the travel that is used. The margin is necessary because the configured geometry may be slightly
wrong."""
HELD_OUT = 5
"""One of this number of planned looks is excluded from a test fit, to check the predictions of the fit."""
MIN_FIRST_LOOKS = 5
"""Least number of the first seven looks in which a mark must be visible. Other marks are not used."""
MAX_LEFT_OUT = 2
"""Greatest number of the first looks that may be wrong."""
MAX_START_RESIDUAL_PX, MAX_START_SHARE = 1.0, 0.01
"""Greatest residual of correct first looks: in pixels, and as a fraction of the travel of a mark. The higher limit
applies."""
MAX_NOISE_PX, MAX_NOISE_SHARE = 1.0, 1e-3
"""Greatest residual of correct looks: in pixels, and as a fraction of the travel of a mark. The higher one applies. In
simulations, errors of 24 µm that no geometry explains, or a wrong model of the lens, cause a fraction of at most
0.45e-3. Late pictures or exchanged names cause a fraction of at least 2.7e-3."""
MAX_SWAPPED_SHARE = 0.1
"""Greatest fraction of looks in which names of marks may be exchanged. With more, either names could be the wrong
ones."""
SYSTEMATIC = 1.5
"""Ratio of residuals to picture noise above which the looks have systematic errors."""
SIGNIFICANT, SIGNIFICANT_IF_SYSTEMATIC = 2.5, 4.0
"""Ratio of a correction to its standard deviation, as displacements of the marks, above which the correction makes the
stage better. The noise makes it worse by one standard deviation. Systematic errors also resemble corrections, and the
standard deviation does not include this."""
MIN_NAMED_SHARE = 0.3
"""Least weight of a parameter in an undetermined combination at which the parameter is named. The parameters are
divided by StageModel.doubts."""


class HeldOutResidual(NamedTuple):
    """Root mean square distance of marks from their computed positions, in looks that were excluded from the fit."""

    looks: int
    """Number of excluded looks."""
    before: float
    """Distance with the configured geometry, to which only cameras and marks were fitted [pixel]."""
    after: float
    """Distance with the calibrated geometry [pixel]."""
    before_m: float
    """Distance `before`, converted to a distance on the table [m]."""
    after_m: float
    """Distance `after`, converted to a distance on the table [m]."""


class Outlier(NamedTuple):
    """Observation of a mark at a position that does not fit the other observations. The fit does not use it."""

    look: int
    """Number of the look, counted from 1."""
    mark: str
    distance: float
    """Distance of the observed pixel from the computed pixel [pixel]."""
    swapped_with: str | None
    """Name of another mark that should have been seen at this pixel; None if there is no such mark."""


class GeometryCalibration(NamedTuple):
    """Result of a calibration: corrections to the configured geometry, and the cameras."""

    geometry: Geometry
    """Calibrated geometry; the configured one if the corrections are not significant."""
    scales: Triple
    """Real position of each slider per metre of its reading, minus 1. Divide counts_per_metre by 1 plus this value, and
    multiply offset by it."""
    parameters: dict[str, float]
    """Corrections to the configured values [m, rad, 1], with names such as "A rail_angle"."""
    deviations: dict[str, float]
    """Standard deviations of the corrections in `parameters`; infinite for undetermined parameters."""
    undetermined: tuple[str, ...]
    """Names of the parameters that the looks do not determine, or determine only in combination with other parameters.
    Undetermined combinations of parameters keep their configured values."""
    residual: HeldOutResidual
    noise: float
    """Standard deviation of the u or v of a mark, computed from the residuals [pixel]."""
    picture_noise: float
    """Standard deviation of the u or v of a mark while the stage is at rest [pixel]. If `noise` is greater, the stage
    has errors that no geometry explains."""
    cameras: CameraCalibration
    """Cameras and marks in the frames of the calibrated geometry."""
    outliers: tuple[Outlier, ...]
    looks: tuple[StageLook, ...]
    map: ResidualMap | None
    """Map of the errors that remain after the fit; None if the errors are not systematic, or there are too few
    looks."""
    change: float
    """Displacement of the marks by the correction, root mean square over the travel [m]."""
    change_deviation: float
    """Standard deviation of `change` [m]."""

    @property
    def is_systematic(self) -> bool:
        """True if the residuals clearly exceed the picture noise, which shows errors that no geometry explains."""
        return self.noise > SYSTEMATIC * self.picture_noise

    @property
    def is_significant(self) -> bool:
        """True if the correction is clearly greater than its uncertainty.

        Otherwise, the configured geometry is as good as can be measured, and the correction could make it worse.
        """
        limit = SIGNIFICANT_IF_SYSTEMATIC if self.is_systematic else SIGNIFICANT
        return self.change > limit * self.change_deviation


class GeometryTask(NamedTuple):
    """Arguments of a calibration of the geometry."""

    start: Geometry
    """Configured geometry, without a correction map."""
    room: Room
    """Limits of platform and sliders."""
    field: Pair
    """Numbers of columns and rows of the pictures."""
    views: Mapping[str, str] | None = None
    """Name of the view of each mark; if None, each mark has a separate view."""
    lens: Lens = "radial"
    poses: int = DEFAULT_POSES
    looks: int = 4
    """Number of pictures that are averaged at each pose."""
    approach: Triple | None = None
    """Offset from which every motion arrives, as in StageMotion."""

    def check(self) -> None:
        """Raise RefusedError for the first invalid argument, with the value and the permitted range."""
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
    """Look at planned poses, move back to the first pose, and return the calibration.

    Raises
    ------
    RefusedError
        An argument is invalid.
    AlignmentError
        The looks do not determine cameras and marks, or no geometry explains the looks.
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
    """Estimator of the noise of marks, from the differences between the pictures of each look."""

    def __init__(self) -> None:
        self._variances: dict[str, list[float]] = {}
        self._pictures = 1

    def add(self, pictures: Sequence[Observation]) -> None:
        """Add the pictures of a look."""
        self._pictures = len(pictures)
        for name in {name for each in pictures for name in each.marks}:
            seen = np.array([each.marks[name] for each in pictures if name in each.marks])
            if len(seen) > 1:
                variance = float(seen.var(axis=0, ddof=1).mean())
                self._variances.setdefault(name, []).append(variance / _median_share(2 * (len(seen) - 1)))

    @property
    def noise(self) -> float:
        """Standard deviation of the u or v of a mark in a look [pixel]; 0 if each look consists of one picture."""
        # A mistaken mark in some pictures does not change a median. The cameras of the marks may differ in noise.
        medians = [np.median(variances) for variances in self._variances.values()]
        return math.sqrt(float(np.mean(medians)) / self._pictures) if medians else 0.0


def _median_share(freedom: int) -> float:
    """Return the median of a sample variance, divided by its mean, for normal noise and given degrees of freedom."""
    from scipy.special import gammaincinv  # type: ignore[import-untyped]

    # The variance has the chi-squared distribution, which is a gamma distribution: the median for freedom 2 is log 2.
    return float(gammaincinv(freedom / 2.0, 0.5) / (freedom / 2.0))


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
    """Return a model, first estimates of its unknowns, and the noise [pixel], from the first looks.

    Raises AlignmentError if the looks do not determine cameras and marks.
    """
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
    for (one, mark), (other, beside) in itertools.combinations(cameras.marks.items(), 2):
        if math.dist(mark.place, beside.place) < SAME_PLACE_M:
            raise AlignmentError(
                AlignmentFault.MISSING,
                f"marks {one} and {other} are at the same place; check that each name has its own mark",
            )
    middle = (task.field[0] / 2.0, task.field[1] / 2.0)
    started = {
        name: structs.replace(view, lens=task.lens, bend=(0.0, 0.0), centre=middle)
        for name, view in cameras.views.items()
    }
    places = {name: mark.place for name, mark in cameras.marks.items()}
    model = StageModel(task.start, _travel(task), started, places, views)
    return model, model.initial(), max(cameras.noise, 0.01)


def _first_calibration(samples: Sequence[CalibrationSample], views: Mapping[str, str]) -> CameraCalibration:
    """Return the calibration from the largest number of samples that match each other.

    Up to MAX_LEFT_OUT samples are excluded. Raises AlignmentError if more samples are wrong.
    """
    failure: AlignmentError | None = None
    for left_out in range(MAX_LEFT_OUT + 1):
        fits: list[CameraCalibration] = []
        for out in itertools.combinations(range(len(samples)), left_out):
            try:
                fits.append(fit_cameras([each for n, each in enumerate(samples) if n not in out], views))
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
    """Return the greatest residual of correct first looks [pixel]."""
    spreads = []
    for name in {name for sample in samples for name in sample.marks}:
        seen = np.array([sample.marks[name] for sample in samples if name in sample.marks])
        # The median is used because a single wrong pixel must not raise the limit.
        spreads.append(float(np.median(np.linalg.norm(seen - np.median(seen, axis=0), axis=1))))
    return max(MAX_START_RESIDUAL_PX, MAX_START_SHARE * max(spreads))


def _travel(task: GeometryTask) -> Floats:
    """Return poses on a grid over the whole travel, (N, 3) [m, rad].

    The intermediate poses of the approach are also within the limits.
    """
    room = task.room
    axes = []
    for low, high in zip(room.low, room.high, strict=True):
        middle, half = (low + high) / 2.0, TRAVEL_SHARE * (high - low) / 2.0
        axes.append(np.linspace(middle - half, middle + half, GRID))
    poses = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    # On the way between two poses, a slider may move slightly farther than at either pose: 0.2 mm for 5° at 60 mm.
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
    """Return the poses at which to look after the first moves, each with the marks that should be visible.

    Raises AlignmentError if there is no pose at which a mark is visible.
    """
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
    """Compute the calibration from all looks. Raises AlignmentError if no geometry explains the looks.

    `picture_noise` is the standard deviation of the u or v of a mark at rest [pixel].
    """
    known = tuple(look._replace(marks={n: u for n, u in look.marks.items() if n in model.places}) for look in looks)
    fit = fit_stage(model, known)
    _check_noise(fit, known)
    outliers = _outliers(fit, known)
    swapped = sorted({each.look for each in outliers if each.swapped_with})
    if len(swapped) > MAX_SWAPPED_SHARE * len(known):
        raise AlignmentError(
            AlignmentFault.SWAPPED,
            f"the names of marks are exchanged in looks {', '.join(map(str, swapped))}, compared with the other looks; "
            "calibrate again, and use coded marks if this happens repeatedly",
        )
    state, geometry = model.state(fit.unknowns), model.geometry(fit.unknowns)
    covariance = fit.covariance[: model.legs, : model.legs]
    variances = np.einsum("ij,jk,ik->i", model.basis, covariance, model.basis)
    deviations = model.doubts * np.sqrt(np.maximum(variances, 0.0))  # rounding can make a zero negative
    names = [f"{leg} {name}" for leg, name in model.parameters]
    values = np.column_stack([state.corrections, state.scales]).ravel()
    unknown = _undetermined(model, fit)
    deviations[[names.index(name) for name in unknown]] = math.inf
    a, b, c = state.scales.tolist()
    is_systematic = fit.noise > SYSTEMATIC * picture_noise
    used = _used(known, fit)
    calibration = GeometryCalibration(
        geometry,
        (a, b, c),
        dict(zip(names, values.tolist(), strict=True)),
        dict(zip(names, deviations.tolist(), strict=True)),
        unknown,
        _held_out(model, known, fit),
        fit.noise,
        picture_noise,
        structs.replace(calibrated_cameras(model, fit, known, task.looks), approach=plain_approach(task.approach)),
        outliers,
        known,
        fit_residual_map(geometry, task.room, state, model.view_of, used) if is_systematic else None,
        *_change(model, fit, _travel(task)),
    )
    return calibration if calibration.is_significant else _with_configured_legs(calibration, task, model, used)


def _with_configured_legs(
    calibration: GeometryCalibration, task: GeometryTask, model: StageModel, looks: Sequence[StageLook]
) -> GeometryCalibration:
    """Return a calibration of the cameras, and a map, for the configured geometry; the parameters are those found."""
    fit = fit_stage(model, looks, fixed_legs=True)
    state, geometry = model.state(fit.unknowns), model.geometry(fit.unknowns)
    cameras = calibrated_cameras(model, fit, looks, task.looks)
    a, b, c = state.scales.tolist()
    return calibration._replace(
        geometry=geometry,
        scales=(a, b, c),
        cameras=structs.replace(cameras, approach=plain_approach(task.approach)),
        map=fit_residual_map(geometry, task.room, state, model.view_of, looks) if calibration.is_systematic else None,
    )


def _change(model: StageModel, fit: StageFit, poses: Floats) -> tuple[float, float]:
    """Return the root mean square displacement of the marks by the correction, and its standard deviation [m]."""
    moved, legs = mark_displacements(model, poses), model.legs
    known = moved @ fit.determined
    covariance = fit.determined.T @ fit.covariance[:legs, :legs] @ fit.determined
    places = len(moved) / 2
    variance = max(float(np.einsum("ij,jk,ik->", known, covariance, known)), 0.0)
    return math.sqrt(float(((moved @ fit.unknowns[:legs]) ** 2).sum()) / places), math.sqrt(variance / places)


def _check_noise(fit: StageFit, looks: Sequence[StageLook]) -> None:
    """Raise AlignmentError if the marks are farther from their computed pixels than on any real stage.

    The fit finds outliers by comparing the looks with each other, so that it cannot tell if most of them are wrong.
    """
    tracks: dict[str, list[Floats]] = {}
    for (number, name), residual in zip(list_marks(looks), fit.residuals, strict=True):
        tracks.setdefault(name, []).append(looks[number].marks[name] - residual)
    travel = max(float(np.ptp(track, axis=0).max()) for track in tracks.values())
    limit = max(MAX_NOISE_PX, MAX_NOISE_SHARE * travel)
    if fit.noise > limit:
        raise AlignmentError(
            AlignmentFault.STILL,
            f"the marks do not follow the stage: the residual is {fit.noise:.1f} pixels, the limit {limit:.1f}, and "
            "0.05 to 0.3 are usual; check that each look takes new pictures, with --wait if the camera is late, and "
            "that no cameras or names of marks are exchanged",
            value=fit.noise,
            limit=limit,
        )


def _undetermined(model: StageModel, fit: StageFit) -> tuple[str, ...]:
    """Return the names of the parameters in combinations that these looks, or any looks, do not determine."""
    rest = np.eye(model.legs) - fit.determined @ fit.determined.T
    combinations = model.basis @ rest @ model.basis.T + model.held.T @ model.held
    shares = np.sqrt(np.maximum(np.diag(combinations), 0.0))
    names = [f"{leg} {name}" for leg, name in model.parameters]
    return tuple(name for name, share in zip(names, shares.tolist(), strict=True) if share > MIN_NAMED_SHARE)


def _used(looks: Sequence[StageLook], fit: StageFit) -> list[StageLook]:
    """Return the looks without the outliers."""
    used = {each for each, is_used in zip(list_marks(looks), fit.used.tolist(), strict=True) if is_used}
    return [
        look._replace(marks={name: pixel for name, pixel in look.marks.items() if (number, name) in used})
        for number, look in enumerate(looks)
    ]


def _held_out(model: StageModel, looks: Sequence[StageLook], fit: StageFit) -> HeldOutResidual:
    """Return the residuals in every fifth planned look, for two fits to the other looks.

    One fit keeps the configured geometry, and the other fit calibrates the geometry.
    """
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
    """Return cameras and marks in the form that trirail.alignment.procedure.align needs.

    Their deviations are those for known legs, because a later calibration has the same legs.
    """
    state, poses = model.state(fit.unknowns), model.poses(fit.unknowns, looks)
    marks, covariances = {}, {}
    every, covariance = np.arange(model.size), camera_covariance(model, looks, fit)
    for view in state.views:
        shown = [name for name in model.places if model.view_of[name] == view]
        numbers = [every[model.view_unknowns(view)], *(every[model.mark_unknowns(name)] for name in shown)]
        covariances[view] = tuple(map(tuple, covariance[np.ix_(*[np.concatenate(numbers)] * 2)].tolist()))
        for name in shown:
            x, y = np.sqrt(np.diag(covariance)[model.mark_unknowns(name)]).tolist()
            marks[name] = MarkFit(view, state.places[name], (x, y))
    residuals: list[dict[str, Pair]] = [{} for _ in looks]
    for (number, name), residual, used in zip(
        list_marks(looks), fit.residuals.tolist(), fit.used.tolist(), strict=True
    ):
        if used:
            residuals[number][name] = (residual[0], residual[1])
    at = tuple((x, y, phi) for x, y, phi in poses.tolist())
    return separate_noises(
        CameraCalibration(dict(state.views), marks, fit.noise, tuple(residuals), at, covariances, looks=pictures)
    )
