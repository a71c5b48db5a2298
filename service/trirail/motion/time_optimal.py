"""Interior-point method for the fastest motion along a line, with limits on velocity, acceleration and jerk.

The motion begins and ends at rest.

sigma(t), the completed fraction of the line, is a cubic B-spline with n intervals of h seconds. The jerk is constant in
each interval. Of the n + 3 coefficients, the first three are zero and the last three are one. The other coefficients
and ln h are the unknowns. Each coordinate of the platform and the sliders is a function q(sigma). With v, a, j as the
derivatives of sigma with respect to time, the rates of the coordinate are

    velocity q' v    acceleration q' a + q'' v²    jerk q' j + 3 q'' v a + q''' v³

Each rate is divided by its limit. A barrier function confines the quotient f to the range from -1 to 1 at several times
in every interval. The method minimises ln h / mu - sum ln (1 - f²) for ever smaller mu (Boyd and Vandenberghe, Convex
Optimization, chapter 11). The Newton steps omit the second derivatives of f (Gauss-Newton). The resulting system of
equations is banded, with one additional row and column for ln h.

The functions are compiled. motion/feasibility.py checks the result, as it checks every path.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled

__all__ = ["END_COEFFICIENTS", "limit_excess", "minimise_time", "spline_states"]

COEFFICIENTS_PER_INTERVAL = 4
"""Number of coefficients that determine a cubic B-spline within an interval."""
END_COEFFICIENTS = 3
"""Number of coefficients at each end that are fixed because the motion is at rest there."""
CHECKS_PER_INTERVAL = 2
"""Number of parts into which an interval is divided. The limits are enforced at the ends of each part."""
FIRST_MU, LAST_MU, MU_FACTOR = 1e-2, 1e-5, 0.1
"""First and last weight mu of the barrier relative to ln h, and factor between weights. With the last weight, the
barrier lengthens the motion by less than a thousandth."""
CENTRED_GAIN = 0.5
"""Predicted gain of a Newton step below which mu is reduced."""
ARMIJO_SHARE = 1e-4
"""Fraction of the predicted gain that a step must achieve to be accepted (Armijo condition)."""
MIN_STEP_SHARE = 1e-9
"""Fraction of a Newton step below which the line search gives up."""
MAX_NEWTON_STEPS = 100
"""Greatest number of Newton steps. About 30 steps are usual."""
DIAGONAL_FACTOR = 1.0 + 1e-12
"""Factor for the diagonal, so that the system remains positive definite despite rounding."""


class Derivatives(NamedTuple):
    """Derivatives of the barrier with respect to the n - 3 free coefficients and to ln h."""

    band: Array
    """Hessian with respect to the coefficients, (n - 3, 4). Column d holds the d-th entry to the left of the
    diagonal."""
    gradient: Array
    border: Array
    """Mixed derivatives with respect to the coefficients and ln h."""
    by_time: Array
    """First and second derivative with respect to ln h."""


@compiled()
def _coordinate_derivatives(samples: Array, sigma: float, q: Array) -> None:
    """Write the first four derivatives of the coordinates with respect to sigma, (m, 4).

    Between samples, the first derivative is interpolated by a cubic polynomial.
    """
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
def _spline_weights(u: float, h: float, out: Array) -> None:
    """Write the matrix (4, 4) that converts coefficients to sigma, v, a, j, at the fraction u of an interval."""
    w = 1.0 - u
    out[0, 0], out[0, 3] = w**3 / 6.0, u**3 / 6.0
    out[0, 1], out[0, 2] = (4.0 - 3.0 * u**2 * (2.0 - u)) / 6.0, (4.0 - 3.0 * w**2 * (2.0 - w)) / 6.0
    out[1, 0], out[1, 1], out[1, 2], out[1, 3] = -(w**2), u * (3.0 * u - 4.0), w * (4.0 - 3.0 * w), u**2
    out[2, 0], out[2, 1], out[2, 2], out[2, 3] = w, 1.0 - 3.0 * w, 1.0 - 3.0 * u, u
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = -1.0, 3.0, -3.0, 1.0
    for x in range(COEFFICIENTS_PER_INTERVAL):
        out[1, x] /= 2.0 * h
        out[2, x] /= h**2
        out[3, x] /= h**3


@compiled()
def _spline_state(c: Array, k: int, weights: Array) -> tuple[float, float, float, float]:
    """Return sigma, v, a, j within interval k."""
    sigma = v = a = j = 0.0
    for x in range(COEFFICIENTS_PER_INTERVAL):
        sigma += weights[0, x] * c[k + x]
        v += weights[1, x] * c[k + x]
        a += weights[2, x] * c[k + x]
        j += weights[3, x] * c[k + x]
    return sigma, v, a, j


@compiled()
def _rate_of_coordinate(q: Array, order: int, v: float, a: float, j: float, by: Array) -> float:
    """Return velocity, acceleration or jerk (order 0, 1, 2) of a coordinate.

    The derivatives of the result with respect to sigma, v, a, j are written to `by`.
    """
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


@compiled(allocates=True)
def _add_derivatives(out: Derivatives, k: int, chain: Array, slope: Array, curvature: Array) -> None:
    """Convert derivatives with respect to sigma, v, a, j by the chain rule, and add them to `out`.

    `slope` (4,) and `curvature` (4, 4) are first and second derivatives with respect to sigma, v, a, j. `chain` (4, 5)
    holds the derivatives of sigma, v, a, j with respect to the unknowns.
    """
    free = len(out.gradient)
    of_x = np.empty(4)
    for x in range(COEFFICIENTS_PER_INTERVAL + 1):
        row, in_time = k + x - END_COEFFICIENTS, x == COEFFICIENTS_PER_INTERVAL
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
            column = k + y - END_COEFFICIENTS
            if not (y == COEFFICIENTS_PER_INTERVAL or 0 <= column < free):
                continue
            second = 0.0
            for e in range(4):
                second += of_x[e] * chain[e, y]
            if not in_time:
                out.band[row, x - y] += second
            elif y < COEFFICIENTS_PER_INTERVAL:
                out.border[column] += second
            else:
                out.by_time[1] += second


@compiled(allocates=True)
def _barrier(samples: Array, limits: Array, c: Array, h: float, out: Derivatives) -> float:
    """Return the value of the barrier and write its derivatives.

    At or beyond a limit, the result is infinite, and the derivatives are not valid.
    """
    q, by = np.empty((len(limits), 4)), np.empty(4)
    weights, chain = np.empty((4, COEFFICIENTS_PER_INTERVAL)), np.empty((4, COEFFICIENTS_PER_INTERVAL + 1))
    slope, curvature = np.empty(4), np.empty((4, 4))
    out.band[:] = 0.0
    out.gradient[:] = out.border[:] = out.by_time[:] = 0.0
    total = 0.0
    for part in range(CHECKS_PER_INTERVAL + 1):
        _spline_weights(part / CHECKS_PER_INTERVAL, h, weights)
        chain[:, :COEFFICIENTS_PER_INTERVAL] = weights
        # Only the jerk differs between the end of an interval and the start of the next interval.
        lowest = 2 if part == CHECKS_PER_INTERVAL else 0
        for k in range(len(c) - END_COEFFICIENTS):
            sigma, v, a, j = _spline_state(c, k, weights)
            _coordinate_derivatives(samples, sigma, q)
            slope[:] = 0.0
            curvature[:] = 0.0
            slack = 1.0
            for i in range(len(limits)):
                for order in range(lowest, 3):
                    limit = limits[i, order]
                    share = _rate_of_coordinate(q[i], order, v, a, j, by) / limit
                    if not abs(share) < 1.0:
                        return math.inf
                    slack *= 1.0 - share * share
                    up, down = 1.0 / ((1.0 - share) * limit), 1.0 / ((1.0 + share) * limit)
                    for e in range(4):
                        slope[e] += (up - down) * by[e]
                        for f in range(e + 1):
                            curvature[e, f] += (up * up + down * down) * by[e] * by[f]
            total -= math.log(slack)
            (
                chain[0, COEFFICIENTS_PER_INTERVAL],
                chain[1, COEFFICIENTS_PER_INTERVAL],
                chain[2, COEFFICIENTS_PER_INTERVAL],
                chain[3, COEFFICIENTS_PER_INTERVAL],
            ) = 0.0, -v, -2.0 * a, -3.0 * j
            _add_derivatives(out, k, chain, slope, curvature)
    return total


@compiled()
def _factorise(band: Array) -> bool:
    """Replace a banded matrix by its Cholesky factor. Return False if the matrix is not positive definite."""
    for row in range(len(band)):
        for d in range(min(COEFFICIENTS_PER_INTERVAL - 1, row), -1, -1):
            rest = band[row, d]
            for e in range(d + 1, min(COEFFICIENTS_PER_INTERVAL - 1, row) + 1):
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
    """Replace the right-hand side `x` of a linear system by the solution.

    `band` is the banded Cholesky factor of the system's matrix.
    """
    n = len(band)
    for row in range(n):
        for d in range(1, min(COEFFICIENTS_PER_INTERVAL - 1, row) + 1):
            x[row] -= band[row, d] * x[row - d]
        x[row] /= band[row, 0]
    for row in range(n - 1, -1, -1):
        for d in range(1, min(COEFFICIENTS_PER_INTERVAL - 1, n - 1 - row) + 1):
            x[row] -= band[row + d, d] * x[row + d]
        x[row] /= band[row, 0]


@compiled(allocates=True)
def _newton_step(at: Derivatives, mu: float, step: Array) -> tuple[float, float]:
    """Write the Newton step of the coefficients. Return the step of ln h, and the predicted gain.

    The predicted gain is NaN if the system is not positive definite.
    """
    at.band[:, 0] *= DIAGONAL_FACTOR
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


@compiled("f8(f8[:, :, ::1], f8[:, ::1], f8[::1], f8)", allocates=True)
def minimise_time(samples: Array, limits: Array, c: Array, h: float) -> float:
    """Minimise the duration of a law within limits.

    Parameters
    ----------
    samples : (k + 1, m, 2)
        First and second derivatives of m coordinates with respect to sigma, evenly spaced from sigma = 0 to 1.
    limits : (m, 3)
        Velocity, acceleration and jerk limits of the coordinates.
    c : (n + 3,)
        Input: coefficients of a law within the limits. Output: coefficients of the result.
    h : float
        Duration of the intervals of the given law [s].

    Returns
    -------
    float
        New duration of the intervals [s]; NaN if the method fails.
    """
    free = len(c) - 2 * END_COEFFICIENTS
    derivatives = Derivatives(np.empty((free, COEFFICIENTS_PER_INTERVAL)), np.empty(free), np.empty(free), np.empty(2))
    step, trial = np.empty(free), c.copy()
    log_h, mu = math.log(h), FIRST_MU
    now = _barrier(samples, limits, c, h, derivatives)
    for _ in range(MAX_NEWTON_STEPS):
        of_time, gain = _newton_step(derivatives, mu, step)
        if not (math.isfinite(now) and math.isfinite(gain)):
            return math.nan
        share, moved = 1.0, False
        while not moved and share > MIN_STEP_SHARE:
            for k in range(free):
                trial[END_COEFFICIENTS + k] = c[END_COEFFICIENTS + k] + share * step[k]
            then = _barrier(samples, limits, trial, math.exp(log_h + share * of_time), derivatives)
            moved = then - now + share * of_time / mu <= -ARMIJO_SHARE * share * gain
            share /= 2.0
        if not moved:  # the remaining gain is smaller than rounding errors
            break
        c[:] = trial
        log_h += 2.0 * share * of_time
        now = then
        if gain < CENTRED_GAIN:
            if mu <= LAST_MU:
                break
            mu *= MU_FACTOR
    return math.exp(log_h)


@compiled("f8(f8[:, :, ::1], f8[:, ::1], f8[::1], f8)", allocates=True)
def limit_excess(samples: Array, limits: Array, c: Array, h: float) -> float:
    """Return the factor by which a law must be slowed to fit the limits; see minimise_time for the parameters."""
    q, by, weights, most = np.empty((len(limits), 4)), np.empty(4), np.empty((4, COEFFICIENTS_PER_INTERVAL)), 0.0
    for part in range(CHECKS_PER_INTERVAL + 1):
        _spline_weights(part / CHECKS_PER_INTERVAL, h, weights)
        for k in range(len(c) - END_COEFFICIENTS):
            sigma, v, a, j = _spline_state(c, k, weights)
            _coordinate_derivatives(samples, sigma, q)
            for i in range(len(limits)):
                for order in range(3):
                    share = abs(_rate_of_coordinate(q[i], order, v, a, j, by)) / limits[i, order]
                    most = max(most, share ** (1.0 / (order + 1)))
    return most


@compiled("void(f8[::1], f8, f8[:, ::1])", allocates=True)
def spline_states(c: Array, h: float, out: Array) -> None:
    """Fill `out` (n, 4) with sigma, v, a and j of the spline with coefficients `c` at the start of each interval."""
    weights = np.empty((4, COEFFICIENTS_PER_INTERVAL))
    _spline_weights(0.0, h, weights)
    for k in range(len(out)):
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = _spline_state(c, k, weights)
