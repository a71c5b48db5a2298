"""Robust fit of a stage model to looks. Outliers are excluded, and undetermined combinations keep configured values.

The noise is estimated from the median of the residuals. A first fit with a robust loss function (soft l1; Triggs et al.
2000, Bundle Adjustment, 4.3) finds the outliers. Least-squares fits without the outliers follow until the noise no
longer falls: first of all combinations, then of those that the looks determine. With a noise that is still too high,
some of these would appear undetermined. In all fits, the drawings are treated as an additional observation of each
correction, with the standard deviations StageModel.doubts. If the corrections are greater on average, these standard
deviations are increased to their root mean square: a stage that was homed 1 mm off would otherwise be held back, and
would look as if no geometry explained it. In the same way, the middle of the picture is an additional observation of
the centre of a radial lens, which looks do not determine if the lens has no distortion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trirail.alignment.rigid_motion import Floats
from trirail.alignment.stage_model import StageLook, StageModel, list_marks
from trirail.errors import AlignmentError, AlignmentFault, KinematicsError

OUTLIER_DEVIATIONS = 6.0
"""Distance of a mark from its computed pixel above which the observation is an outlier, in standard deviations."""
MIN_NOISE_PX = 0.01
MAX_OUTLIER_SHARE, MAX_MARK_OUTLIER_SHARE = 0.3, 0.5
"""Greatest fraction of outliers among all observations, and among those of one mark."""
TOLERANCE = 1e-12
MAX_EVALUATIONS = 100
MAX_ROUNDS = 40
MIN_NOISE_SHARE = 0.97
"""Fraction of the noise in the round before, below which the noise still falls. The fit is then not finished: a lower
noise gives the looks a greater weight against the drawings."""
RAYLEIGH_MEDIAN = 1.1774
"""Median of the distance of normally distributed points from their mean in the plane, in standard deviations of one
coordinate."""


class StageFit(NamedTuple):
    """Result of the fit of a stage model to looks."""

    unknowns: Floats
    covariance: Floats
    """Covariance of the unknowns, (size, size). Combinations that keep their configured values have the standard
    deviations of the drawings."""
    determined: Floats
    """Orthonormal basis of the combinations of leg unknowns that the looks determine, (legs, K)."""
    noise: float
    """Standard deviation of the u or v of a mark, computed from the residuals [pixel]."""
    residuals: Floats
    """Observed minus computed pixels, (n, 2), in the order of list_marks."""
    used: NDArray[np.bool]
    """True for each observation that is not an outlier, (n,), in the order of list_marks."""


def fit_stage(
    model: StageModel, looks: Sequence[StageLook], start: Floats | None = None, *, fixed_legs: bool = False
) -> StageFit:
    """Fit a model to looks, starting from the configured stage or from the unknowns `start`.

    If `fixed_legs` is set, only cameras and marks are fitted. Raises AlignmentError if there are too few looks, if the
    marks do not follow the moves, or if the fit does not converge.
    """
    marks = list_marks(looks)
    unknowns = model.initial() if start is None else start
    used = np.ones(len(marks), bool)
    if 2 * len(marks) <= model.size - model.legs:
        raise AlignmentError(
            AlignmentFault.MOVES, f"{len(marks)} marks seen over {len(looks)} looks are too few: add looks or marks"
        )
    if fixed_legs:  # with wrong legs, correct observations could appear as outliers: use all observations
        free = np.eye(model.size)[:, model.legs :]
        unknowns = _minimise(model, looks, unknowns, used, free, 1.0, 1.0, robust=False)
        noise = max(float(np.sqrt((model.residuals(unknowns, looks) ** 2).mean())), MIN_NOISE_PX)
        unknowns = _minimise(model, looks, unknowns, used, free, noise, 1.0, robust=False)
        return _result(model, looks, unknowns, used, free, 1.0)
    unknowns = _minimise(model, looks, unknowns, used, np.eye(model.size), 1.0, 1.0, robust=True)
    noise, basis, is_reduced = math.inf, np.eye(model.size), False
    for _ in range(MAX_ROUNDS):
        away = np.linalg.norm(model.residuals(unknowns, looks), axis=1)
        # The fit brings the computed pixels nearer to the observed ones: few looks leave less than the noise.
        count = 2 * int(used.sum())
        share = math.sqrt(count / max(count - basis.shape[1], 1))
        last, noise = noise, max(share * float(np.median(away[used])) / RAYLEIGH_MEDIAN, MIN_NOISE_PX)
        now = away <= OUTLIER_DEVIATIONS * noise
        if now.mean() < 1.0 - MAX_OUTLIER_SHARE:
            raise AlignmentError(
                AlignmentFault.STILL,
                f"{len(now) - int(now.sum())} of {len(now)} marks are far from where any stage would put them; check "
                "that each look takes a new picture, and the names of the marks",
            )
        for name in model.places:
            own = now[[mark == name for _, mark in marks]]
            if own.mean() < 1.0 - MAX_MARK_OUTLIER_SHARE:
                raise AlignmentError(
                    AlignmentFault.STILL,
                    f"mark {name} is far from where any stage would put it in {len(own) - int(own.sum())} of "
                    f"{len(own)} looks; check that its camera takes a new picture at each look, and its name",
                )
        doubt = max(1.0, float(np.sqrt(np.mean(unknowns[: model.legs] ** 2))))
        if is_reduced:
            jacobian = model.jacobian(unknowns, looks)[now]
            basis = _determined(model, jacobian / noise * doubt)
            unknowns = _with_configured_combinations(model, unknowns, basis, jacobian)
        is_falling, is_same = noise < MIN_NOISE_SHARE * last, np.array_equal(now, used)
        used = now
        unknowns = _minimise(model, looks, unknowns, used, basis, noise, doubt, robust=False)
        if is_reduced and is_same and not is_falling:
            break
        is_reduced = is_reduced or not is_falling
    if is_falling:
        raise AlignmentError(
            AlignmentFault.MOVES,
            f"the fit of the geometry did not converge in {MAX_ROUNDS} rounds, the noise still falls at {noise:.2f} "
            "pixels; check the configured geometry against drawings and homing, or add looks",
        )
    return _result(model, looks, unknowns, used, basis, doubt)


def _result(
    model: StageModel, looks: Sequence[StageLook], unknowns: Floats, used: NDArray[np.bool], basis: Floats, doubt: float
) -> StageFit:
    residuals, legs = model.residuals(unknowns, looks), model.legs
    freedom = max(2 * int(used.sum()) - basis.shape[1], 1)
    noise = float(np.sqrt((residuals[used] ** 2).sum() / freedom))
    expected = noise * model.expected(doubt)[0] @ basis
    covariance = _covariance(model.jacobian(unknowns, looks)[used], basis, expected, noise)
    determined = basis[:legs, : basis.shape[1] - (model.size - legs)]
    # A parameter with a small share of an undetermined combination is as uncertain as this share of the drawings.
    covariance[:legs, :legs] += doubt**2 * (np.eye(legs) - determined @ determined.T)
    return StageFit(unknowns, covariance, determined, noise, residuals, used)


def _covariance(jacobian: Floats, basis: Floats, expected: Floats, noise: float) -> Floats:
    rows = jacobian.reshape(-1, len(basis)) @ basis
    information = np.concatenate([rows, expected])
    scales = np.maximum(np.linalg.norm(information, axis=0), 1e-300)
    inverse = np.linalg.pinv(information / scales)
    return np.asarray(basis @ ((inverse @ inverse.T) / np.outer(scales, scales)) @ basis.T * noise**2)


def camera_covariance(model: StageModel, looks: Sequence[StageLook], fit: StageFit) -> Floats:
    """Return the covariance of cameras and marks for known legs, (size, size); zero for the legs."""
    cameras = np.eye(model.size)[:, model.legs :]
    jacobian = model.jacobian(fit.unknowns, looks)[fit.used]
    return _covariance(jacobian, cameras, fit.noise * model.expected(1.0)[0] @ cameras, fit.noise)


def leg_information(model: StageModel, jacobian: Floats) -> Floats:
    """Return rows (., legs) with the information that looks contain about the legs if cameras and marks are unknown.

    `jacobian` contains the derivatives of the pixels, divided by their standard deviation, (n, 2, size).
    """
    rows = jacobian.reshape(-1, model.size)
    legs, others = rows[:, : model.legs], rows[:, model.legs :]
    others = others / np.maximum(np.linalg.norm(others, axis=0), 1e-300)
    q, _ = np.linalg.qr(others)
    return np.asarray(legs - q @ (q.T @ legs))


def _determined(model: StageModel, jacobian: Floats) -> Floats:
    """Return a basis (size, K) of the combinations of unknowns that looks determine more accurately than drawings."""
    _, values, directions = np.linalg.svd(leg_information(model, jacobian), full_matrices=False)
    known = directions[values > 1.0].T
    basis = np.zeros((model.size, known.shape[1] + model.size - model.legs))
    basis[: model.legs, : known.shape[1]] = known
    basis[model.legs :, known.shape[1] :] = np.eye(model.size - model.legs)
    return basis


def _with_configured_combinations(model: StageModel, unknowns: Floats, basis: Floats, jacobian: Floats) -> Floats:
    """Return the unknowns with the configured values of all combinations of legs that are not in `basis`.

    Cameras and marks change with them, so that the computed pixels change as little as possible. `jacobian` contains
    the derivatives of the pixels, (n, 2, size).
    """
    known = basis[: model.legs]
    change = known @ (known.T @ unknowns[: model.legs]) - unknowns[: model.legs]
    rows = jacobian.reshape(-1, model.size)
    scales = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)[model.legs :]
    others = np.linalg.lstsq(rows[:, model.legs :] / scales, -rows[:, : model.legs] @ change, rcond=None)[0] / scales
    return np.asarray(unknowns + np.concatenate([change, others]))


def _minimise(
    model: StageModel,
    looks: Sequence[StageLook],
    unknowns: Floats,
    used: NDArray[np.bool],
    basis: Floats,
    noise: float,
    doubt: float,
    *,
    robust: bool,
) -> Floats:
    """Return the unknowns at the least squares. The doubts of the drawings are multiplied by `doubt`."""
    from scipy.optimize import least_squares  # type: ignore[import-untyped]

    # The drawings are an additional observation of each correction. Otherwise, the noise of a small number of looks
    # would cause large corrections of the legs.
    rows, values = model.expected(doubt)
    away, prior = rows @ unknowns - values, rows @ basis

    def residuals(step: Floats) -> Floats:
        try:
            seen = model.residuals(unknowns + basis @ step, looks)[used].ravel() / noise
        except KinematicsError:
            return np.full(2 * int(used.sum()) + len(prior), np.inf)  # the solver will shorten the step
        return np.concatenate([seen, away + prior @ step])

    def jacobian(step: Floats) -> Floats:
        rows = model.jacobian(unknowns + basis @ step, looks)[used].reshape(-1, model.size) @ basis / noise
        return np.concatenate([-rows, prior])

    solution = least_squares(
        residuals,
        np.zeros(basis.shape[1]),
        jacobian,
        loss="soft_l1" if robust else "linear",
        x_scale="jac",
        ftol=TOLERANCE if not robust else 1e-8,
        xtol=TOLERANCE if not robust else 1e-8,
        gtol=None,
        max_nfev=MAX_EVALUATIONS,
    )
    return np.asarray(unknowns + basis @ solution.x)
