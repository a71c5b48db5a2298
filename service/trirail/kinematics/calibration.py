"""Calibration: identification of the as-built geometry from measured poses and the slider readings at these poses.

The measured poses are assumed to differ from forward(geometry, sliders) by independent normal noise. The encoders of
the sliders are treated as exact. The result is the geometry with the least weighted sum of squared differences.

Measured poses and slider readings can determine at most five combinations of the seven numbers of a leg. These
combinations are the PARAMETERS of the leg. The result consists of corrections to the parameters of a starting geometry.

If the poses do not vary enough, some combinations of parameters remain undetermined. They are detected from the
singular values of the Jacobian of each leg. Undetermined combinations keep the values of the starting geometry, and the
result names their parameters.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares  # type: ignore[import-untyped]

from trirail.errors import KinematicsError, TrirailError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import LEGS, Geometry
from trirail.kinematics.leg import AnyLeg, wrapped
from trirail.kinematics.robot import forward, inverse, jacobians

__all__ = ["Calibration", "CalibrationError", "Open", "corrected", "identify", "pose_derivatives"]

MIN_NAMED_SHARE = 0.1  # least weight at which a parameter is named as undetermined; parameters are divided by DOUBT
MINIMUM = 6  # least number of poses: each gives one equation per leg, for five parameters and one check
MISFIT = 3.0  # ratio of residual to noise (root mean square) above which the data does not belong to this robot
TOLERANCE = 1e-12
MAX_EVALUATIONS = 200  # good data needs only a few evaluations


class CalibrationError(TrirailError):
    """Error that no geometry can be identified from the data.

    `row` is the index of the row that causes the error, counted from 0, or None if there is no such row.
    """

    def __init__(self, message: str, *, row: int | None = None) -> None:
        super().__init__(message)
        self.row = row


class Open(NamedTuple):
    """Parameters of a leg that the data does not determine, and the number of their undetermined combinations."""

    leg: str
    parameters: tuple[str, ...]
    combinations: int


class Calibration(NamedTuple):
    """Result of a calibration with N poses. Corrections have rows A, B, C and the columns of Geometry.parameters."""

    geometry: Geometry
    corrections: Array  # (3, 5), relative to the starting geometry [m, rad]
    # (3, 5), from the stated noise times max(1, misfit), and from DOUBT for shares of undetermined combinations;
    # infinite for parameters that are named as undetermined
    standard_errors: Array
    open: tuple[Open, ...]
    residuals: Array  # (N, 3): measured minus computed x, y, phi [m, m, rad]
    misfit: float  # root mean square of residual divided by noise, per degree of freedom; about 1 for good data


def identify(
    start: Geometry, poses: Array, sliders: Array, *, position_noise: float = 20e-6, angle_noise: float = 1e-4
) -> Calibration:
    """Return the geometry that agrees best with measured `poses` and `sliders`, both (N, 3) in m and rad.

    `position_noise` and `angle_noise` are the standard deviations of a measured coordinate [m] and angle [rad]. Raises
    CalibrationError if there are too few poses, if the starting geometry cannot reach a measured pose, or if no
    geometry fits.
    """
    if len(poses) < MINIMUM:
        raise CalibrationError(
            f"{len(poses)} poses are too few: at least {MINIMUM} are required, and a few dozen are recommended"
        )
    for name, value in (("position", position_noise), ("angle", angle_noise)):
        if not (math.isfinite(value) and value > 0.0):
            raise CalibrationError(f"the {name} noise is {value}: it must be finite and positive")
    _check(start, poses, sliders)
    noise: Array = np.array([position_noise, position_noise, angle_noise])
    basis, undetermined, unknown = _separate(start, pose_derivatives(start, start, poses) / noise[:, None, None])

    def geometry(z: Array) -> Geometry:
        return corrected(start, (basis @ z).reshape(3, 5))

    def residuals(z: Array) -> Array:
        try:
            return (_residuals(geometry(z), poses, sliders) / noise).ravel()
        except KinematicsError:
            return np.full(poses.size, math.inf)  # the step is too large, and the solver will shorten it

    def jacobian(z: Array) -> Array:
        reached = forward(geometry(z), sliders, near=poses)
        derivatives = pose_derivatives(geometry(z), start, reached) / noise[:, None, None]
        return -derivatives.reshape(poses.size, 15) @ basis

    solution = least_squares(
        residuals,
        np.zeros(basis.shape[1]),
        jacobian,
        ftol=TOLERANCE,
        xtol=TOLERANCE,
        gtol=TOLERANCE,
        max_nfev=MAX_EVALUATIONS,
    )
    misfit = math.sqrt(solution.fun @ solution.fun / (poses.size - basis.shape[1]))
    if misfit > MISFIT:
        row, _ = divmod(int(np.argmax(np.abs(solution.fun))), 3)
        raise CalibrationError(
            f"no geometry fits: the residuals are {misfit:.3g} times the stated noise, and at this pose, the worst, "
            f"{np.max(np.abs(solution.fun)):.3g} times; check this pose, the columns and the units, or state more "
            "noise",
            row=row,
        )
    if not solution.success:
        raise CalibrationError(
            f"no convergence after {solution.nfev} steps: the poses vary too little; vary the poses more, above all in "
            "phi"
        )
    deviations = basis @ np.linalg.pinv(solution.jac)
    # An undetermined combination is as uncertain as the drawings. It may be a part of a parameter that is not named,
    # and at the identified geometry it may change what the poses say of the determined combinations.
    derivatives = pose_derivatives(geometry(solution.x), start, poses) / noise[:, None, None]
    undetermined += deviations @ derivatives.reshape(poses.size, 15) @ undetermined
    # Residuals above the stated noise show that the noise was stated too low. Residuals below it may be chance.
    variances = max(1.0, misfit) ** 2 * np.sum(deviations**2, axis=1) + np.sum(undetermined**2, axis=1)
    errors = np.sqrt(variances).reshape(3, 5)
    for leg, names, _ in unknown:
        errors[LEGS.index(leg), [start.parameters.index(name) for name in names]] = math.inf
    return Calibration(
        geometry=geometry(solution.x),
        corrections=(basis @ solution.x).reshape(3, 5),
        standard_errors=errors,
        open=unknown,
        residuals=solution.fun.reshape(-1, 3) * noise,
        misfit=misfit,
    )


def corrected(start: Geometry, corrections: Array) -> Geometry:
    """Return a geometry with corrections (3, 5) added to its parameters [m, rad]. Raises KinematicsError if invalid.

    Its angles are within one turn, because configurations accept no others.
    """
    legs = [leg.corrected(row) for leg, row in zip(start.each, corrections.tolist(), strict=True)]
    first, second, third = (replace(leg, **_angles_beyond_a_turn(leg)) for leg in legs)
    return Geometry(legs=(first, second, third), labels=start.labels)


def _angles_beyond_a_turn(leg: AnyLeg) -> dict[str, float]:
    """Return the angles of a leg that are beyond ±2 pi, reduced to the range (-pi, pi]."""
    angles = {key: value for key, value in leg.keys().items() if key.endswith("angle")}
    return {key: wrapped(value) for key, value in angles.items() if abs(value) > 2.0 * math.pi}


def pose_derivatives(geometry: Geometry, start: Geometry, poses: Array) -> Array:
    """Return the derivatives of poses with respect to the parameters of the legs, at fixed sliders, (N, 3, 3, 5).

    The parameters are corrections to `start`, and the derivatives are evaluated for `geometry`. The axes of the result
    are the pose in `poses` (N, 3); x, y, phi; the leg; and the parameters of the leg. The loop of a leg requires F = 0.
    The derivatives of F are J1 with respect to the slider, and -J2 with respect to the pose, (16). Therefore J2 d pose
    = dF. Raises KinematicsError if inverse does.
    """
    _, J2 = jacobians(geometry, poses)
    joints = inverse(geometry, poses)
    dF = np.empty((len(poses), 3, 5))
    for i, (leg, first) in enumerate(zip(geometry.each, start.each, strict=True)):
        slider, passive = joints.position[:, i], joints.passive_position[:, i]
        dF[:, i] = leg.parameter_derivatives(first, poses[:, 2], slider, passive)
    return np.linalg.inv(J2)[..., np.newaxis] * dF[:, np.newaxis]


def _check(start: Geometry, poses: Array, sliders: Array) -> None:
    """Raise CalibrationError if the starting geometry cannot reach a measured pose or slider reading."""
    for row, (pose, reading) in enumerate(zip(poses, sliders, strict=True)):
        try:
            inverse(start, pose)
            forward(start, reading, near=pose)
        except KinematicsError as error:
            raise CalibrationError(
                f"a pose is out of reach of the starting geometry, or the columns or units are wrong: {error}", row=row
            ) from error


def _residuals(geometry: Geometry, poses: Array, sliders: Array) -> Array:
    """Return measured minus computed poses, (N, 3)."""
    difference = poses - forward(geometry, sliders, near=poses)
    difference[:, 2] -= 2.0 * math.pi * np.round(difference[:, 2] / (2.0 * math.pi))
    return difference


def _separate(start: Geometry, derivatives: Array) -> tuple[Array, Array, tuple[Open, ...]]:
    """Separate the corrections that the data determines from the undetermined corrections.

    `derivatives` are pose_derivatives divided by the noise. Returns a basis (15, K) of the determined corrections, the
    undetermined corrections (15, 15 - K) in the size that drawings allow, and the parameters of the latter. The effects
    of different legs at each pose are independent, so that a correction of one leg cannot compensate a correction of
    another leg. Each undetermined combination therefore belongs to a single leg.
    """
    determined: list[Array] = []
    undetermined: list[Array] = []
    unknown: list[Open] = []
    for i, (leg, built) in enumerate(zip(LEGS, start.each, strict=True)):
        doubt = np.array(built.DOUBT)
        _, values, directions = np.linalg.svd(derivatives[:, :, i].reshape(-1, 5) * doubt, full_matrices=False)
        for direction, value in zip(directions, values, strict=True):
            column = np.zeros((3, 5))
            column[i] = doubt * direction
            (determined if value > 1.0 else undetermined).append(column.ravel())
        if len(rest := directions[values <= 1.0]):
            shares = np.linalg.norm(rest, axis=0)
            names = tuple(name for name, share in zip(built.PARAMETERS, shares, strict=True) if share > MIN_NAMED_SHARE)
            unknown.append(Open(leg, names, len(rest)))
    if not determined:
        raise CalibrationError(
            "the stated noise is too large: the poses determine nothing better than drawings do; state less noise, or "
            "add poses"
        )
    return np.stack(determined, axis=1), np.reshape(undetermined, (-1, 15)).T, tuple(unknown)
