"""Paths through timed points, with a quintic polynomial between successive points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.arrays import Array
from trirail.motion.limits import COORDINATES, UNITS
from trirail.motion.paths import Path
from trirail.motion.runs import ZERO_RATES, MotionState
from trirail.quantities import apart, worded

MAX_START_OFFSET = 1e-4
"""Greatest allowed distance between the start of a trajectory and the robot's pose [m, rad]."""
GO_THERE_HINT = "trirail follow --go-there or, in Python, follow(…, go_there=True)"
"""Advice in messages about a robot that is not at the start of a trajectory."""
REST_VELOCITY = 1e-6
"""Velocity below which the robot counts as being at rest at the ends of a trajectory [m/s, rad/s]."""


class Point(NamedTuple):
    """Point of a timed trajectory: time [s], and the pose, velocity and acceleration of the platform."""

    t: float
    pose: Sequence[float]
    velocity: Sequence[float] | None = None
    acceleration: Sequence[float] | None = None


def quintic(points: Sequence[Point], start: Sequence[float]) -> Path:
    """Return the path through points. The path begins at rest at the pose `start`, and ends at rest.

    A missing velocity or acceleration is computed as the central difference of the neighbouring points. At the first
    and the last point, it is zero.
    """
    t = np.array([point.t for point in points])
    p = np.array([point.pose for point in points])
    p[0] = start
    v = _complete_derivatives([point.velocity for point in points], t, p)
    v[0] = v[-1] = 0.0
    a = _complete_derivatives([point.acceleration for point in points], t, v)
    return _hermite_path(t, p, v, a)


def quintic_between(begin: Point, end: Point) -> Path:
    """Return the quintic between two points with given velocities and accelerations.

    Of all paths between the points, the quintic has the least mean square of the jerk.
    """
    t, p, v, a = (np.array(values) for values in zip(begin, end, strict=True))
    return _hermite_path(t, p, v, a)


def _hermite_path(t: Array, p: Array, v: Array, a: Array) -> Path:
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


def _complete_derivatives(specified: Sequence[Sequence[float] | None], t: Array, values: Array) -> Array:
    """Return the derivatives at points (n, 3). Missing derivatives are central differences, or zero at the ends."""
    rates = np.zeros_like(values)
    if len(t) > 2:
        rates[1:-1] = (values[2:] - values[:-2]) / (t[2:] - t[:-2])[:, None]
    for row, rate in enumerate(specified):
        if rate is not None:
            rates[row] = rate
    return rates


def check_ends(points: Sequence[Point], start: MotionState) -> None:
    """Check that a trajectory begins at the robot's pose, and begins and ends at rest. Raises RefusedError.

    An acceleration is allowed at both ends. Checker.sample takes it into account as the jerk of one cycle.
    """
    if not start.at_rest:
        raise RefusedError(
            RefusalCode.WRONG_START, "the robot is moving: send the trajectory when the robot is at rest"
        )
    for name, unit, begin, current in zip(COORDINATES, UNITS, points[0].pose, start.pose, strict=True):
        if abs(begin - current) > MAX_START_OFFSET:
            text = "the trajectory begins at {} = {}, but the robot is at {}: go to the first point, with {}".format(
                name, *apart(begin, current, unit), GO_THERE_HINT
            )
            raise RefusedError(RefusalCode.WRONG_START, text, value=begin, limit=current)
    ends = (
        (RefusalCode.WRONG_START, "begins", "let it begin at rest, because the robot is at rest", points[0]),
        (RefusalCode.WRONG_END, "ends", "let it end at rest", points[-1]),
    )
    for code, does, remedy, point in ends:
        for name, unit, value in zip(COORDINATES, ("m/s", "m/s", "rad/s"), point.velocity or ZERO_RATES, strict=True):
            if abs(value) > REST_VELOCITY:
                text = f"the trajectory {does} with {worded(value, unit)} in {name}: {remedy}"
                raise RefusedError(code, text, value=value, limit=0.0)
