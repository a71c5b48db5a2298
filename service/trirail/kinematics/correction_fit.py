"""A correction from measured poses: what the robot does beside its geometry, by penalised splines (P-splines).

At a measured pose p the sliders stand where the geometry has the pose q: the correction there is q - p. Sought are the
nodes whose correction differs least from these, with as little curvature as tells nothing of poses that were left out:
the weight of the nodes' second differences is the one with which a fit to four fifths of the poses foretells the rest
best (Eilers and Marx, Flexible smoothing with B-splines and penalties, 1996, and cross-validation).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trirail.errors import KinematicsError
from trirail.kinematics.algebra import Array
from trirail.kinematics.calibration import CalibrationError
from trirail.kinematics.correction import DEGREE, Correction, splines
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import forward, inverse

__all__ = ["FEWEST", "Fit", "Room", "fit"]

FEWEST = 30
"""Poses: a grid of three in x, y and phi, and a few more."""
ENDS = 0.1
"""Share of what the robot reaches, at either end, in which poses may lack."""
SAMPLES = 15
"""Along each axis, to see what the robot reaches."""
WEIGHTS = tuple(10.0**k for k in range(-6, 4))
"""Of curvature, that are tried."""
FOLDS = 5
SEED = 1
"""Of which poses are left out together."""
NAMES = ("x", "y", "phi")


class Fit(NamedTuple):
    """A correction, and how good it is."""

    correction: Correction
    before: Array
    """The pose errors that were measured (N, 3): measured less computed x, y, phi [m, m, rad]."""
    residuals: Array
    """What the correction leaves of them."""
    foretold: Array
    """What a correction leaves that was made without the pose in question: what to expect elsewhere."""
    empty: int
    """Cells without a measured pose: what is there comes from beside it."""


class Room(NamedTuple):
    """Where a robot may be: the least and the greatest of x, y [m] and phi [rad], of lambda_10 and of lambda_32 [m]."""

    low: Sequence[float]
    high: Sequence[float]
    position: tuple[float, float]
    passive: tuple[float, float]


def fit(geometry: Geometry, poses: Array, sliders: Array, room: Room, cells: Sequence[int]) -> Fit:
    """Return the correction of a geometry from measured `poses` and `sliders`, both (N, 3) in m and rad.

    It is for the whole room, with so many `cells` along x, y and phi. CalibrationError if there are too few poses, or
    if they do not reach as far as the robot does, or where the geometry has no pose near a measured one.
    """
    low, high = room.low, room.high
    if len(poses) < FEWEST:
        raise CalibrationError(f"{len(poses)} poses are too few for a map: {FEWEST} are the least, a hundred are good")
    reached = _reached(geometry, room)
    for name, measured, within in zip(NAMES, poses.T, reached.T, strict=True):
        (begin, end), (least, most) = ((float(each.min()), float(each.max())) for each in (within, measured))
        spare = ENDS * (end - begin)
        if least > begin + spare or most < end - spare:
            raise CalibrationError(
                f"{name} was measured from {least:.4g} to {most:.4g}, and the robot goes from {begin:.4g} to "
                f"{end:.4g}: measure as far, or narrow limits.platform.{name}"
            )
    try:
        wanted = forward(geometry, sliders, near=poses) - poses
    except KinematicsError as error:
        raise CalibrationError(f"out of the geometry's reach, or the columns or units are wrong: {error}") from error
    wanted[:, 2] -= 2.0 * math.pi * np.round(wanted[:, 2] / (2.0 * math.pi))

    shape = [n + DEGREE for n in cells]
    rows, at = splines(poses, low, high, cells)
    curvature = _curvature(shape)
    fold = np.random.default_rng(SEED).permutation(len(poses)) % FOLDS
    scale = np.maximum(wanted.std(axis=0), 1e-12)
    trials = [_foretold(rows, wanted, curvature * weight, fold) for weight in WEIGHTS]
    best = int(np.argmin([float(((left / scale) ** 2).sum()) for left in trials]))
    nodes = _solve(rows, wanted, curvature * WEIGHTS[best])
    return Fit(
        Correction(_triple(low), _triple(high), nodes.reshape(*shape, 3)),
        before=-wanted,
        residuals=wanted - rows @ nodes,
        foretold=trials[best],
        empty=math.prod(cells) - len(np.unique(at, axis=0)),
    )


def _reached(geometry: Geometry, room: Room) -> Array:
    """Return poses all over the room that the sliders' travel allows, (N, 3)."""
    axes = [np.linspace(low, high, SAMPLES) for low, high in zip(room.low, room.high, strict=True)]
    poses = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    joints = inverse(geometry, poses)
    within = np.ones(len(poses), dtype=np.bool)
    for places, (low, high) in ((joints.position, room.position), (joints.passive_position, room.passive)):
        within &= ((places >= low) & (places <= high)).all(axis=1)
    if not within.any():
        raise CalibrationError("the limits leave the robot nowhere to go")
    reached: Array = poses[within]
    return reached


def _curvature(shape: Sequence[int]) -> Array:
    """Return the matrix whose form is the sum of the squares of the nodes' second differences along x, y and phi."""
    total = np.zeros((math.prod(shape), math.prod(shape)))
    for axis, number in enumerate(shape):
        differences = np.diff(np.eye(number), 2, axis=0)
        parts = [np.eye(each) for each in shape]
        parts[axis] = differences.T @ differences
        total += np.kron(np.kron(parts[0], parts[1]), parts[2])
    return total


def _solve(rows: Array, wanted: Array, penalty: Array) -> Array:
    """Return the nodes, (nodes, 3)."""
    try:
        found: Array = np.linalg.solve(rows.T @ rows + penalty, rows.T @ wanted)
    except np.linalg.LinAlgError as error:
        raise CalibrationError("the poses tell too little for a map: vary x, y and phi independently") from error
    return found


def _foretold(rows: Array, wanted: Array, penalty: Array, fold: Array) -> Array:
    """Return what is left of each pose's error by a correction that was made without its fold."""
    left = np.empty_like(wanted)
    for number in range(FOLDS):
        out = fold == number
        left[out] = wanted[out] - rows[out] @ _solve(rows[~out], wanted[~out], penalty)
    return left


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
