"""Timed points joined by quintics: a path that meets position, velocity and acceleration at each of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.arrays import Array
from trirail.motion.limits import COORDINATES, UNITS
from trirail.motion.paths import Path
from trirail.motion.runs import STILL, MotionState
from trirail.quantities import apart, worded

START = 1e-4
"""How far a trajectory may begin from where the robot stands [m, rad]."""
GO_THERE = "trirail follow --go-there or in Python follow(…, go_there=True)"
"""What does."""
STANDS = 1e-6
"""Velocity at the ends of a trajectory that counts as rounding, and is taken for none [m/s, rad/s]."""


class Point(NamedTuple):
    """A point of a timed trajectory: when [s], and where, how fast and how accelerated the platform is."""

    t: float
    pose: Sequence[float]
    velocity: Sequence[float] | None = None
    acceleration: Sequence[float] | None = None


def quintic(points: Sequence[Point], start: Sequence[float]) -> Path:
    """Join points into a path from standstill at the pose `start` to standstill.

    Velocities that are not given are those between the neighbours, accelerations likewise; these are zero at the ends.
    """
    t = np.array([point.t for point in points])
    p = np.array([point.pose for point in points])
    p[0] = start
    v = _filled([point.velocity for point in points], t, p)
    v[0] = v[-1] = 0.0
    a = _filled([point.acceleration for point in points], t, v)
    return _joined(t, p, v, a)


def between(begin: Point, end: Point) -> Path:
    """Return the quintic from one point to another, of which all is given: the way of least squared jerk."""
    t, p, v, a = (np.array(values) for values in zip(begin, end, strict=True))
    return _joined(t, p, v, a)


def _joined(t: Array, p: Array, v: Array, a: Array) -> Path:
    h = np.diff(t)[:, None]
    gap = p[1:] - p[:-1] - h * v[:-1] - h**2 / 2.0 * a[:-1]
    speed = v[1:] - v[:-1] - h * a[:-1]
    pull = a[1:] - a[:-1]
    pieces = np.zeros((len(h), 3, 6))
    pieces[:, :, 0], pieces[:, :, 1], pieces[:, :, 2] = p[:-1], v[:-1], a[:-1] / 2.0
    pieces[:, :, 3] = 10.0 * gap / h**3 - 4.0 * speed / h**2 + pull / (2.0 * h)
    pieces[:, :, 4] = -15.0 * gap / h**4 + 7.0 * speed / h**3 - pull / h**2
    pieces[:, :, 5] = 6.0 * gap / h**5 - 3.0 * speed / h**4 + pull / (2.0 * h**3)
    return Path(t - t[0], pieces)


def _filled(given: Sequence[Sequence[float] | None], t: Array, values: Array) -> Array:
    """Return the derivatives at points, those between their neighbours where none are given, none at the ends."""
    rates = np.zeros_like(values)
    if len(t) > 2:
        rates[1:-1] = (values[2:] - values[:-2]) / (t[2:] - t[:-2])[:, None]
    for row, rate in enumerate(given):
        if rate is not None:
            rates[row] = rate
    return rates


def check_ends(points: Sequence[Point], start: MotionState) -> None:
    """Raise RefusedError where points do not begin as the robot stands, or do not end at rest.

    What they begin or end with of an acceleration counts as the jerk over one cycle that it is (Checker.sample).
    """
    if not start.at_rest:
        raise RefusedError(RefusalCode.WRONG_START, "the robot moves: send the trajectory when it stands")
    for name, unit, given, stands in zip(COORDINATES, UNITS, points[0].pose, start.pose, strict=True):
        if abs(given - stands) > START:
            text = "the trajectory begins at {} = {}, the robot is at {}: go there first, {}".format(
                name, *apart(given, stands, unit), GO_THERE
            )
            raise RefusedError(RefusalCode.WRONG_START, text, value=given, limit=stands)
    ends = (
        (RefusalCode.WRONG_START, "begins", "let it begin at rest, as the robot stands", points[0]),
        (RefusalCode.WRONG_END, "ends", "let it end at rest", points[-1]),
    )
    for code, does, remedy, point in ends:
        for name, unit, value in zip(COORDINATES, ("m/s", "m/s", "rad/s"), point.velocity or STILL, strict=True):
            if abs(value) > STANDS:
                text = f"the trajectory {does} with {worded(value, unit)} in {name}: {remedy}"
                raise RefusedError(code, text, value=value, limit=0.0)
