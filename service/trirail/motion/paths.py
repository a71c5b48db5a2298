"""Paths in time as piecewise polynomials, and the law by which time runs along them.

A path has knots (n + 1,) in seconds and pieces (n, d, 6): coefficients of ascending powers of the time since the
piece's knot, for each of d coordinates. A law is a path of one coordinate: s, the time along the path, as a function
of time. Compiled; errors are codes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trirail.kinematics.algebra import Array
from trirail.kinematics.closure import LEGS_TYPE, forward_motion
from trirail.kinematics.compiled import compiled

__all__ = ["Path", "advance", "constant", "motion_at", "reached", "value", "value_at"]

FOR_EVER = 1e9
"""How long the last piece of a law lasts [s]."""
HALVINGS = 48
"""Of an interval, until it is narrower than numbers of its size can tell."""
ROUNDING = 1e-9
"""By so much may a position be beyond its limit, or two times be the same [m, rad, s]."""


class Path(NamedTuple):
    """A motion in time, in pose space or in slider space."""

    knots: Array
    pieces: Array
    in_sliders: bool = False

    @property
    def duration(self) -> float:
        """Time from the first knot, at zero, to the last [s]."""
        return float(self.knots[-1])


@compiled()
def _piece(knots: Array, time: float) -> int:
    low, high = 0, len(knots) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if time < knots[middle]:
            high = middle
        else:
            low = middle
    return low


@compiled()
def value_at(knots: Array, pieces: Array, time: float, out: Array) -> None:
    """Do value, from compiled code; before the start and after the end nothing moves."""
    inside = knots[0] <= time <= knots[-1]
    at = min(max(time, knots[0]), knots[-1])
    k = _piece(knots, at)
    t = at - knots[k]
    for i in range(pieces.shape[1]):
        p = pieces[k, i]
        out[0, i] = p[0] + t * (p[1] + t * (p[2] + t * (p[3] + t * (p[4] + t * p[5]))))
        if inside:
            out[1, i] = p[1] + t * (2.0 * p[2] + t * (3.0 * p[3] + t * (4.0 * p[4] + t * 5.0 * p[5])))
            out[2, i] = 2.0 * p[2] + t * (6.0 * p[3] + t * (12.0 * p[4] + t * 20.0 * p[5]))
        else:
            out[1, i] = out[2, i] = 0.0


@compiled("void(f8[::1], f8[:, :, ::1], f8, f8[:, ::1])")
def value(knots: Array, pieces: Array, time: float, out: Array) -> None:
    """Write a path's value and first two derivatives at a time [s] into `out` (3, d)."""
    value_at(knots, pieces, time, out)


@compiled()
def motion_at(knots: Array, pieces: Array, law_knots: Array, law_pieces: Array, time: float, out: Array) -> None:
    """Write where a path is, by a law, at a time of the law: value and two derivatives, (3, d)."""
    law = np.empty((3, 1))
    value_at(law_knots, law_pieces, time, law)
    s: float = law[0, 0]
    rate, change = law[1, 0], law[2, 0]
    value_at(knots, pieces, s, out)
    for i in range(3):
        out[2, i] = out[2, i] * rate * rate + out[1, i] * change
        out[1, i] *= rate


@compiled(f"i8({LEGS_TYPE}, f8[::1], f8[:, :, ::1], b1, f8[::1], f8[:, :, ::1], f8, f8[::1], f8[:, ::1])")
def advance(
    legs: Array,
    knots: Array,
    pieces: Array,
    in_sliders: bool,
    law_knots: Array,
    law_pieces: Array,
    time: float,
    near: Array,
    out: Array,
) -> int:
    """Write the platform's pose, velocity and acceleration (3, 3) at a time of the law [s].

    A path in slider space is turned into the platform's motion on the branch of the pose `near`. Returns 0, or a
    code of forward_into.
    """
    motion_at(knots, pieces, law_knots, law_pieces, time, out)
    if in_sliders:
        sliders = out.copy()
        return forward_motion(legs, sliders, near, out)
    return 0


@compiled("f8(f8[::1], f8[:, :, ::1], f8, f8)")
def reached(law_knots: Array, law_pieces: Array, s: float, last: float) -> float:
    """Return when a law passes a time along the path [s], by halving: between its start and `last`."""
    low, high, out = law_knots[0], last, np.empty((3, 1))
    for _ in range(HALVINGS):
        middle = (low + high) / 2.0
        value_at(law_knots, law_pieces, middle, out)
        if out[0, 0] < s:
            low = middle
        else:
            high = middle
    return float(high)


def constant(rate: float, start: float = 0.0) -> Path:
    """Return the law of a time that runs at a constant rate."""
    pieces = np.zeros((1, 1, 6))
    pieces[0, 0, :2] = start, rate
    return Path(np.array([0.0, FOR_EVER]), pieces)
