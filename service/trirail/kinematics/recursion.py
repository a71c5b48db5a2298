"""Matrix recursion for a planar serial leg with prismatic and revolute joints: equations (2) to (20) of the paper.

Frames and symbols are those of the paper, except that q denotes the matrices of any leg (the paper uses a for leg A).
T_0 is the base. The frame of link T_k, k = 1 ... n, has its origin at A_k and its z axis along joint k. A prismatic
joint moves along this axis by lambda_{k,k-1} [m], and a revolute joint rotates about this axis by phi_{k,k-1} [rad].
The matrix q_{k,k-1} transforms components from T_{k-1} to T_k, and its transpose transforms them back. The leg moves in
the plane x_0 y_0: prismatic axes are in this plane, and revolute axes are normal to it. The last link is the platform,
or is fixed to the platform. The vector r_n^G leads from A_n to the centre G of the platform.

A leg is a float64 array of shape (n + 1, 13), created by `joints.serial_leg`. It has one row per joint, and a last row
for G:

    column  0        1 for a revolute joint, 0 for a prismatic joint
    columns 1 to 3   the constant part of r_{k,k-1}, in T_{k-1} [m]; in the last row r_n^G, in T_n
    columns 4 to 12  the constant part of q_{k,k-1}, row by row

The motion of the platform is described by x, y, phi (position of G in T_0 [m] and rotation about z_0 [rad]) and their
time derivatives. The functions do not check for singular or non-finite values, and return infinity or NaN. The loop
closure checks the results.
"""

from __future__ import annotations

from typing import NamedTuple

from trirail.kinematics.algebra import (
    add,
    cross,
    dot,
    plus_u3,
    product,
    scale,
    subtract,
    times,
    transposed_times,
    turned,
)
from trirail.kinematics.arrays import Array, Matrix, Vector
from trirail.kinematics.compiled import inlined

__all__ = [
    "AT_REST",
    "BASE",
    "Link",
    "LinkMotion",
    "follow",
    "joint_motion",
    "link",
    "link_motion",
    "platform_centre",
    "platform_motion",
]


class Link(NamedTuple):
    """Position and orientation of link T_k."""

    revolute: bool
    a: Matrix  # q_{k,k-1}
    r: Vector  # r_{k,k-1}, in T_{k-1}
    q: Matrix  # q_k0
    p: Vector  # A_k, in T_0


class LinkMotion(NamedTuple):
    """Motion of link T_k relative to the base, in components of T_k."""

    omega: Vector  # omega_k0
    v: Vector  # v_k0, the velocity of A_k
    epsilon: Vector  # epsilon_k0
    gamma: Vector  # gamma_k0, the acceleration of A_k


ZERO: Vector = (0.0, 0.0, 0.0)
U3: Vector = (0.0, 0.0, 1.0)
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), U3)
BASE = Link(False, IDENTITY, ZERO, IDENTITY, ZERO)
AT_REST = LinkMotion(ZERO, ZERO, ZERO, ZERO)


@inlined
def _constant_vector(leg: Array, k: int) -> Vector:
    return leg[k, 1], leg[k, 2], leg[k, 3]


@inlined
def _constant_matrix(leg: Array, k: int) -> Matrix:
    row = leg[k]
    return (row[4], row[5], row[6]), (row[7], row[8], row[9]), (row[10], row[11], row[12])


@inlined
def link(base: Link, leg: Array, k: int, variable: float) -> Link:
    """Return the link after the joint in row k of a leg, given the link `base` before the joint.

    `variable` is the position of the joint [m or rad].
    """
    revolute = leg[k, 0] != 0.0
    a = _constant_matrix(leg, k)
    r = _constant_vector(leg, k)
    if revolute:
        a = turned(variable, a)  # (2): q_{k,k-1} = q^phi theta
    else:
        r = add(r, scale(variable, a[2]))  # (10): lambda_{k,k-1} q_{k,k-1}ᵀ u3
    q = product(a, base.q)  # (3)
    p = add(base.p, transposed_times(base.q, r))  # (9)
    return Link(revolute, a, r, q, p)


@inlined
def platform_centre(leg: Array, last: Link) -> Vector:
    """Return the position of G in T_0, which is the complete left side of (9)."""
    return add(last.p, transposed_times(last.q, _constant_vector(leg, len(leg) - 1)))


@inlined
def _spin(omega: Vector, epsilon: Vector, r: Vector) -> Vector:
    """Return (ω̃ ω̃ + ε̃) r."""
    return add(cross(omega, cross(omega, r)), cross(epsilon, r))


@inlined
def link_motion(base: LinkMotion, link: Link, rate: float, acceleration: float) -> LinkMotion:
    """Return the motion of a link, given the motion of the link before and the rate and acceleration of the joint."""
    omega_k, v_k = (rate, 0.0) if link.revolute else (0.0, rate)
    epsilon_k, gamma_k = (acceleration, 0.0) if link.revolute else (0.0, acceleration)
    a, r = link.a, link.r
    carried = times(a, base.omega)  # the vector of a ω̃_{k-1,0} aᵀ
    carried_u3 = (carried[1], -carried[0], 0.0)  # a ω̃_{k-1,0} aᵀ u3

    # (13), which has the vectors of the matrices in (12)
    omega = plus_u3(carried, omega_k)
    # (14)
    v = plus_u3(times(a, add(base.v, cross(base.omega, r))), v_k)
    # (20), first line. The second line, for ω̃ ω̃ + ε̃, follows from the first line and (12).
    epsilon = plus_u3(add(times(a, base.epsilon), scale(omega_k, carried_u3)), epsilon_k)
    # (20), last line. The Coriolis term ends in the vector u3. The paper misprints it as the matrix ũ3.
    gamma = times(a, add(base.gamma, _spin(base.omega, base.epsilon, r)))
    gamma = plus_u3(add(gamma, scale(2.0 * v_k, carried_u3)), gamma_k)
    return LinkMotion(omega, v, epsilon, gamma)


@inlined
def platform_motion(leg: Array, last: Link, motion: LinkMotion) -> tuple[Vector, Vector]:
    """Return velocity and acceleration (x, y, phi) of the platform, given the motion of the last link of a leg."""
    r = _constant_vector(leg, len(leg) - 1)
    vx, vy, _ = transposed_times(last.q, add(motion.v, cross(motion.omega, r)))
    ax, ay, _ = transposed_times(last.q, add(motion.gamma, _spin(motion.omega, motion.epsilon, r)))
    _, _, omega = transposed_times(last.q, motion.omega)
    _, _, epsilon = transposed_times(last.q, motion.epsilon)
    return (vx, vy, omega), (ax, ay, epsilon)


@inlined
def follow(leg: Array, joints: Array) -> tuple[Link, LinkMotion]:
    """Return position and motion of link T_k, given the motion of the joints 1 to k.

    The columns of `joints` are position, rate and acceleration.
    """
    place, motion = BASE, AT_REST
    for k in range(len(joints)):
        place = link(place, leg, k, joints[k, 0])
        motion = link_motion(motion, place, joints[k, 1], joints[k, 2])
    return place, motion


@inlined
def _unit_velocity(link: Link, centre: Vector) -> Vector:
    """Return the velocity (x, y, phi) of the platform for a unit rate of a joint: its factors in (15)."""
    axis = link.q[2]  # q_k0ᵀ u3
    if link.revolute:
        x, y, _ = cross(axis, subtract(centre, link.p))
        return x, y, axis[2]
    return axis[0], axis[1], 0.0


@inlined
def joint_motion(leg: Array, variables: Vector, velocity: Vector, acceleration: Vector) -> tuple[Vector, Vector]:
    """Return rates and accelerations of the three joints of a leg for a motion of the platform, by (15) and (19).

    With three joints, a leg can follow any planar motion. The unknowns of (15) and of (19) have the same factors, the
    unit velocities j. The right side of (19) is the acceleration of the platform minus the acceleration that (20) gives
    for joints with constant rates. For a PRP leg, the equations are those of the paper, with two differences: the
    factor lambda_32, which is missing in the omega_21² term of (19) in the paper, and epsilon_21 = d²phi/dt².
    """
    first = link(BASE, leg, 0, variables[0])
    second = link(first, leg, 1, variables[1])
    third = link(second, leg, 2, variables[2])
    centre = platform_centre(leg, third)

    j1, j2, j3 = _unit_velocity(first, centre), _unit_velocity(second, centre), _unit_velocity(third, centre)
    adjugate = cross(j2, j3), cross(j3, j1), cross(j1, j2)
    scaling = 1.0 / dot(j1, adjugate[0])
    rates = scale(scaling, times(adjugate, velocity))  # (15)

    motion = link_motion(AT_REST, first, rates[0], 0.0)
    motion = link_motion(motion, second, rates[1], 0.0)
    motion = link_motion(motion, third, rates[2], 0.0)
    _, at_constant_rates = platform_motion(leg, third, motion)
    remainder = subtract(acceleration, at_constant_rates)
    return rates, scale(scaling, times(adjugate, remainder))  # (19)
