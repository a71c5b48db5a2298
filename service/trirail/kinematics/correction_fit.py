"""Fit of a correction to measured poses. The deviations are modelled as errors of the geometry plus a smooth map.

If the measured pose is p, and the geometry gives the pose q for the same sliders, then the correction is q - p. Near a
singular angle, small errors of the geometry cause errors of the pose that are large and change over a short distance. A
smooth map through the measured poses cannot represent such errors. The first step therefore fits errors of the
geometry, with the derivatives from trirail.kinematics.calibration written as splines. The second step fits the
remaining differences with penalised splines (P-splines; Eilers and Marx, Flexible smoothing with B-splines and
penalties, 1996). The penalty is a weight times the squared second differences of the nodes. Cross-validation selects
the weight: a fit to four fifths of the poses must predict the remaining poses as accurately as possible.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.calibration import CalibrationError, pose_derivatives
from trirail.kinematics.correction import DEGREE, Correction, splines
from trirail.kinematics.geometry import Geometry, Room, travels
from trirail.kinematics.robot import forward

__all__ = ["MIN_POSES", "Fit", "fit"]

MIN_POSES = 30
"""Least number of distinct poses: a grid with three values of x, y and phi, and a few more poses."""
END_SHARE = 0.15
"""Fraction of the robot's range in x, y or phi that may have no measured pose at either end."""
SAMPLES = 21
"""Number of samples along each axis when the reach of the robot and the effects of geometry errors are sampled."""
TRAVEL_MARGIN_M = 0.02
"""Distance beyond the sliders' travel at which effects of geometry errors are also sampled [m], so that the effects are
accurate at the ends of the travel."""
GEOMETRY_CURVATURE_WEIGHT = 2e-4
"""Weight of the penalty when the effects of geometry errors are written as splines. It is large enough to extrapolate
the effects beyond the samples."""
WEIGHTS = tuple(10.0**k for k in range(-6, 4))
"""Weights of the penalty from which cross-validation selects."""
SAME_POSE_SHARE = 0.02
"""Difference of two poses, as a fraction of a cell, up to which they count as measurements of the same pose."""
FOLDS = 5
SEED = 1
"""Seed of the random partition of the poses for cross-validation."""
NAMES = ("x", "y", "phi")


class Fit(NamedTuple):
    """Fitted correction, with measures of its quality."""

    correction: Correction
    before: Array
    """Measured pose errors without a correction (N, 3): measured minus computed x, y, phi [m, m, rad]."""
    residuals: Array
    """Pose errors that remain with the correction."""
    predicted: Array
    """Pose errors that remain at each pose with a correction that was fitted without any measurement of this pose.
    Similar errors can be expected at poses that were not measured."""
    distinct: int
    """Number of distinct poses."""
    empty: int
    """Number of cells without a measured pose. In these cells, the correction is extrapolated from neighbouring
    cells."""


def fit(geometry: Geometry, poses: Array, sliders: Array, room: Room, cells: Sequence[int]) -> Fit:
    """Return the correction of a geometry from measured `poses` and `sliders`, both (N, 3) in m and rad.

    The correction covers the whole room, with the given numbers of cells along x, y and phi. A measured phi may be
    whole turns off. Raises CalibrationError if there are too few poses, if the poses do not cover the robot's reach, or
    if the geometry cannot reach a measured pose.
    """
    low, high = room.low, room.high
    turns = np.round((poses[:, 2] - (low[2] + high[2]) / 2.0) / (2.0 * math.pi))
    poses = poses - np.outer(turns, [0.0, 0.0, 2.0 * math.pi])
    group = _distinct(poses, SAME_POSE_SHARE * np.subtract(high, low) / cells)
    distinct = int(group.max(initial=-1)) + 1
    if distinct < MIN_POSES:
        raise CalibrationError(
            f"{distinct} poses are too few for a map: at least {MIN_POSES} are required, "
            "and about a hundred are recommended"
        )
    reached = _reached(geometry, room)
    for name, measured, within in zip(NAMES, poses.T, reached.T, strict=True):
        (begin, end), (least, most) = ((float(each.min()), float(each.max())) for each in (within, measured))
        spare = END_SHARE * (end - begin)
        if least > begin + spare or most < end - spare:
            raise CalibrationError(
                f"{name} was measured from {least:.4g} to {most:.4g}, but the robot moves from {begin:.4g} to "
                f"{end:.4g}: measure the whole range, or narrow limits.platform.{name}"
            )
    try:
        wanted = forward(geometry, sliders, near=poses) - poses
    except KinematicsError as error:
        raise CalibrationError(
            f"a pose cannot be reached with the configured geometry, or the columns or units are wrong: {error}"
        ) from error
    wanted[:, 2] -= 2.0 * math.pi * np.round(wanted[:, 2] / (2.0 * math.pi))

    shape = [n + DEGREE for n in cells]
    rows, at = splines(poses, low, high, cells)
    curvature = _curvature(shape)
    # All measurements of a pose are in the same fold. Otherwise, the others would predict the one that is left out.
    fold = (np.random.default_rng(SEED).permutation(distinct) % FOLDS)[group]
    scale = np.maximum(wanted.std(axis=0), 1e-12)
    by_geometry = _by_geometry(geometry, room, cells, curvature)

    def nodes(among: NDArray[np.bool], weight: float) -> Array:
        return _nodes(rows[among], by_geometry, wanted[among], scale, curvature * weight)

    def predicted(weight: float) -> Array:
        left = np.empty_like(wanted)
        for out in (fold == number for number in range(FOLDS)):
            left[out] = wanted[out] - rows[out] @ nodes(~out, weight)
        return left

    trials = [predicted(weight) for weight in WEIGHTS]
    best = int(np.argmin([float(((left / scale) ** 2).sum()) for left in trials]))
    solution = nodes(fold >= 0, WEIGHTS[best])
    return Fit(
        Correction(_triple(low), _triple(high), solution.reshape(*shape, 3)),
        before=-wanted,
        residuals=wanted - rows @ solution,
        predicted=trials[best],
        distinct=distinct,
        empty=math.prod(cells) - len(np.unique(at, axis=0)),
    )


def _distinct(poses: Array, size: Array) -> NDArray[np.int64]:
    """Return the number of the distinct pose of each pose, (N,). Poses within `size`, (3,), of its first are equal."""
    group: NDArray[np.int64] = np.full(len(poses), -1)
    number = 0
    for row, pose in enumerate(poses):
        if group[row] < 0:
            group[(group < 0) & (np.abs(poses - pose) <= size).all(axis=1)] = number
            number += 1
    return group


def _reached(geometry: Geometry, room: Room, beyond: float = 0.0) -> Array:
    """Return poses on a grid over the room, (N, 3), with all joints at most `beyond` [m] outside their travel."""
    axes = [np.linspace(low, high, SAMPLES) for low, high in zip(room.low, room.high, strict=True)]
    poses = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    reached: Array = poses[room.holds(travels(geometry, poses), beyond)]
    if not len(reached):
        raise CalibrationError("the limits leave no pose to move to: widen limits.slider or limits.platform")
    return reached


def _curvature(shape: Sequence[int]) -> Array:
    """Return the matrix of the penalty, the sum of the squared second differences of the nodes along all axes."""
    total = np.zeros((math.prod(shape), math.prod(shape)))
    for axis, number in enumerate(shape):
        differences = np.diff(np.eye(number), 2, axis=0)
        parts = [np.eye(each) for each in shape]
        parts[axis] = differences.T @ differences
        total += np.kron(np.kron(parts[0], parts[1]), parts[2])
    return total


def _solve(rows: Array, wanted: Array, penalty: Array) -> Array:
    """Return the nodes (nodes, 3) of the penalised least-squares fit of the splines `rows` to the values `wanted`."""
    try:
        solution: Array = np.linalg.solve(rows.T @ rows + penalty, rows.T @ wanted).astype(np.float64)
    except np.linalg.LinAlgError as error:
        raise CalibrationError("the poses vary too little for a map: vary x, y and phi independently") from error
    return solution


def _by_geometry(geometry: Geometry, room: Room, cells: Sequence[int], curvature: Array) -> Array:
    """Return the effect of each calibration parameter on the pose, written as nodes of splines, (nodes, 3, 15)."""
    reached = _reached(geometry, room, TRAVEL_MARGIN_M)
    moved = pose_derivatives(geometry, geometry, reached).reshape(len(reached), -1)
    rows, _ = splines(reached, room.low, room.high, cells)
    return _solve(rows, moved, curvature * GEOMETRY_CURVATURE_WEIGHT).reshape(rows.shape[1], 3, -1)


def _nodes(rows: Array, by_geometry: Array, wanted: Array, scale: Array, penalty: Array) -> Array:
    """Return the nodes (nodes, 3) of the correction: the effects of geometry errors plus the penalised splines."""
    each = np.tensordot(rows, by_geometry, 1) / scale[:, None]
    parameters, *_ = np.linalg.lstsq(each.reshape(wanted.size, -1), (wanted / scale).ravel(), rcond=None)
    nodes: Array = by_geometry @ parameters.astype(np.float64)
    nodes += _solve(rows, wanted - rows @ nodes, penalty)
    return nodes


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
