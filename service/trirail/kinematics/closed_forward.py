"""Compiled forward kinematics of all mechanisms: the pose of the platform for given slider positions.

The functions return error codes and write arrays in place. `legs` is Geometry.packed(), and poses are (x, y, phi).
"""

from __future__ import annotations

import math

from trirail.kinematics.algebra import add, cross, dot, scale
from trirail.kinematics.arrays import Array, Matrix, Vector
from trirail.kinematics.compiled import compiled
from trirail.kinematics.corrected import is_corrected, real_motion
from trirail.kinematics.leg import PARALLEL
from trirail.kinematics.loops import SlideLine
from trirail.kinematics.mechanism import beta, close, demand, line, move
from trirail.kinematics.recursion import ZERO

ROUNDING = 1e-15  # relative rounding error of (det J2)² = A² + B² - C², relative to A² + B²
LOOPS_OPEN, J2_SINGULAR = 4, 5  # codes of forward_into; codes 1 to 3 refer to the legs
LEGS_TYPE = "Array(f8, 3, 'C', readonly=True)"  # numba's name for the type of Geometry.packed()


@compiled()
def sign_of_det_j2(legs: Array, pose: Vector) -> float:
    """Return the sign of det J2 as -1 or 1; 0 if the pose is singular or not finite."""
    a, b, c = close(legs[0], pose), close(legs[1], pose), close(legs[2], pose)
    rows = beta(a), beta(b), beta(c)
    det = dot(rows[0], cross(rows[1], rows[2]))
    size = abs(rows[0][2]) + abs(rows[1][2]) + abs(rows[2][2])
    parallel = min(abs(a.delta), abs(b.delta), abs(c.delta)) <= PARALLEL
    return math.copysign(1.0, det) if abs(det) > PARALLEL * size and not parallel else 0.0


@compiled()
def _loop_equation(a: SlideLine, b: SlideLine, c: SlideLine) -> Vector:
    w = cross(b.u, c.u)[2], cross(c.u, a.u)[2], cross(a.u, b.u)[2]
    return (
        dot(w, (a.a, b.a, c.a)),
        dot(w, (a.b, b.b, c.b)),
        dot(w, (a.c, b.c, c.c)),
    )


@compiled(f"UniTuple(f8, 3)({LEGS_TYPE}, f8[::1])")
def loop_equation(legs: Array, sliders: Array) -> Vector:
    """Return the coefficients A, B, C [m] of the equation A cos phi + B sin phi = C, which determines phi.

    Each leg requires n_i . G = a_i cos phi + b_i sin phi - c_i. Depending on the mechanism, all normals n_i rotate
    together, or all are fixed. If w_i is the sine of the angle between the cross slides of the two other legs, then sum
    w_i n_i = 0 at every phi. The sum of the three equations with the weights w_i therefore does not contain G.
    """
    return _loop_equation(line(legs[0], sliders[0]), line(legs[1], sliders[1]), line(legs[2], sliders[2]))


@compiled()
def _forward(legs: Array, sliders: Array | Vector, near: Array, pose: Array) -> int:
    """Write the pose for given slider positions, without applying a correction for as-built errors."""
    for i in range(3):
        if not math.isfinite(sliders[i]):
            return 1 + i
    lines = line(legs[0], sliders[0]), line(legs[1], sliders[1]), line(legs[2], sliders[2])
    A, B, C = _loop_equation(lines[0], lines[1], lines[2])
    square = A * A + B * B
    if square - C * C < -ROUNDING * square:
        return LOOPS_OPEN
    # det J2 = A sin phi - B cos phi. The two solutions have different signs of det J2. On a path without a singularity,
    # the sign does not change.
    sign = sign_of_det_j2(legs, (near[0], near[1], near[2]))
    if sign == 0.0 or not square - C * C > ROUNDING * square:
        return J2_SINGULAR
    det = sign * math.sqrt(square - C * C)
    cosine, sine = (A * C - B * det) / square, (B * C + A * det) / square
    pose[2] = math.atan2(sine, cosine)
    # At this phi, the three equations for n . G have a common solution. Least squares treats all three equally.
    xx = xy = yy = x = y = 0.0
    code = 0
    for i, each in enumerate(lines):
        n, u, distance = demand(legs[i], each, cosine, sine)
        xx, xy, yy = xx + n[0] * n[0], xy + n[0] * n[1], yy + n[1] * n[1]
        x, y = x + n[0] * distance, y + n[1] * distance
        if not abs(cross(each.rail, u)[2]) > PARALLEL:
            code = 1 + i
    pose[0] = (yy * x - xy * y) / (xx * yy - xy * xy)
    pose[1] = (xx * y - xy * x) / (xx * yy - xy * xy)
    return code


@compiled()
def _forward_real(legs: Array, sliders: Array, near: Array, pose: Array) -> int:
    code = _forward(legs, sliders, near, pose)
    if code == 0 and is_corrected(legs):
        pose[0], pose[1], pose[2] = real_motion(legs, ((pose[0], pose[1], pose[2]), ZERO, ZERO))[0]
    return code


@compiled(f"i8({LEGS_TYPE}, f8[::1], f8[::1], f8[::1])")
def forward_into(legs: Array, sliders: Array, near: Array, pose: Array) -> int:
    """Write the pose for given slider positions. The function raises no exception and allocates no memory.

    `sliders`, `near` and `pose` have shape (3,). `near` is a pose on the desired branch, and may be the same array as
    `pose`. Returns 0 if successful; 1 + i if slider i is not finite or the cross slide of leg i is parallel to its
    rail; 4 if no pose closes the loops; 5 if J2 is singular at the pose or at `near`. After an error, `pose` is
    undefined.
    """
    return _forward_real(legs, sliders, near, pose)


@compiled(f"i8({LEGS_TYPE}, f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def forward_batch(legs: Array, sliders: Array, near: Array, poses: Array) -> int:
    """Apply forward_into to arrays (N, 3). If row k fails, return 5 k plus the code of forward_into; otherwise 0."""
    for k in range(len(sliders)):
        code = _forward_real(legs, sliders[k], near[k], poses[k])
        if code != 0:
            return 5 * k + code
    return 0


@compiled()
def _solve(rows: tuple[Vector, Vector, Vector], right: Vector) -> Vector:
    """Solve three linear equations by Cramer's rule."""
    a, b, c = rows
    by_a, by_b, by_c = cross(b, c), cross(c, a), cross(a, b)
    det = dot(a, by_a)
    total = add(add(scale(right[0], by_a), scale(right[1], by_b)), scale(right[2], by_c))
    return scale(1.0 / det, total)


@compiled()
def forward_motion(legs: Array, sliders: Matrix, near: Array, motion: Array) -> int:
    """Write pose, velocity and acceleration of the platform, (3, 3), for given motion of the sliders.

    The rows of `sliders` are position, velocity and acceleration. By (16), J2 times the velocity of the platform equals
    J1 times the velocity of the sliders. The same equation applies to the accelerations after subtracting an offset:
    the acceleration of the sliders if the platform has this velocity, but no acceleration. Returns a code of
    forward_into.
    """
    code = _forward(legs, sliders[0], near, motion[0])
    if code != 0:
        return code
    pose = motion[0, 0], motion[0, 1], motion[0, 2]
    a, b, c = close(legs[0], pose), close(legs[1], pose), close(legs[2], pose)
    j2 = beta(a), beta(b), beta(c)
    rates = a.delta * sliders[1][0], b.delta * sliders[1][1], c.delta * sliders[1][2]
    velocity = _solve(j2, rates)
    motion[1, 0], motion[1, 1], motion[1, 2] = velocity
    for i in range(3):
        leg = move(legs[i], pose, velocity, ZERO)
        if not leg.regular:
            return 1 + i
        motion[2, i] = leg.closed.delta * (sliders[2][i] - leg.acceleration)
    acceleration = _solve(j2, (motion[2, 0], motion[2, 1], motion[2, 2]))
    motion[2, 0], motion[2, 1], motion[2, 2] = acceleration
    if is_corrected(legs):
        real = real_motion(legs, (pose, velocity, acceleration))
        for i in range(3):
            motion[i, 0], motion[i, 1], motion[i, 2] = real[i]
    return 0
