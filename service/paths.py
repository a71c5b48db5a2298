"""Paths in time as piecewise polynomials, the law by which time runs along them, and what both ask of the sliders.

A path has knots (n + 1,) in seconds and pieces (n, d, 6): coefficients of ascending powers of the time since the
piece's knot, for each of d coordinates. A law is a path of one coordinate: s, the time along the path, as a function
of time. Compiled; errors are codes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from service.algebra import Array
from service.closure import LEGS, forward_motion, inverse_motion
from service.compiled import compiled

__all__ = ["Path", "advance", "constant", "survey", "value"]

FOR_EVER = 1e9
"""How long the last piece of a law lasts [s]."""


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
def _value(knots: Array, pieces: Array, time: float, out: Array) -> None:
    """Write the value and two derivatives, (3, d); before the start and after the end nothing moves."""
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
    _value(knots, pieces, time, out)


@compiled()
def _advance(knots: Array, pieces: Array, law_knots: Array, law_pieces: Array, time: float, out: Array) -> float:
    law = np.empty((3, 1))
    _value(law_knots, law_pieces, time, law)
    s: float = law[0, 0]
    rate, change = law[1, 0], law[2, 0]
    _value(knots, pieces, s, out)
    for i in range(3):
        out[2, i] = out[2, i] * rate * rate + out[1, i] * change
        out[1, i] *= rate
    return s


@compiled(f"i8({LEGS}, f8[::1], f8[:, :, ::1], b1, f8[::1], f8[:, :, ::1], f8, f8[::1], f8[:, ::1])")
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
    _advance(knots, pieces, law_knots, law_pieces, time, out)
    if in_sliders:
        sliders = out.copy()
        return forward_motion(legs, sliders, near, out)
    return 0


@compiled(f"i8({LEGS}, f8[::1], f8[:, :, ::1], b1, f8[::1], f8[:, :, ::1], f8[::1], f8, f8[::1], f8[:, ::1], f8[::1])")
def survey(
    legs: Array,
    knots: Array,
    pieces: Array,
    in_sliders: bool,
    law_knots: Array,
    law_pieces: Array,
    times: Array,
    step: float,
    start: Array,
    box: Array,
    worst: Array,
) -> int:
    """Look at a path, run by a law, at so many times; write the sliders' greatest velocity, acceleration and jerk.

    Jerk is the change of acceleration over a `step` [s], as the drives see it. `start` is the pose at the first
    time. `box` (2, 5) holds the limits, low and high, of x, y, phi, lambda_10 and lambda_32. Returns 0, or 1 + k
    where the sample k is out of reach; `worst` (3,) then means nothing.
    """
    motion, sliders, after, near = np.empty((3, 3)), np.empty((6, 3)), np.empty((6, 3)), start.copy()
    path = np.empty((3, 3))
    worst[:] = 0.0
    for k in range(len(times)):
        for out, time in ((sliders, times[k]), (after, times[k] + step)):
            _advance(knots, pieces, law_knots, law_pieces, time, path)
            if in_sliders:
                if forward_motion(legs, path, near, motion) != 0:
                    return 1 + k
                near[:] = motion[0]
            else:
                motion[:] = path
            if inverse_motion(legs, motion, out) != 0:
                return 1 + k
            for i in range(3):
                if not box[0, i] <= motion[0, i] <= box[1, i]:
                    return 1 + k
        for i in range(3):
            if not (box[0, 3] <= sliders[0, i] <= box[1, 3] and box[0, 4] <= sliders[3, i] <= box[1, 4]):
                return 1 + k
            worst[0] = max(worst[0], abs(sliders[1, i]))
            worst[1] = max(worst[1], abs(sliders[2, i]))
            worst[2] = max(worst[2], abs(after[2, i] - sliders[2, i]) / step)
    return 0


def constant(rate: float, start: float = 0.0) -> Path:
    """Return the law of a time that runs at a constant rate."""
    pieces = np.zeros((1, 1, 6))
    pieces[0, 0, :2] = start, rate
    return Path(np.array([0.0, FOR_EVER]), pieces)
