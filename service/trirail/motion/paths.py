"""Paths as piecewise polynomials in time, and laws that map real time to time along a path.

A path has knots (n + 1,) in seconds and pieces (n, d, 6). For each of d coordinates, a piece holds the coefficients of
ascending powers of the time since the knot at which the piece begins. A law is a path with one coordinate: s, the time
along another path, as a function of real time. The functions are compiled and return error codes.

In pose space, a path describes the motion of one point of the platform, the tool. The coordinates are the position T of
the tool in the base frame [m], and phi. The platform is a rigid body. If the tool is at t in the platform's frame, the
centre of the platform is at p = T - R(phi) t. Only this module converts paths into platform poses.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trirail.kinematics.algebra import copy_vector
from trirail.kinematics.arrays import Array, Vector
from trirail.kinematics.closed_forward import LEGS_TYPE, forward_motion
from trirail.kinematics.compiled import compiled

__all__ = [
    "CENTRE_TOOLS",
    "Path",
    "constant_law",
    "earliest_time",
    "evaluate",
    "is_valid_path",
    "law_at",
    "law_falls",
    "passing_time",
    "path_motion",
    "platform_at",
    "platform_at_law_time",
    "tool_at",
    "transfer_to_point",
]

LAST_PIECE_S = 1e9
"""Duration of the last piece of a law, which has a constant rate and in practice never ends [s]."""
BISECTIONS = 48
"""Number of bisection steps after which an interval is narrower than the resolution of a float."""
ROUNDING = 1e-9
"""Tolerance for rounding errors of positions and times [m, rad, s]."""
OUTWARD_ROUNDING = 1e-12
"""Outward motion beyond a limit that is treated as rounding [m, rad]. The last gate allows it in each cycle."""
MAX_TIME_FALL_S = 1e-12
"""Greatest decrease of the time along a path that is treated as rounding, near the start of the path [s]."""
RELATIVE_TIME_FALL = 4.0 * float(np.finfo(np.float64).eps)
"""Greatest decrease that is treated as rounding after hours on a path, as a fraction of the time along the path."""
CENTRE_TOOLS = np.zeros((0, 2))
"""Value of Path.tools for a path that describes the motion of the platform's centre."""


class Path(NamedTuple):
    """Motion as a function of time, in pose space or in slider space."""

    knots: Array
    pieces: Array
    in_sliders: bool = False
    tools: Array = CENTRE_TOOLS
    """Point of the platform that each piece describes, (n, 2) in the platform's frame [m]; CENTRE_TOOLS for the
    centre."""

    @property
    def duration(self) -> float:
        """Time from the first knot, which is at zero, to the last knot [s]."""
        return float(self.knots[-1])

    @property
    def end(self) -> Array:
        """Last position, (d,), in the coordinates of the path."""
        end: Array = self.pieces[-1] @ (self.knots[-1] - self.knots[-2]) ** np.arange(6.0)
        return end


@compiled()
def _find_piece(knots: Array, time: float) -> int:
    low, high = 0, len(knots) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if time < knots[middle]:
            high = middle
        else:
            low = middle
    return low


class PieceTime(NamedTuple):
    """Index of a piece, time since the start of the piece [s], and True if the time is within the path."""

    piece: int
    time: float
    inside: bool


@compiled()
def _locate(knots: Array, time: float) -> PieceTime:
    at = min(max(time, knots[0]), knots[-1])
    k = _find_piece(knots, at)
    return PieceTime(k, at - knots[k], knots[0] <= time <= knots[-1])


@compiled()
def _evaluate_polynomial(p: Array, at: PieceTime) -> Vector:
    """Return the value and the first two derivatives of a polynomial. The derivatives are zero outside the path."""
    t = at.time
    position = p[0] + t * (p[1] + t * (p[2] + t * (p[3] + t * (p[4] + t * p[5]))))
    if not at.inside:
        return position, 0.0, 0.0
    velocity = p[1] + t * (2.0 * p[2] + t * (3.0 * p[3] + t * (4.0 * p[4] + t * 5.0 * p[5])))
    acceleration = 2.0 * p[2] + t * (6.0 * p[3] + t * (12.0 * p[4] + t * 20.0 * p[5]))
    return position, velocity, acceleration


@compiled()
def evaluate_path(knots: Array, pieces: Array, time: float, out: Array) -> None:
    """Write the value and the first two derivatives of a path at a time into `out` (3, d), from compiled code."""
    at = _locate(knots, time)
    for i in range(pieces.shape[1]):
        out[0, i], out[1, i], out[2, i] = _evaluate_polynomial(pieces[at.piece, i], at)


@compiled()
def tool_at(knots: Array, tools: Array, time: float) -> tuple[float, float]:
    """Return the tool of a path at a time along the path, (u, v) in the platform's frame [m]."""
    if len(tools) == 0:
        return 0.0, 0.0
    piece = _locate(knots, time).piece
    return tools[piece, 0], tools[piece, 1]


@compiled("void(f8[:, ::1], f8, f8)")
def transfer_to_point(motion: Array, u: float, v: float) -> None:
    """Replace the motion of one point of the platform by the motion of another point, in place.

    The rows of `motion` (3, 3) are x, y, phi, their first and their second derivatives. (u, v) is the vector from the
    first point to the second, in the platform's frame [m]. With r = R(phi) (u, v), and with r_ as r rotated by 90°, the
    rows become p + r, p' + phi' r_ and p'' + phi'' r_ - phi'^2 r.
    """
    if u == 0.0 and v == 0.0:
        return
    c, s = math.cos(motion[0, 2]), math.sin(motion[0, 2])
    x, y = c * u - s * v, s * u + c * v
    rate, change = motion[1, 2], motion[2, 2]
    motion[0, 0] += x
    motion[0, 1] += y
    motion[1, 0] -= rate * y
    motion[1, 1] += rate * x
    motion[2, 0] -= change * y + rate * rate * x
    motion[2, 1] += change * x - rate * rate * y


@compiled()
def law_at(knots: Array, pieces: Array, time: float) -> Vector:
    """Return the state of a law at a time [s]: time along the path [s], the rate, and the change of the rate [1/s]."""
    at = _locate(knots, time)
    return _evaluate_polynomial(pieces[at.piece, 0], at)


@compiled("void(f8[::1], f8[:, :, ::1], f8, f8[:, ::1])")
def evaluate(knots: Array, pieces: Array, time: float, out: Array) -> None:
    """Write the value and the first two derivatives of a path at a time [s] into `out` (3, d)."""
    evaluate_path(knots, pieces, time, out)


@compiled()
def motion_at(knots: Array, pieces: Array, tools: Array, law: Vector, out: Array) -> None:
    """Write the motion of the sliders or of the platform's centre for a state of the law.

    The rows of `out` (3, 3) are the value and the first two derivatives.
    """
    s, rate, change = law
    evaluate_path(knots, pieces, s, out)
    for i in range(3):
        out[2, i] = out[2, i] * rate * rate + out[1, i] * change
        out[1, i] *= rate
    u, v = tool_at(knots, tools, s)
    transfer_to_point(out, -u, -v)


@compiled("void(f8[::1], f8[:, :, ::1], f8[:, ::1], f8, f8[:, ::1])")
def path_motion(knots: Array, pieces: Array, tools: Array, time: float, out: Array) -> None:
    """Write the motion (3, 3) of the sliders or the platform's centre at a time along the path [s], at full speed."""
    motion_at(knots, pieces, tools, (time, 1.0, 0.0), out)


@compiled()
def platform_at(
    legs: Array, knots: Array, pieces: Array, in_sliders: bool, tools: Array, law: Vector, near: Array, out: Array
) -> int:
    """Write the pose, velocity and acceleration (3, 3) of the platform for a state of the law.

    For a path in slider space, the pose `near` selects the branch of the forward kinematics. Returns 0, or a code of
    forward_into.
    """
    motion_at(knots, pieces, tools, law, out)
    if not in_sliders:
        return 0
    sliders = (
        (out[0, 0], out[0, 1], out[0, 2]),
        (out[1, 0], out[1, 1], out[1, 2]),
        (out[2, 0], out[2, 1], out[2, 2]),
    )
    return forward_motion(legs, sliders, near, out)


@compiled(f"i8({LEGS_TYPE}, f8[::1], f8[:, :, ::1], b1, f8[:, ::1], f8[::1], f8[:, :, ::1], f8, f8[::1], f8[:, ::1])")
def platform_at_law_time(
    legs: Array,
    knots: Array,
    pieces: Array,
    in_sliders: bool,
    tools: Array,
    law_knots: Array,
    law_pieces: Array,
    time: float,
    near: Array,
    out: Array,
) -> int:
    """Write the motion of the platform at a time of the law [s]; see platform_at."""
    return platform_at(legs, knots, pieces, in_sliders, tools, law_at(law_knots, law_pieces, time), near, out)


@compiled(f"i8({LEGS_TYPE}, f8[::1], f8[:, :, ::1], b1, f8[:, ::1], f8[::1], f8[::1], f8[:, :, ::1])")
def platform_at_each(
    legs: Array,
    knots: Array,
    pieces: Array,
    in_sliders: bool,
    tools: Array,
    times: Array,
    near: Array,
    out: Array,
) -> int:
    """Write the motion of the platform at ascending times along a path [s] into `out` (n, 3, 3); see platform_at.

    Each pose is on the branch of the previous pose. Return 0, or the code of the first time that has no pose.
    """
    for k in range(len(times)):
        code = platform_at(legs, knots, pieces, in_sliders, tools, (times[k], 1.0, 0.0), near, out[k])
        if code != 0:
            return code
        copy_vector(out[k, 0], near)
    return 0


@compiled("b1(f8[::1], f8[::1], f8[::1])")
def is_valid_path(knots: Array, coefficients: Array, tools: Array) -> bool:
    """Return whether all numbers of a path are finite and no knot is less than the previous knot."""
    for numbers in (knots, coefficients, tools):
        for number in numbers:
            if not math.isfinite(number):
                return False
    last = knots[0]
    for knot in knots:
        if knot < last:
            return False
        last = knot
    return True


@compiled()
def earliest_time(s: float) -> float:
    """Return the earliest time along a path that differs from the time `s` only by rounding [s]."""
    return s - MAX_TIME_FALL_S - RELATIVE_TIME_FALL * abs(s)


@compiled()
def _least_bernstein_coefficient_of_rate(p: Array, span: float) -> float:
    """Return the least Bernstein coefficient of the first derivative of a polynomial of degree 5 from 0 to `span`."""
    a, b, c, d, e = p[1], 2.0 * p[2] * span, 3.0 * p[3] * span**2, 4.0 * p[4] * span**3, 5.0 * p[5] * span**4
    third = a + b / 2.0 + c / 6.0
    least: float = min(a, a + b / 4.0, third, third + b / 4.0 + c / 3.0 + d / 4.0, a + b + c + d + e)
    return least


@compiled("b1(f8[::1], f8[:, :, ::1])")
def law_falls(law_knots: Array, law_pieces: Array) -> bool:
    """Return True if a law is invalid because the time along the path decreases by more than rounding.

    In a cubic piece, the extrema of the time along the path are at knots, and at the zeros of the rate, which is a
    parabola. In a piece of a higher degree, the rate is at least its least Bernstein coefficient.
    """
    highest = -math.inf
    for k in range(len(law_pieces)):
        p, span = law_pieces[k, 0], law_knots[k + 1] - law_knots[k]
        if p[4] != 0.0 or p[5] != 0.0:
            if span * _least_bernstein_coefficient_of_rate(p, span) < -MAX_TIME_FALL_S:
                return True
            continue
        a, b, c = 3.0 * p[3], p[2], p[1]  # the rate is a t^2 + 2 b t + c, which is zero where t = (-b -+ root) / a
        root = math.sqrt(max(0.0, b * b - a * c))
        q = -(b + math.copysign(root, b))
        one, other = q / a if a != 0.0 else math.inf, c / q if q != 0.0 else math.inf
        for t in (0.0, min(one, other), max(one, other), span):
            if 0.0 <= t <= span:
                s = p[0] + t * (p[1] + t * (p[2] + t * p[3]))
                if s < earliest_time(highest):
                    return True
                highest = max(highest, s)
    return False


@compiled("f8(f8[::1], f8[:, :, ::1], f8, f8)")
def passing_time(law_knots: Array, law_pieces: Array, s: float, last: float) -> float:
    """Return the time at which a law reaches the time `s` along the path [s], by bisection from its start to `last`."""
    low, high = law_knots[0], last
    for _ in range(BISECTIONS):
        middle = (low + high) / 2.0
        if law_at(law_knots, law_pieces, middle)[0] < s:
            low = middle
        else:
            high = middle
    return float(high)


def constant_law(rate: float, start: float = 0.0) -> Path:
    """Return a law with a constant rate that starts at the time `start` along the path."""
    pieces = np.zeros((1, 1, 6))
    pieces[0, 0, :2] = start, rate
    return Path(np.array([0.0, LAST_PIECE_S]), pieces)
