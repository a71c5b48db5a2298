"""The shortest time from rest to rest along a line, within limits of velocity, acceleration and jerk.

An interior-point method. sigma(t), the share of the line that is behind, is a cubic B-spline with n intervals of h
seconds: its jerk is constant in each of them. Of its n + 3 coefficients the first three are zero and the last three
one; the others, and ln h, are unknown. Each coordinate of platform and sliders is a function q(sigma), and with v, a, j
for the derivatives of sigma in time

    velocity q' v    acceleration q' a + q'' v²    jerk q' j + 3 q'' v a + q''' v³

are, as shares f of their limits, kept between -1 and 1 at moments of every interval by a barrier:
ln h / mu - sum ln (1 - f²) is minimised for ever smaller mu (Boyd and Vandenberghe, Convex Optimization, chapter 11).
Newton's steps leave the second derivatives of f out, as Gauss and Newton do: a banded system, bordered by ln h.

Compiled. What is found is proven by motion/feasibility.py, as every path is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled

__all__ = ["FIXED", "minimise_time", "spline_states", "too_fast"]

SPAN = 4
"""Coefficients that a cubic B-spline depends on within an interval."""
FIXED = 3
"""Coefficients that rest at an end gives."""
PARTS = 2
"""Of an interval, at whose ends the limits are held."""
FIRST_MU, LAST_MU, SHRINK = 1e-2, 1e-5, 0.1
"""The weight of the barrier against ln h: what the last one costs is less than a thousandth of the time."""
DECREMENT = 0.5
"""Gain that Newton's step promises below which mu becomes smaller."""
SUFFICIENT = 1e-4
"""Share of that gain with which a step is content (Armijo)."""
SMALLEST = 1e-9
"""Share of a step below which none is tried."""
MOST_STEPS = 100
"""Of Newton's method; it takes about thirty."""
HAIR = 1.0 + 1e-12
"""More of the diagonal, so that rounding leaves the system positive definite."""


class Derivatives(NamedTuple):
    """Of the barrier, by the n - 3 free coefficients and by ln h."""

    band: Array
    """Hessian by the coefficients, (n - 3, 4): column d holds the d-th entry to the left of the diagonal."""
    gradient: Array
    border: Array
    """Mixed derivatives."""
    by_time: Array
    """First and second derivative by ln h."""


@compiled()
def _along(samples: Array, sigma: float, q: Array) -> None:
    """Write the first four derivatives of the coordinates by sigma, (m, 4). Between samples the first is a cubic."""
    cells = len(samples) - 1
    k = min(max(int(sigma * cells), 0), cells - 1)
    u = sigma * cells - k
    for i in range(samples.shape[1]):
        p, m = samples[k, i, 0], samples[k, i, 1] / cells
        rise, m1 = samples[k + 1, i, 0] - p, samples[k + 1, i, 1] / cells
        c2, c3 = 3.0 * rise - 2.0 * m - m1, m + m1 - 2.0 * rise
        q[i, 0] = p + u * (m + u * (c2 + u * c3))
        q[i, 1] = (m + u * (2.0 * c2 + u * 3.0 * c3)) * cells
        q[i, 2] = (2.0 * c2 + u * 6.0 * c3) * cells**2
        q[i, 3] = 6.0 * c3 * cells**3


@compiled()
def _weights(u: float, h: float, out: Array) -> None:
    """Write by what a spline's sigma, v, a, j, (4, 4), multiply the coefficients of an interval, at a share u of it."""
    w = 1.0 - u
    out[0, 0], out[0, 3] = w**3 / 6.0, u**3 / 6.0
    out[0, 1], out[0, 2] = (4.0 - 3.0 * u**2 * (2.0 - u)) / 6.0, (4.0 - 3.0 * w**2 * (2.0 - w)) / 6.0
    out[1, 0], out[1, 1], out[1, 2], out[1, 3] = -(w**2), u * (3.0 * u - 4.0), w * (4.0 - 3.0 * w), u**2
    out[2, 0], out[2, 1], out[2, 2], out[2, 3] = w, 1.0 - 3.0 * w, 1.0 - 3.0 * u, u
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = -1.0, 3.0, -3.0, 1.0
    for x in range(SPAN):
        out[1, x] /= 2.0 * h
        out[2, x] /= h**2
        out[3, x] /= h**3


@compiled()
def _state(c: Array, k: int, weights: Array) -> tuple[float, float, float, float]:
    """Return sigma, v, a, j within interval k."""
    sigma = v = a = j = 0.0
    for x in range(SPAN):
        sigma += weights[0, x] * c[k + x]
        v += weights[1, x] * c[k + x]
        a += weights[2, x] * c[k + x]
        j += weights[3, x] * c[k + x]
    return sigma, v, a, j


@compiled()
def _quantity(q: Array, order: int, v: float, a: float, j: float, by: Array) -> float:
    """Return velocity, acceleration or jerk (order 0, 1, 2) of a coordinate; write its gradient by sigma, v, a, j."""
    value: float
    if order == 0:
        by[0], by[1], by[2], by[3] = q[1] * v, q[0], 0.0, 0.0
        value = q[0] * v
    elif order == 1:
        by[0], by[1], by[2], by[3] = q[1] * a + q[2] * v**2, 2.0 * q[1] * v, q[0], 0.0
        value = q[0] * a + q[1] * v**2
    else:
        by[0], by[1] = q[1] * j + 3.0 * q[2] * v * a + q[3] * v**3, 3.0 * (q[1] * a + q[2] * v**2)
        by[2], by[3] = 3.0 * q[1] * v, q[0]
        value = q[0] * j + 3.0 * q[1] * v * a + q[2] * v**3
    return value


@compiled()
def _add(out: Derivatives, k: int, chain: Array, slope: Array, curvature: Array) -> None:
    """Add derivatives by sigma, v, a, j, (4,) and (4, 4), of which `chain` (4, 5) are those by what is unknown."""
    free = len(out.gradient)
    of_x = np.empty(4)
    for x in range(SPAN + 1):
        row, in_time = k + x - FIXED, x == SPAN
        if not (in_time or 0 <= row < free):
            continue
        first = 0.0
        for e in range(4):
            first += chain[e, x] * slope[e]
            of_x[e] = 0.0
            for f in range(4):
                of_x[e] += curvature[max(e, f), min(e, f)] * chain[f, x]
        if in_time:
            out.by_time[0] += first
        else:
            out.gradient[row] += first
        for y in range(x + 1):
            column = k + y - FIXED
            if not (y == SPAN or 0 <= column < free):
                continue
            second = 0.0
            for e in range(4):
                second += of_x[e] * chain[e, y]
            if not in_time:
                out.band[row, x - y] += second
            elif y < SPAN:
                out.border[column] += second
            else:
                out.by_time[1] += second


@compiled()
def _barrier(samples: Array, limits: Array, c: Array, h: float, out: Derivatives) -> float:
    """Return the barrier and write its derivatives; infinite, and without derivatives, where a limit is reached."""
    q, by = np.empty((len(limits), 4)), np.empty(4)
    weights, chain = np.empty((4, SPAN)), np.empty((4, SPAN + 1))
    slope, curvature = np.empty(4), np.empty((4, 4))
    out.band[:] = 0.0
    out.gradient[:] = out.border[:] = out.by_time[:] = 0.0
    total = 0.0
    for part in range(PARTS + 1):
        _weights(part / PARTS, h, weights)
        chain[:, :SPAN] = weights
        # At the end of an interval only jerk is another than at the beginning of the next.
        lowest = 2 if part == PARTS else 0
        for k in range(len(c) - FIXED):
            sigma, v, a, j = _state(c, k, weights)
            _along(samples, sigma, q)
            slope[:] = 0.0
            curvature[:] = 0.0
            slack = 1.0
            for i in range(len(limits)):
                for order in range(lowest, 3):
                    limit = limits[i, order]
                    share = _quantity(q[i], order, v, a, j, by) / limit
                    if not abs(share) < 1.0:
                        return math.inf
                    slack *= 1.0 - share * share
                    up, down = 1.0 / ((1.0 - share) * limit), 1.0 / ((1.0 + share) * limit)
                    for e in range(4):
                        slope[e] += (up - down) * by[e]
                        for f in range(e + 1):
                            curvature[e, f] += (up * up + down * down) * by[e] * by[f]
            total -= math.log(slack)
            chain[0, SPAN], chain[1, SPAN], chain[2, SPAN], chain[3, SPAN] = 0.0, -v, -2.0 * a, -3.0 * j
            _add(out, k, chain, slope, curvature)
    return total


@compiled()
def _factorise(band: Array) -> bool:
    """Replace a banded matrix by its Cholesky factor; whether it is positive definite."""
    for row in range(len(band)):
        for d in range(min(SPAN - 1, row), -1, -1):
            rest = band[row, d]
            for e in range(d + 1, min(SPAN - 1, row) + 1):
                rest -= band[row, e] * band[row - d, e - d]
            if d:
                band[row, d] = rest / band[row - d, 0]
            elif rest > 0.0:
                band[row, 0] = math.sqrt(rest)
            else:
                return False
    return True


@compiled()
def _substitute(band: Array, x: Array) -> None:
    """Solve for a right side in place, with the factor."""
    n = len(band)
    for row in range(n):
        for d in range(1, min(SPAN - 1, row) + 1):
            x[row] -= band[row, d] * x[row - d]
        x[row] /= band[row, 0]
    for row in range(n - 1, -1, -1):
        for d in range(1, min(SPAN - 1, n - 1 - row) + 1):
            x[row] -= band[row + d, d] * x[row + d]
        x[row] /= band[row, 0]


@compiled()
def _newton(at: Derivatives, mu: float, step: Array) -> tuple[float, float]:
    """Write Newton's step of the coefficients; return that of ln h and the gain that both promise, NaN without."""
    at.band[:, 0] *= HAIR
    if not _factorise(at.band):
        return 0.0, math.nan
    by_border, by_gradient = at.border.copy(), at.gradient.copy()
    _substitute(at.band, by_border)
    _substitute(at.band, by_gradient)
    slope, curvature = at.by_time[0] + 1.0 / mu, at.by_time[1]
    for k in range(len(step)):
        slope -= at.border[k] * by_gradient[k]
        curvature -= at.border[k] * by_border[k]
    of_time = -slope / curvature
    gain = -(at.by_time[0] + 1.0 / mu) * of_time
    for k in range(len(step)):
        step[k] = -by_gradient[k] - by_border[k] * of_time
        gain -= at.gradient[k] * step[k]
    return of_time, gain


@compiled("f8(f8[:, :, ::1], f8[:, ::1], f8[::1], f8)")
def minimise_time(samples: Array, limits: Array, c: Array, h: float) -> float:
    """Improve the coefficients (n + 3,) of a law within limits, in place; return its new h [s], NaN without one.

    `samples` (k + 1, m, 2) are the first and second derivatives by sigma of m coordinates, even over sigma from 0 to 1.
    `limits` (m, 3) are those of their velocity, acceleration and jerk.
    """
    free = len(c) - 2 * FIXED
    derivatives = Derivatives(np.empty((free, SPAN)), np.empty(free), np.empty(free), np.empty(2))
    step, trial = np.empty(free), c.copy()
    log_h, mu = math.log(h), FIRST_MU
    now = _barrier(samples, limits, c, h, derivatives)
    for _ in range(MOST_STEPS):
        of_time, gain = _newton(derivatives, mu, step)
        if not (math.isfinite(now) and math.isfinite(gain)):
            return math.nan
        share, moved = 1.0, False
        while not moved and share > SMALLEST:
            for k in range(free):
                trial[FIXED + k] = c[FIXED + k] + share * step[k]
            then = _barrier(samples, limits, trial, math.exp(log_h + share * of_time), derivatives)
            moved = then - now + share * of_time / mu <= -SUFFICIENT * share * gain
            share /= 2.0
        if not moved:  # rounding leaves no more to gain
            break
        c[:] = trial
        log_h += 2.0 * share * of_time
        now = then
        if gain < DECREMENT:
            if mu <= LAST_MU:
                break
            mu *= SHRINK
    return math.exp(log_h)


@compiled("f8(f8[:, :, ::1], f8[:, ::1], f8[::1], f8)")
def too_fast(samples: Array, limits: Array, c: Array, h: float) -> float:
    """Return how many times too fast a law is, by samples and limits as of minimise_time."""
    q, by, weights, most = np.empty((len(limits), 4)), np.empty(4), np.empty((4, SPAN)), 0.0
    for part in range(PARTS + 1):
        _weights(part / PARTS, h, weights)
        for k in range(len(c) - FIXED):
            sigma, v, a, j = _state(c, k, weights)
            _along(samples, sigma, q)
            for i in range(len(limits)):
                for order in range(3):
                    share = abs(_quantity(q[i], order, v, a, j, by)) / limits[i, order]
                    most = max(most, share ** (1.0 / (order + 1)))
    return most


@compiled("void(f8[::1], f8, f8[:, ::1])")
def spline_states(c: Array, h: float, out: Array) -> None:
    """Write sigma, v, a, j of a law at the beginning of each interval, (n, 4)."""
    weights = np.empty((4, SPAN))
    _weights(0.0, h, weights)
    for k in range(len(out)):
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = _state(c, k, weights)
