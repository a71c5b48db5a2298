"""Compiled loop closure of all mechanisms: inverse kinematics and Jacobians.

The functions return error codes and write arrays in place. `legs` is Geometry.packed(), and poses are (x, y, phi).
"""

from __future__ import annotations

import math

from trirail.kinematics.algebra import times
from trirail.kinematics.arrays import Array
from trirail.kinematics.closed_forward import LEGS_TYPE
from trirail.kinematics.compiled import compiled
from trirail.kinematics.corrected import corrected_motion, is_corrected
from trirail.kinematics.leg import PARALLEL
from trirail.kinematics.mechanism import beta, close, move
from trirail.kinematics.recursion import ZERO

UNIT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@compiled()
def inverse_motion(legs: Array, motion: Array, out: Array) -> int:
    """Write the motion of all joints for a motion of the platform. Compiled code calls this instead of inverse_into."""
    commanded = (
        (motion[0, 0], motion[0, 1], motion[0, 2]),
        (motion[1, 0], motion[1, 1], motion[1, 2]),
        (motion[2, 0], motion[2, 1], motion[2, 2]),
    )
    if is_corrected(legs):
        commanded = corrected_motion(legs, commanded)
    for i in range(3):
        leg = move(legs[i], commanded[0], commanded[1], commanded[2])
        out[0, i], out[1, i], out[2, i] = leg.closed.slider, leg.rate, leg.acceleration
        out[3, i], out[4, i], out[5, i] = leg.closed.passive, leg.passive_rate, leg.passive_acceleration
        if not leg.regular:
            return 1 + i
    return 0


@compiled(f"i8({LEGS_TYPE}, f8[:, ::1], f8[:, ::1])")
def inverse_into(legs: Array, motion: Array, out: Array) -> int:
    """Write the motion of all joints for a motion of the platform. It raises no exception and allocates no memory.

    The rows of `motion` (3, 3) are pose, velocity, acceleration in m, rad, s. The rows of `out` (6, 3) are position,
    velocity and acceleration of the sliders, then of the cross slides, with one column for each leg. Returns 0, or 1 +
    i if leg i is singular or a number is not finite. After an error, `out` is undefined.
    """
    return inverse_motion(legs, motion, out)


@compiled(f"i8({LEGS_TYPE}, f8[:, :, ::1], f8[:, :, ::1])")
def inverse_batch(legs: Array, motion: Array, out: Array) -> int:
    """Apply inverse_into to `motion` (3, N, 3) and `out` (6, N, 3). Return 0, or 3 k plus the code if row k fails."""
    for k in range(motion.shape[1]):
        code = inverse_motion(legs, motion[:, k], out[:, k])
        if code != 0:
            return 3 * k + code
    return 0


@compiled(f"i8({LEGS_TYPE}, f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1])")
def jacobians_batch(legs: Array, poses: Array, j1: Array, j2: Array) -> int:
    """Write the diagonal of J1 and all elements of J2, (17), for poses (N, 3). Returns a code of inverse_batch.

    `j1` and `j2` have shape (N, 3, 3).
    """
    for k in range(len(poses)):
        pose, by_pose = (poses[k, 0], poses[k, 1], poses[k, 2]), UNIT
        if is_corrected(legs):  # rows of by_pose: derivatives of the corrected pose with respect to x, y and phi
            by_pose = (
                corrected_motion(legs, (pose, UNIT[0], ZERO))[1],
                corrected_motion(legs, (pose, UNIT[1], ZERO))[1],
                corrected_motion(legs, (pose, UNIT[2], ZERO))[1],
            )
            pose = corrected_motion(legs, (pose, ZERO, ZERO))[0]
        for i in range(3):
            closed = close(legs[i], pose)
            j1[k, i, i] = closed.delta
            j2[k, i, 0], j2[k, i, 1], j2[k, i, 2] = times(by_pose, beta(closed))
            if not (abs(closed.delta) > PARALLEL and math.isfinite(j2[k, i, 2])):
                return 3 * k + 1 + i
    return 0
