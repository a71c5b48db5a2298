"""The closed loops of the 3-PRP robot: three PRP legs of the recursion, joined at the platform; compiled.

Here errors are codes and arrays are written in place. `legs` is Geometry.packed(), poses are (x, y, phi).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from trirail.kinematics.algebra import add, cross, dot, scale, subtract, times
from trirail.kinematics.arrays import Array, Matrix, Vector
from trirail.kinematics.compiled import compiled
from trirail.kinematics.corrected import corrected_motion, is_corrected, real_motion
from trirail.kinematics.geometry import PARALLEL
from trirail.kinematics.recursion import BASE, ZERO, joint_motion, link, platform_centre

__all__ = [
    "J2_SINGULAR",
    "LOOPS_OPEN",
    "ROUNDING",
    "forward_batch",
    "forward_into",
    "forward_motion",
    "inverse_batch",
    "inverse_into",
    "inverse_motion",
    "jacobians_batch",
    "loop_equation",
]

ROUNDING = 1e-15  # part of the squares whose difference is (det J2)² that their rounding can make up
LOOPS_OPEN, J2_SINGULAR = 4, 5  # codes of forward_into; 1 to 3 are the legs'
UNIT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

LEGS_TYPE = "Array(f8, 3, 'C', readonly=True)"  # numba's name for what Geometry.packed() returns


class ClosedLeg(NamedTuple):
    """A leg whose last link has the platform's pose."""

    lambda_10: float
    lambda_32: float
    delta: float  # delta_i of (18): the sine of the angle from rail to edge
    edge: Vector  # q_30ᵀ u3, the direction (cos psi_i, sin psi_i, 0) of the edge
    to_centre: Vector  # from A_2 to G, in T_0


@compiled()
def _close(leg: Array, pose: Vector) -> ClosedLeg:
    """Solve (11), linear once phi_21 = phi by (8): how far must rail and edge move to bring G to the pose?"""
    first = link(BASE, leg, 0, 0.0)
    third = link(link(first, leg, 1, pose[2]), leg, 2, 0.0)
    rail, edge = first.q[2], third.q[2]
    centre = pose[0], pose[1], 0.0
    gap = subtract(centre, platform_centre(leg, third))
    delta = cross(rail, edge)[2]
    lambda_10 = cross(gap, edge)[2] / delta
    lambda_32 = cross(rail, gap)[2] / delta
    pin = add(third.p, scale(lambda_10, rail))
    return ClosedLeg(lambda_10, lambda_32, delta, edge, subtract(centre, pin))


class MovingLeg(NamedTuple):
    """A closed leg whose platform moves."""

    closed: ClosedLeg
    rates: Vector  # of its three joints
    accelerations: Vector
    regular: bool  # else the leg is singular, or a number is not finite


@compiled()
def _move(leg: Array, pose: Vector, velocity: Vector, acceleration: Vector) -> MovingLeg:
    """Solve a leg for the motion of its platform."""
    closed = _close(leg, pose)
    variables = closed.lambda_10, pose[2], closed.lambda_32
    rates, accelerations = joint_motion(leg, variables, velocity, acceleration)
    sliders = closed.lambda_10 + rates[0] + accelerations[0]
    total = sliders + closed.lambda_32 + rates[2] + accelerations[2]
    return MovingLeg(closed, rates, accelerations, abs(closed.delta) > PARALLEL and math.isfinite(total))


@compiled()
def inverse_motion(legs: Array, motion: Array, out: Array) -> int:
    """Do inverse_into, from compiled code."""
    told = (
        (motion[0, 0], motion[0, 1], motion[0, 2]),
        (motion[1, 0], motion[1, 1], motion[1, 2]),
        (motion[2, 0], motion[2, 1], motion[2, 2]),
    )
    if is_corrected(legs):
        told = corrected_motion(legs, told)
    for i in range(3):
        leg = _move(legs[i], told[0], told[1], told[2])
        out[0, i], out[1, i], out[2, i] = leg.closed.lambda_10, leg.rates[0], leg.accelerations[0]
        out[3, i], out[4, i], out[5, i] = leg.closed.lambda_32, leg.rates[2], leg.accelerations[2]
        if not leg.regular:
            return 1 + i
    return 0


@compiled(f"i8({LEGS_TYPE}, f8[:, ::1], f8[:, ::1])")
def inverse_into(legs: Array, motion: Array, out: Array) -> int:
    """Write the motion of all joints for one motion of the platform; raises and allocates nothing.

    `motion` (3, 3) holds the rows pose, velocity, acceleration in m, rad, s; `out` (6, 3), a column for each
    leg, gets the rows lambda_10, v_10, gamma_10, lambda_32, v_32, gamma_32. Returns 0, or 1 + i if leg i is
    singular or a number is not finite; then `out` means nothing.
    """
    return inverse_motion(legs, motion, out)


@compiled(f"i8({LEGS_TYPE}, f8[:, :, ::1], f8[:, :, ::1])")
def inverse_batch(legs: Array, motion: Array, out: Array) -> int:
    """Do inverse_into for `motion` (3, N, 3) and `out` (6, N, 3); the codes of row k begin after 3 k."""
    for k in range(motion.shape[1]):
        code = inverse_motion(legs, motion[:, k], out[:, k])
        if code != 0:
            return 3 * k + code
    return 0


@compiled()
def _beta(closed: ClosedLeg) -> Vector:
    """Return the leg's row of J2, (18)."""
    return closed.edge[1], -closed.edge[0], dot(closed.edge, closed.to_centre)


@compiled(f"i8({LEGS_TYPE}, f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1])")
def jacobians_batch(legs: Array, poses: Array, j1: Array, j2: Array) -> int:
    """Write the diagonals of J1 and all of J2, (17), (N, 3, 3), for poses (N, 3); codes of inverse_batch."""
    for k in range(len(poses)):
        pose, by_pose = (poses[k, 0], poses[k, 1], poses[k, 2]), UNIT
        if is_corrected(legs):  # the rows of by_pose are the derivatives of what the legs are told by x, y and phi
            by_pose = (
                corrected_motion(legs, (pose, UNIT[0], ZERO))[1],
                corrected_motion(legs, (pose, UNIT[1], ZERO))[1],
                corrected_motion(legs, (pose, UNIT[2], ZERO))[1],
            )
            pose = corrected_motion(legs, (pose, ZERO, ZERO))[0]
        for i in range(3):
            closed = _close(legs[i], pose)
            j1[k, i, i] = closed.delta
            j2[k, i, 0], j2[k, i, 1], j2[k, i, 2] = times(by_pose, _beta(closed))
            if not (abs(closed.delta) > PARALLEL and math.isfinite(j2[k, i, 2])):
                return 3 * k + 1 + i
    return 0


@compiled()
def _sign_of_det_j2(legs: Array, pose: Vector) -> float:
    """Return -1, 1, or 0 if the pose is singular or not finite."""
    a, b, c = _close(legs[0], pose), _close(legs[1], pose), _close(legs[2], pose)
    rows = _beta(a), _beta(b), _beta(c)
    det = dot(rows[0], cross(rows[1], rows[2]))
    size = abs(rows[0][2]) + abs(rows[1][2]) + abs(rows[2][2])
    parallel = min(abs(a.delta), abs(b.delta), abs(c.delta)) <= PARALLEL
    return math.copysign(1.0, det) if abs(det) > PARALLEL * size and not parallel else 0.0


class Edge(NamedTuple):
    """An edge of the platform, not yet turned, and the pin through which its leg's slider makes it pass."""

    pin: Vector  # A_2, in T_0
    rail: Vector  # direction of the rail
    u: Vector  # direction of the edge
    n: Vector  # normal of the edge, (beta_1, beta_2, 0) of (18)
    c: float  # n . (pin - G), the same at every phi, since n turns with the platform


@compiled()
def _edge(leg: Array, slider: float) -> Edge:
    first = link(BASE, leg, 0, slider)
    third = link(link(first, leg, 1, 0.0), leg, 2, 0.0)
    u = third.q[2]
    n = u[1], -u[0], 0.0
    return Edge(third.p, first.q[2], u, n, dot(n, subtract(third.p, platform_centre(leg, third))))


@compiled()
def _loop_equation(a: Edge, b: Edge, c: Edge) -> Vector:
    w = cross(b.u, c.u)[2], cross(c.u, a.u)[2], cross(a.u, b.u)[2]
    return (
        dot(w, (dot(a.n, a.pin), dot(b.n, b.pin), dot(c.n, c.pin))),
        dot(w, (dot(a.u, a.pin), dot(b.u, b.pin), dot(c.u, c.pin))),
        dot(w, (a.c, b.c, c.c)),
    )


@compiled(f"UniTuple(f8, 3)({LEGS_TYPE}, f8[::1])")
def loop_equation(legs: Array, sliders: Array) -> Vector:
    """Return A, B, C [m] of the equation A cos phi + B sin phi = C that the three loops leave for phi.

    Each leg demands n_i . (pin_i - G) = c_i. The normals n_i turn together, so with the sines w_i between the
    edges sum w_i n_i = 0 at every phi, and the sum of the demands with these weights is free of G.
    """
    return _loop_equation(_edge(legs[0], sliders[0]), _edge(legs[1], sliders[1]), _edge(legs[2], sliders[2]))


@compiled()
def _forward(legs: Array, sliders: Array | Vector, near: Array, pose: Array) -> int:
    """Write the pose of the legs as configured, without a correction."""
    for i in range(3):
        if not math.isfinite(sliders[i]):
            return 1 + i
    edges = _edge(legs[0], sliders[0]), _edge(legs[1], sliders[1]), _edge(legs[2], sliders[2])
    A, B, C = _loop_equation(edges[0], edges[1], edges[2])
    square = A * A + B * B
    if square - C * C < -ROUNDING * square:
        return LOOPS_OPEN
    # det J2 = A sin phi - B cos phi: it differs in sign between the two solutions, and keeps it on any path
    # that does not pass a singularity.
    sign = _sign_of_det_j2(legs, (near[0], near[1], near[2]))
    if sign == 0.0 or not square - C * C > ROUNDING * square:
        return J2_SINGULAR
    det = sign * math.sqrt(square - C * C)
    cosine, sine = (A * C - B * det) / square, (B * C + A * det) / square
    pose[2] = math.atan2(sine, cosine)
    # The demands n . G = n . pin - c agree at this phi; least squares, to favour none.
    xx = xy = yy = x = y = 0.0
    code = 0
    for i, edge in enumerate(edges):
        n = add(scale(cosine, edge.n), scale(sine, edge.u))
        u = subtract(scale(cosine, edge.u), scale(sine, edge.n))
        distance = dot(n, edge.pin) - edge.c
        xx, xy, yy = xx + n[0] * n[0], xy + n[0] * n[1], yy + n[1] * n[1]
        x, y = x + n[0] * distance, y + n[1] * distance
        if not abs(cross(edge.rail, u)[2]) > PARALLEL:
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
    """Write the pose at which the sliders stand as given; raises and allocates nothing.

    `sliders`, `near` and `pose` have shape (3,); `near` is a pose on the wanted branch, and may be `pose`
    itself. Returns 0; 1 + i if slider i is not finite or the edge of leg i is parallel to its rail; 4 if no
    pose closes the loops; 5 if J2 is singular, or `near` is. Then `pose` means nothing.
    """
    return _forward_real(legs, sliders, near, pose)


@compiled(f"i8({LEGS_TYPE}, f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def forward_batch(legs: Array, sliders: Array, near: Array, poses: Array) -> int:
    """Do forward_into for arrays (N, 3); the codes of row k begin after 5 k."""
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
    """Write the platform's pose, velocity and acceleration (3, 3) for those of the sliders, three rows.

    From (16): J2 times the platform's velocity is J1 times the sliders'. Their accelerations are linear in the
    platform's, with the same matrices: what they are without it is subtracted. Codes of forward_into.
    """
    code = _forward(legs, sliders[0], near, motion[0])
    if code != 0:
        return code
    pose = motion[0, 0], motion[0, 1], motion[0, 2]
    a, b, c = _close(legs[0], pose), _close(legs[1], pose), _close(legs[2], pose)
    j2 = _beta(a), _beta(b), _beta(c)
    rates = a.delta * sliders[1][0], b.delta * sliders[1][1], c.delta * sliders[1][2]
    velocity = _solve(j2, rates)
    motion[1, 0], motion[1, 1], motion[1, 2] = velocity
    for i in range(3):
        leg = _move(legs[i], pose, velocity, ZERO)
        if not leg.regular:
            return 1 + i
        motion[2, i] = leg.closed.delta * (sliders[2][i] - leg.accelerations[0])
    acceleration = _solve(j2, (motion[2, 0], motion[2, 1], motion[2, 2]))
    motion[2, 0], motion[2, 1], motion[2, 2] = acceleration
    if is_corrected(legs):
        real = real_motion(legs, (pose, velocity, acceleration))
        for i in range(3):
            motion[i, 0], motion[i, 1], motion[i, 2] = real[i]
    return 0
