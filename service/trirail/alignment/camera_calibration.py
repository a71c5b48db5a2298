"""Calibration of cameras by moves of the stage: the map of each view, and the positions of the marks on the platform.

If the platform is at the pose (t, phi), a mark at q on the platform is at w = t + R(phi) q in the base frame. The
unknowns of a view are its map and the positions q of its marks. Rotations of the stage determine q, and translations
determine the map. For small phi, the problem is linear in b, M and M q. The solution of the linear problem is the
initial value of a Gauss-Newton iteration.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec import structs
from trirail_drivers.interface import Triple

from trirail.alignment.arguments import check_lens
from trirail.alignment.images import CameraView, Lens, Pair, Points, project_points, project_with
from trirail.alignment.rigid_motion import Floats, rotation_matrix
from trirail.errors import AlignmentError, AlignmentFault

Marks = Mapping[str, Pair]
"""Pixels (u, v) of marks under their names. Marks that were not found are missing."""
MAX_ITERATIONS = 30
STEP_TOLERANCE = 1e-12
MIN_TRAVEL_PX = 3.0
"""Travel of the marks over all moves below which the marks count as unmoved [pixel]."""
MAX_RESIDUAL_SHARE = 0.1
"""Residual of a view, as a fraction of the shortest move of a mark between two looks, above which the pictures do not
match the moves. If one picture is late by one move, the residual is at least 0.12 of this move, with a perspective or
radial lens, or 0.24, with an affine one."""
MAX_DISTORTION_SHARE = 0.02
"""Residual of a view, as a fraction of the travel of its marks over all looks, that is always accepted. Distortion by a
lens causes a residual of 0.01."""
SUSPICIOUS_NOISE_PX = 1.0
"""Noise above which marks may be swapped in a sample [pixel]. Marks are located with a noise of about 0.1 pixel."""
MAX_SWAP_NOISE_SHARE = 0.1
"""Two marks count as swapped if exchanging them reduces the noise to this fraction or less."""
MAX_SWAP_FITS = 12
"""Greatest number of swaps that are checked by a fit, in the order of their likelihood."""
MIN_TURN_SHARE = 0.01
"""Least share of the rotation of all looks over which a mark must have been found, so that its position is known."""
MAX_CONDITION = 1e6
"""Condition number of the scaled Jacobian above which the moves do not determine all unknowns."""
MAX_PLACE_DEVIATION_M = 5e-3
"""Standard deviation of the position of a mark relative to the centre of rotation above which the turns are too small
for the noise. An error of this size costs an alignment one or two more corrections. With the default moves and a noise
of 0.1 pixel, the standard deviation is 0.01 mm."""
MIN_FREEDOM = 4
"""Degrees of freedom below which a view gets the noise of all views instead of its own. By the chi-squared
distribution, an estimate from 3 is below half of the true noise in one of 7 cases, from 4 in one of 11, and from 6, as
with the default moves, in one of 24."""


class CalibrationSample(NamedTuple):
    """Pixels of the marks at one pose of the platform."""

    pose: tuple[float, float, float]
    """Measured pose x, y [m], phi [rad]."""
    marks: Marks


class MarkFit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Position of a mark on the part that was used for calibration, as determined by the fit."""

    view: str
    """Name of the view that shows the mark."""
    place: Pair
    """Position in the platform's frame, relative to the centre of the stage [m]."""
    deviation: Pair
    """Standard deviations of `place` [m]."""


class CameraCalibration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Result of a calibration of cameras. Calibration files have the same fields."""

    views: dict[str, CameraView]
    marks: dict[str, MarkFit]
    noise: float
    """Standard deviation of the u or v of a mark in a look, computed from the residuals of all views [pixel]."""
    residuals: tuple[dict[str, Pair], ...]
    """Observed minus computed pixels of the marks in each look."""
    poses: tuple[tuple[float, float, float], ...]
    """Pose of the platform at each look: x, y [m], phi [rad]."""
    covariances: dict[str, tuple[tuple[float, ...], ...]]
    """Covariance of the unknowns of each view: b [pixel], M by rows [pixel/m], distortion of the lens, and positions of
    the marks [m]."""
    confirmed: bool = False
    """True if a correction with this calibration has had the predicted effect. Otherwise, corrections are limited."""
    looks: int = 1
    """Number of pictures that were averaged in each look. `noise` is the noise of the average."""
    approach: Triple | None = None
    """Offset x, y [m], phi [rad] from which each motion arrived, as in StageMotion; None if the motions were direct, or
    if an earlier version wrote the file without it."""
    noises: dict[str, float] = {}
    """Noise of each view, like `noise` [pixel]. Cameras differ in focus, light and magnification. Views that are
    missing have the common `noise`."""

    def noise_of(self, view: str) -> float:
        """Return the standard deviation of the u or v of a mark of a view in a look [pixel]."""
        return self.noises.get(view, self.noise)

    @property
    def reach(self) -> float:
        """Greatest distance that a mark was moved from its position at the first look [m]."""
        return max(
            float(np.linalg.norm(to_base_frame(mark.place, pose) - to_base_frame(mark.place, self.poses[0])))
            for mark in self.marks.values()
            for pose in self.poses
        )


def to_base_frame(place: Pair, pose: Sequence[float]) -> Floats:
    """Return the position in the base frame, (2,) [m], of the point `place` of a platform at a pose."""
    return np.asarray(pose[:2] + rotation_matrix(pose[2]) @ place)


def calibrate(
    samples: Sequence[CalibrationSample],
    views: Mapping[str, str] | None = None,
    lens: Lens = "affine",
    centre: Pair | Mapping[str, Pair] | None = None,
    looks: int = 1,
) -> CameraCalibration:
    """Compute the calibration from the marks that were observed at several poses.

    Parameters
    ----------
    samples
        Pixels of the marks at the poses.
    views
        Name of the view of each mark. Marks with the same view are seen by the same fixed camera. If None, every mark
        has a separate view. This is the case for two cameras, or for a camera that is moved from mark to mark.
    lens
        Kind of the lens of all views.
    centre
        Pixel on the axis of a radial lens, for all views or for each view by its name. Other lenses do not use it.
    looks
        Number of pictures that were averaged in each sample.

    Raises
    ------
    AlignmentError
        There are too few samples, the marks do not follow the moves, the moves do not determine all unknowns, or two
        marks are swapped in one sample.
    RefusedError
        The lens is unknown, or it is radial and there is no centre.
    """
    check_lens(lens, centre)
    failure, noise = None, math.inf
    try:
        calibration = fit_cameras(samples, views, lens, centre, looks)
        noise = calibration.noise
    except AlignmentError as error:
        failure = error
    if noise > SUSPICIOUS_NOISE_PX:
        # Few moves leave little redundancy, so the fit can absorb most of a swap. Only a fit without the swap shows it.
        for number, one, other in _likely_swaps(samples, views):
            exchanged = [*samples]
            marks = samples[number].marks
            exchanged[number] = samples[number]._replace(marks={**marks, one: marks[other], other: marks[one]})
            try:
                after = fit_cameras(exchanged, views, lens, centre, looks).noise
            except AlignmentError:
                continue
            if after <= min(SUSPICIOUS_NOISE_PX, MAX_SWAP_NOISE_SHARE * noise):
                raise AlignmentError(
                    AlignmentFault.SWAPPED,
                    f"look {number + 1}: marks {one} and {other} are swapped; calibrate again, and use coded marks if "
                    "this happens repeatedly",
                ) from failure
    if failure is not None:
        raise failure
    return calibration


def _likely_swaps(samples: Sequence[CalibrationSample], views: Mapping[str, str] | None) -> list[tuple[int, str, str]]:
    """Return the MAX_SWAP_FITS most likely swaps: the index of a sample and the names of two of its marks.

    A fit to every pair of marks in every sample would take half a minute for 20 marks. The linear model of the pixels
    ranks them: in it, the sum of squared residuals after a swap follows from the residuals before.
    """
    rows = [(number, name) for number, sample in enumerate(samples) for name in sorted(sample.marks)]
    if not rows:
        return []
    seen = np.array([samples[number].marks[name] for number, name in rows]).reshape(-1, 2)
    design = _linear_design(samples, rows, views)
    scaled = design / np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    left, values, _ = np.linalg.svd(scaled, full_matrices=False)
    left = left[:, values > 1e-9 * values[0]]
    free = np.eye(len(rows)) - left @ left.T  # residuals of any pixels
    residuals = free @ seen
    swaps = []
    for _, group in itertools.groupby(range(len(rows)), lambda row: rows[row][0]):
        for a, b in itertools.combinations(group, 2):
            apart = seen[b] - seen[a]
            change = 2.0 * apart @ (residuals[a] - residuals[b])
            change += apart @ apart * (free[a, a] + free[b, b] - 2.0 * free[a, b])
            swaps.append((float(change), (*rows[a], rows[b][1])))
    return [swap for _, swap in sorted(swaps)[:MAX_SWAP_FITS]]


def _linear_design(
    samples: Sequence[CalibrationSample], rows: Sequence[tuple[int, str]], views: Mapping[str, str] | None
) -> Floats:
    """Return the design matrix of the linear model of _ViewFit, for all views. Each row is a sample and a mark."""
    names = sorted({name for _, name in rows})
    view_of = [name if views is None else views.get(name, name) for name in names]
    shown = sorted(set(view_of))
    design = np.zeros((len(rows), 2 * len(shown) + 2 * len(names)))
    first = samples[0].pose
    for row, (number, name) in enumerate(rows):
        pose, mark = samples[number].pose, names.index(name)
        view, place = 2 * shown.index(view_of[mark]), 2 * len(shown) + 2 * mark
        design[row, view : view + 2] = np.subtract(pose[:2], first[:2])
        design[row, place : place + 2] = 1.0, math.sin(pose[2] - first[2])
    return design


def fit_cameras(
    samples: Sequence[CalibrationSample],
    views: Mapping[str, str] | None = None,
    lens: Lens = "affine",
    centre: Pair | Mapping[str, Pair] | None = None,
    looks: int = 1,
) -> CameraCalibration:
    """Fit the calibration to the marks, and do not look for swapped marks. Parameters are those of `calibrate`."""
    centre = (0.0, 0.0) if centre is None else centre
    names = sorted({name for sample in samples for name in sample.marks})
    view_of = dict(views) if views is not None else {name: name for name in names}
    if unknown := [name for name in names if name not in view_of]:
        raise AlignmentError(
            AlignmentFault.MISSING, f"marks without a view: {', '.join(unknown)}; give each mark a view"
        )
    if isinstance(centre, Mapping) and (without := sorted({view_of[name] for name in names} - set(centre))):
        raise AlignmentError(
            AlignmentFault.MISSING, f"views without a centre: {', '.join(without)}; give each view its centre"
        )
    if len(names) < 1:
        raise AlignmentError(AlignmentFault.MISSING, "no mark was found in any look; check light, focus and threshold")
    fits = {
        view: _ViewFit(
            samples,
            [name for name in names if view_of[name] == view],
            CameraView(
                (0, 0),
                (0, 0),
                ((1, 0), (0, 1)),
                lens,
                centre=centre[view] if isinstance(centre, Mapping) else centre,
            ),
            view,
        )
        for view in sorted({view_of[name] for name in names})
    }
    squares = sum(fit.squares for fit in fits.values())
    freedom = sum(fit.freedom for fit in fits.values())
    noise = float(np.sqrt(squares / freedom))
    marks, covariances = {}, {}
    for name, fit in fits.items():
        covariance = fit.inverse * noise**2
        covariances[name] = tuple(map(tuple, covariance.tolist()))
        deviations = np.sqrt(np.diag(covariance))[fit.first_place :].reshape(-1, 2)
        for mark, place, deviation in zip(fit.names, fit.places, deviations, strict=True):
            marks[mark] = MarkFit(name, _pair(place), _pair(deviation))
    fitted = {name: fit.view for name, fit in fits.items()}
    residuals = tuple(
        {
            name: _pair(
                seen - project_points(fitted[view_of[name]], to_base_frame(marks[name].place, sample.pose)[None])[0]
            )
            for name, seen in sample.marks.items()
        }
        for sample in samples
    )
    poses = tuple((float(x), float(y), float(phi)) for (x, y, phi), _ in samples)
    calibration = separate_noises(CameraCalibration(fitted, marks, noise, residuals, poses, covariances, looks=looks))
    for name, mark_fit in calibration.marks.items():
        uncertainty = max(mark_fit.deviation)
        if uncertainty > MAX_PLACE_DEVIATION_M:
            raise AlignmentError(
                AlignmentFault.MOVES,
                f"mark {name}: its distance from the centre of rotation is uncertain by {uncertainty * 1e3:.3g} mm, "
                f"the limit is {MAX_PLACE_DEVIATION_M * 1e3:.0f} mm; turn farther, or average more pictures",
                value=uncertainty,
                limit=MAX_PLACE_DEVIATION_M,
            )
    return calibration


def check_moves(
    poses: Sequence[Triple],
    marks: Sequence[str],
    views: Mapping[str, str] | None,
    lens: Lens,
    centre: Pair | Mapping[str, Pair] | None = None,
) -> None:
    """Check that looks at poses [m, rad] determine the maps, if every look shows all marks without noise.

    Raises AlignmentError if they do not.
    """
    # An ideal camera above each mark needs no more looks than any other. At this scale, no move is too short for it.
    place = (0.05, 0.0)
    x, y = to_base_frame(place, poses[0]).tolist()
    ideal = CameraView((x, y), (0.0, 0.0), ((1e9, 0.0), (0.0, 1e9)), lens)
    pixels = project_points(ideal, np.array([to_base_frame(place, pose) for pose in poses]))
    samples = [
        CalibrationSample(pose, dict.fromkeys(marks, _pair(pixel))) for pose, pixel in zip(poses, pixels, strict=True)
    ]
    fit_cameras(samples, views, lens, centre)


def separate_noises(common: CameraCalibration) -> CameraCalibration:
    """Return a calibration with the noise of each view, and with its covariances and deviations scaled to this noise.

    In the calibration `common`, all of them follow from the common `noise`.
    """
    squares, freedom = {}, {}
    for view, covariance in common.covariances.items():
        shown = {name for name, mark in common.marks.items() if mark.view == view}
        seen = [pixel for look in common.residuals for name, pixel in look.items() if name in shown]
        squares[view] = math.fsum(u * u + v * v for u, v in seen)
        freedom[view] = 2 * len(seen) - len(covariance)
    total = sum(squares.values())
    shares = {  # noise of each view, divided by the common noise
        view: math.sqrt(squares[view] / freedom[view] * sum(freedom.values()) / total)
        for view in common.covariances
        if freedom[view] >= MIN_FREEDOM and total > 0.0
    }
    marks = {
        name: structs.replace(mark, deviation=_pair(np.multiply(mark.deviation, shares.get(mark.view, 1.0))))
        for name, mark in common.marks.items()
    }
    covariances = {
        view: tuple(tuple(each * shares.get(view, 1.0) ** 2 for each in row) for row in covariance)
        for view, covariance in common.covariances.items()
    }
    noises = {view: common.noise * shares.get(view, 1.0) for view in common.covariances}
    return structs.replace(common, marks=marks, covariances=covariances, noises=noises)


class _ViewFit:
    """Least-squares fit of the unknowns of one view: b, M by rows, distortion, and the position of each mark.

    The point o of the map is the position of the first mark at its first look.
    """

    def __init__(self, samples: Sequence[CalibrationSample], names: Sequence[str], lens: CameraView, view: str) -> None:
        self.names, self._lens, self._name = names, lens, view
        self._poses = np.array([sample.pose for sample in samples])
        looks = {name: [n for n, each in enumerate(samples, 1) if name not in each.marks] for name in names}
        self._hidden = {name: missing for name, missing in looks.items() if missing}
        bends = {"affine": 0, "perspective": 2, "radial": 1}[lens.lens]
        self.first_place = 6 + bends
        rows = [
            (names.index(name), sample.pose, seen)
            for sample in samples
            for name, seen in sample.marks.items()
            if name in names
        ]
        self._mark_index = np.array([index for index, _, _ in rows])
        poses = np.array([pose for _, pose, _ in rows])
        self._t, self._phi = poses[:, :2], poses[:, 2]
        self._seen = np.array([seen for _, _, seen in rows], float)
        self._first = poses[0]
        self.freedom = self._seen.size - self.first_place - 2 * len(names)
        self._check_samples()
        x, scales = self._initial_estimate(), self._scales()
        for _ in range(MAX_ITERATIONS):
            jacobian, residuals = self._jacobian(x) * scales, self._seen - self._project(x)
            step, _, _, singular = np.linalg.lstsq(jacobian, residuals.ravel(), rcond=None)
            if singular[-1] * MAX_CONDITION < singular[0]:
                self._refuse_moves()
            x = x + scales * step
            if np.abs(step).max() < STEP_TOLERANCE * max(1.0, np.abs(x / scales).max()):
                break
        self.squares = float(((self._seen - self._project(x)) ** 2).sum())
        self._check_residual(x)
        jacobian = self._jacobian(x) * scales
        self.inverse = np.linalg.inv(jacobian.T @ jacobian) * np.outer(scales, scales)
        self.places = x[self.first_place :].reshape(-1, 2)
        bend = np.append(x[6 : self.first_place], (0.0, 0.0))[:2]
        matrix = (_pair(x[2:4]), _pair(x[4:6]))
        origin = _pair(self._origin(self.places[0]))
        self.view = CameraView(origin, _pair(x[:2]), matrix, lens.lens, _pair(bend), lens.centre)

    def _check_samples(self) -> None:
        turn = np.ptp(self._poses[:, 2])
        for n, name in enumerate(self.names):
            if name in self._hidden and np.ptp(self._phi[self._mark_index == n]) < MIN_TURN_SHARE * turn:
                self._refuse_hidden([name])
        if self.freedom < 1:
            if self._hidden and len(self._poses) > 1 + self.first_place / (2 * len(self.names)):
                self._refuse_hidden([*self._hidden])
            needed = -(-(self.first_place + 2 * len(self.names) + 1) // (2 * len(self.names)))
            raise AlignmentError(
                AlignmentFault.MOVES,
                f"view {self._name}: {len(self._seen)} marks found over all looks, each mark needs {needed} looks; "
                "add moves",
            )
        spread = self._spread()
        if spread < MIN_TRAVEL_PX:
            raise AlignmentError(
                AlignmentFault.STILL,
                f"view {self._name}: the marks moved by {spread:.2f} pixels over all moves, at least "
                f"{MIN_TRAVEL_PX:.0f} are needed; check that the camera shows this stage, and take a new picture at "
                "each look",
                value=spread,
                limit=MIN_TRAVEL_PX,
            )

    def _check_residual(self, x: Floats) -> None:
        residual = math.sqrt(self.squares / self.freedom)
        computed, spread = self._project(x), self._spread()
        tracks = [computed[self._mark_index == n] for n in range(len(self.names))]
        moves = np.concatenate([np.linalg.norm(np.diff(track, axis=0), axis=1) for track in tracks])
        shortest = float(moves[moves >= MIN_TRAVEL_PX].min(initial=spread))
        limit = max(MAX_RESIDUAL_SHARE * shortest, MAX_DISTORTION_SHARE * spread)
        if residual > limit:
            raise AlignmentError(
                AlignmentFault.STILL,
                f"view {self._name}: the marks do not follow the moves; the residual is {residual:.1f} pixels, the "
                f"limit {limit:.1f} at moves of {shortest:.0f} or more; take a new picture at each look",
                value=residual,
                limit=limit,
            )

    def _spread(self) -> float:
        """Return the greatest travel of a mark over all looks [pixel]."""
        return max(float(np.ptp(self._seen[self._mark_index == n], axis=0).max()) for n in range(len(self.names)))

    def _refuse_hidden(self, names: Sequence[str]) -> None:
        """Refuse marks that were not found in all looks."""
        marks = "; ".join(
            f"mark {name} was not found in look {', '.join(map(str, self._hidden[name]))}" for name in names
        )
        raise AlignmentError(
            AlignmentFault.MISSING,
            f"view {self._name}: {marks}, and the other looks do not determine its position; keep it in the picture at "
            "every move, by smaller moves if necessary, or check light and focus",
        )

    def _refuse_moves(self) -> None:
        """Refuse the looks: because of hidden marks if the moves determine an affine map, else because of the moves."""
        x, y, phi = (self._poses - self._poses[0]).T
        design = np.stack([x, y, np.sin(phi), np.ones_like(x)], axis=1)
        scales = np.maximum(np.abs(design).max(axis=0), 1e-300)
        if self._hidden and np.linalg.matrix_rank(design / scales, tol=1e-6) == len(scales):
            self._refuse_hidden([*self._hidden])
        raise AlignmentError(
            AlignmentFault.MOVES,
            f"view {self._name}: the moves do not determine its map; move along x, along y and turn, each both ways",
        )

    def _origin(self, place: Points) -> Points:
        return np.asarray(self._first[:2] + rotation_matrix(self._first[2]) @ place)

    def _initial_estimate(self) -> Floats:
        """Return the solution of the linear model u = b_i + M (t - t0) + (sin phi - sin phi0) M J q_i."""
        n = len(self.names)
        design = np.zeros((len(self._seen), 2 + 2 * n))
        design[:, :2] = self._t - self._first[:2]
        design[np.arange(len(self._seen)), 2 + self._mark_index] = 1.0
        design[np.arange(len(self._seen)), 2 + n + self._mark_index] = np.sin(self._phi - self._first[2])
        scales = np.maximum(np.abs(design).max(axis=0), 1e-300)
        solution, _, rank, _ = np.linalg.lstsq(design / scales, self._seen, rcond=1e-9)
        solution = solution / scales[:, None]
        matrix = solution[:2].T
        if rank < design.shape[1] or abs(np.linalg.det(matrix)) < 1e-12 * (matrix**2).sum():
            self._refuse_moves()
        arms = np.linalg.solve(matrix, solution[2 + n :].T).T  # rows R(phi0) J q
        arms = arms @ np.array([[0.0, -1.0], [1.0, 0.0]])  # J' of each row
        places = arms @ rotation_matrix(self._first[2])
        return np.concatenate([solution[2], matrix.ravel(), np.zeros(self.first_place - 6), places.ravel()])

    def _scales(self) -> Floats:
        """Return a unit for each unknown. In these units, all unknowns have similar accuracy."""
        span = max(float(np.ptp(self._seen, axis=0).max()), 1.0)
        travel = max(float(np.ptp(self._t, axis=0).max()), 1e-9)
        turn = max(float(np.ptp(self._phi)), 1e-9)
        bend = {"affine": [], "perspective": [1.0 / travel] * 2, "radial": [1.0 / span**2]}[self._lens.lens]
        places = [travel / turn] * (2 * len(self.names))
        return np.array([span] * 2 + [span / travel] * 4 + bend + places)

    def _project(self, x: Points) -> Points:
        """Return the computed pixels, (n, 2). The unknowns may be complex."""
        # All poses are computed at the same time for speed: the Jacobian calls this once per unknown and iteration.
        places = x[self.first_place :].reshape(-1, 2)
        q = places[self._mark_index]
        c, s = np.cos(self._phi), np.sin(self._phi)
        at = self._t + np.stack([c * q[:, 0] - s * q[:, 1], s * q[:, 0] + c * q[:, 1]], axis=1)
        bend = x[6 : self.first_place]
        return project_with(at, self._origin(places[0]), x[:2], x[2:6].reshape(2, 2), bend, self._lens)

    def _jacobian(self, x: Floats) -> Floats:
        """Return the derivatives of the computed pixels by complex steps, which are not affected by cancellation."""
        step = 1e-20
        columns = [self._project(x + 1j * step * axis).imag.ravel() / step for axis in np.eye(len(x))]
        return np.stack(columns, axis=1)


def _pair(values: Points) -> Pair:
    return float(values[0]), float(values[1])
