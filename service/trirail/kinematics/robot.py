"""Inverse and forward kinematics, and both Jacobians, for arrays of poses, with exceptions for invalid values.

A pose is (x, y, phi): the platform's centre G in the base frame [m], and the angle of the platform [rad]. The positions
of the sliders are lambda_10 of the legs A, B, C [m]. For a 3-PRP robot, the passive joints are lambda_32 of the same
legs [m], and phi_21 = phi, (8). An array holds either one pose, with shape (3,), or N poses, with shape (N, 3).
"""

from __future__ import annotations

import math
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.closed_forward import (
    J2_SINGULAR,
    LOOPS_OPEN,
    ROUNDING,
    forward_batch,
    forward_into,
    loop_equation,
)
from trirail.kinematics.closure import inverse_batch, inverse_into, jacobians_batch
from trirail.kinematics.geometry import LEGS, PARALLEL, Geometry
from trirail.quantities import apart, worded

__all__ = ["Motion", "forward", "forward_into", "inverse", "inverse_into", "jacobians", "warm_up"]

HOME = np.zeros(3)


class Motion(NamedTuple):
    """Motion of the joints of legs A, B, C. Each field has shape (3,) or (N, 3), in m, m/s or m/s²."""

    position: Array
    """lambda_10, the positions of the sliders on their rails [m]."""
    velocity: Array
    """v_10 [m/s]."""
    acceleration: Array
    """gamma_10 [m/s²]."""
    passive_position: Array
    """lambda_32, the positions of the pins along the edges of the platform; lambda_21 of the cross slides of a 3-PPR
    robot [m]."""
    passive_velocity: Array
    """v_32 [m/s]."""
    passive_acceleration: Array
    """gamma_32 [m/s²]."""


def inverse(geometry: Geometry, pose: ArrayLike, velocity: ArrayLike = 0.0, acceleration: ArrayLike = 0.0) -> Motion:
    """Return the motion of all joints for a motion of the platform, by (9) to (19).

    `pose` is x, y [m] and phi [rad] in the base frame, (3,) or (N, 3). `velocity` [m/s, m/s, rad/s] and `acceleration`
    [m/s², m/s², rad/s²] are its time derivatives. They have the shape of `pose`, or the shape (3,) if they apply to all
    rows. By default, the platform is at rest. The travel of the joints is not checked. Raises KinematicsError, with
    leg, value and limit, if a number is not finite, or if the edge of a leg is parallel to its rail, sin(phi +
    edge_angle - rail_angle) = 0.
    """
    pose = np.asarray(pose, dtype=np.float64)
    rows = _rows("pose", pose)
    motion = np.empty((3, rows, 3))
    motion[0] = pose
    _fill(motion[1], "velocity", velocity)
    _fill(motion[2], "acceleration", acceleration)
    out = np.empty((6, rows, 3))
    code = inverse_batch(geometry.packed(), motion, out)
    if code != 0:
        row, leg = divmod(code - 1, 3)
        _refuse_pose(geometry, motion[:, row], leg, _place(row, pose))
    return Motion(*out.reshape(6, *pose.shape))


def forward(geometry: Geometry, sliders: ArrayLike, near: ArrayLike | None = None) -> Array:
    """Return the pose, x, y [m] and phi in (-pi, pi], for given positions of the sliders A, B, C [m], by (11).

    Two poses close the loops. The function returns the pose that can be reached from the pose `near` without passing a
    singularity of J2. `near` has the shape of `sliders`, or the shape (3,) if it applies to all rows. The default, (0,
    0, 0), is always sufficient for the symmetric robot in its usable range, -2 pi/3 < phi < pi/3. Raises
    KinematicsError if a number is not finite, if no pose closes the loops, or if the result or `near` is singular.
    """
    sliders = np.asarray(sliders, dtype=np.float64)
    rows, start, pose = np.empty((3, _rows("sliders", sliders), 3))
    rows[:] = sliders
    _fill(start, "near", HOME if near is None else near)
    code = forward_batch(geometry.packed(), rows, start, pose)
    if code != 0:
        row, fault = divmod(code - 1, 5)
        if fault + 1 in {LOOPS_OPEN, J2_SINGULAR}:
            _refuse_loops(geometry, rows[row], start[row], _place(row, sliders))
        _refuse_slider(geometry, rows[row], pose[row], fault, _place(row, sliders))
    return pose.reshape(sliders.shape)


def jacobians(geometry: Geometry, pose: ArrayLike) -> tuple[Array, Array]:
    """Return J1 and J2 of (16) to (18), (3, 3) or (N, 3, 3), with J1 @ slider velocity = J2 @ platform velocity.

    `pose` has the same form as for inverse. J1 is diagonal. The last column of J2 is in metres, and the other columns
    have no unit. J2 may be singular. Raises KinematicsError if a number is not finite or J1 is singular.
    """
    pose = np.asarray(pose, dtype=np.float64)
    rows = np.empty((_rows("pose", pose), 3))
    rows[:] = pose
    j1, j2 = np.zeros((2, len(rows), 3, 3))
    code = jacobians_batch(geometry.packed(), rows, j1, j2)
    if code != 0:
        row, leg = divmod(code - 1, 3)
        _refuse_pose(geometry, rows[row : row + 1], leg, _place(row, pose))
    return j1.reshape(*pose.shape, 3), j2.reshape(*pose.shape, 3)


def warm_up() -> None:
    """Call each function of this module once, because the first call of a compiled function is slow."""
    geometry = Geometry.symmetric()
    legs, pose = geometry.packed(), np.zeros(3)
    inverse_into(legs, np.zeros((3, 3)), np.empty((6, 3)))
    forward_into(legs, np.zeros(3), HOME, pose)
    forward(geometry, inverse(geometry, pose).position)
    jacobians(geometry, pose)


def _rows(name: str, array: Array) -> int:
    """Return the number of poses in an array of shape (3,) or (N, 3)."""
    if array.ndim not in {1, 2} or array.shape[-1] != 3:
        raise KinematicsError(f"{name} has shape {array.shape}: expected (3,) or (N, 3)")
    return len(array) if array.ndim == 2 else 1


def _fill(rows: Array, name: str, value: ArrayLike) -> None:
    array = np.asarray(value, dtype=np.float64)
    try:
        rows[:] = array
    except ValueError as error:
        message = f"{name} has shape {array.shape}: expected (3,), or one row for each of {len(rows)}"
        raise KinematicsError(message) from error


def _place(row: int, array: Array) -> str:
    return f"row {row}: " if array.ndim == 2 else ""


def _refuse_pose(geometry: Geometry, motion: Array, leg: int, place: str) -> NoReturn:
    """Raise the error that explains why a leg cannot follow `motion`, with rows pose, velocity and acceleration."""
    for name, row in zip(("pose", "velocity", "acceleration"), motion, strict=False):
        for axis, value in zip(("x", "y", "phi"), row, strict=True):
            if not math.isfinite(value):
                raise KinematicsError(f"{place}{name} {axis} is {value}: it must be finite", value=float(value))
    _refuse_angle(geometry, leg, float(motion[0, 2]), place)


def _refuse_slider(geometry: Geometry, sliders: Array, pose: Array, leg: int, place: str) -> NoReturn:
    """Raise the error for an invalid slider position, or for a pose at which the edge of the leg is singular."""
    slider = float(sliders[leg])
    if not math.isfinite(slider):
        message = f"{place}slider {geometry.labels[leg]} is {slider}: it must be finite"
        raise KinematicsError(message, leg=LEGS[leg], value=slider)
    _refuse_angle(geometry, leg, float(pose[2]), place)


def _refuse_angle(geometry: Geometry, leg: int, phi: float, place: str) -> NoReturn:
    """Raise the error that states at which angle the edge of a leg is parallel to its rail."""
    built, at, where = geometry.each[leg], worded(phi, "rad"), f"{place}leg {geometry.labels[leg]}"
    parallel = built.parallel_angle
    if parallel is None:
        raise KinematicsError(f"{where}: out of reach at phi = {at}", leg=LEGS[leg], value=phi)
    delta = math.remainder(phi - parallel, math.pi)
    what = f"{built.CROSS} parallel to its rail" if abs(delta) <= 2.0 * PARALLEL else "out of reach"
    raise KinematicsError(
        f"{where}: {what} at phi = {at} (singular at {worded(phi - delta, 'rad')})",
        leg=LEGS[leg],
        value=phi,
        limit=phi - delta,
    )


def _refuse_loops(geometry: Geometry, sliders: Array, near: Array, place: str) -> NoReturn:
    """Raise the error that states by how much the loops fail to close, or that the pose or `near` is singular."""
    A, B, C = loop_equation(geometry.packed(), sliders)
    reach, needed = math.hypot(A, B), abs(C)
    readings = "{}sliders ({}, {}, {})".format(place, *(worded(slider, "m") for slider in sliders))
    if needed > reach * (1.0 + ROUNDING):
        near_by, wanted = apart(reach, needed, "m")
        message = f"{readings}: no pose closes the loops, which reach {near_by} of the needed {wanted}"
        raise KinematicsError(message, value=reach, limit=needed)
    det = math.sqrt(max((reach - needed) * (reach + needed), 0.0))
    limit = math.sqrt(ROUNDING) * reach
    if det > 2.0 * limit:
        x, y, phi = (worded(value, unit) for value, unit in zip(near.tolist(), ("m", "m", "rad"), strict=True))
        message = f"{readings}: near = ({x}, {y}, {phi}) is a singular pose"
        raise KinematicsError(message, value=float(near[2]))
    message = f"{readings}: the mechanism is singular at these positions (|det J2| = {worded(det, 'm')})"
    raise KinematicsError(message, value=det, limit=limit)
