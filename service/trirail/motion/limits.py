"""What may never be exceeded: bounds for paths before they start and for every setpoint before it is sent."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import f8, from_dtype, i8
from numpy.typing import ArrayLike, NDArray

from trirail.config import Limits
from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled
from trirail.kinematics.geometry import LEGS
from trirail.motion.paths import ROUNDING
from trirail.naming import Labels
from trirail.quantities import beyond, worded

COORDINATES = ("x", "y", "phi")
UNITS = ("m", "m", "rad")

EDGE = 1e-6
"""By so much may a setpoint be beyond a limit of position that its path was checked against [m, rad]."""
EXCESS = 1e-3
"""By that share may a setpoint exceed a limit of velocity, acceleration or jerk that its path was checked against, of
a slider or the platform."""

BOUNDS = np.dtype(
    [
        ("rows", "f8", (4, 3, 3)),  # of position, velocity, acceleration, cross slide, each leg: low, high, slack
        ("pose", "f8", (3, 2)),  # low and high of x, y, phi
        ("edge", "f8"),  # slack of these
        ("step", "f8", 3),  # how far each slider goes in a cycle at most [m]
        ("slider_jerk", "f8", 3),
        ("platform", "f8", (3, 3)),  # velocity, acceleration and jerk of x, y, phi
        ("period", "f8"),
    ]
)
"""A robot's limits, as compiled code takes them [m, rad, s]."""
_CHECKS = (
    ("slider", "position", "m"),
    ("slider", "velocity", "m/s"),
    ("slider", "acceleration", "m/s²"),
    ("slider", "passive position", "m"),
    ("platform", "position", ""),
    ("slider", "step in one cycle", "m"),
    ("slider", "jerk", "m/s³"),
    ("platform", "velocity", "/s"),
    ("platform", "acceleration", "/s²"),
    ("platform", "jerk", "/s³"),
)
"""What is checked, of what, and in which unit; of the platform, after that of the coordinate."""
_POSE, _STEP, _JERK, _PLATFORM = 4, 5, 6, 7  # where in _CHECKS; the sliders' rows stand in front of them


class Violation(NamedTuple):
    """A bound that is exceeded."""

    what: str
    """The slider (A, B, C) or the platform's coordinate (x, y, phi)."""
    quantity: str
    value: float
    limit: float
    unit: str
    label: str = ""
    """What people call the slider."""

    def __str__(self) -> str:
        return beyond(f"{self.subject}: {self.quantity}", self.value, self.limit, self.unit)

    @property
    def subject(self) -> str:
        """What is beyond its bound, in words."""
        return f"slider {self.label or self.what}" if self.what in LEGS else f"platform {self.what}"

    @property
    def bound(self) -> str:
        """The bound alone, in words."""
        return f"{self.subject} ({self.quantity} {worded(self.limit, self.unit)})"


_BOUNDS, _ROWS, _ROW = from_dtype(BOUNDS)[::1], f8[:, ::1], f8[::1]


@compiled()
def _found(check: int, n: int, value: float, limit: float, found: Array) -> int:
    """Note what is beyond its limit; return its code: 1 + 3 times the number of the check + the leg or coordinate."""
    found[0], found[1] = value, limit
    return 1 + 3 * check + n


@compiled()
def _jerk(now: Array, before: Array, n: int, period: float) -> float:
    """Return the least jerk that explains rows (position, velocity, acceleration) one cycle after others.

    A jerk j that may change at any moment, an acceleration that may begin or end anywhere in the cycle as large
    as j makes it in a cycle T: between the two the acceleration changes by j T at most, the velocity differs by
    j T² / 2 from what the mean acceleration gives, and the position by j T³ / 4 from what the mean velocity does.
    """
    half = period / 2.0
    p, v, a = now[0, n], now[1, n], now[2, n]
    p0, v0, a0 = before[0, n], before[1, n], before[2, n]
    by_acceleration: float = abs(a - a0) / period
    by_velocity: float = abs(v - v0 - half * (a + a0)) / (half * period)
    by_position: float = 4.0 * (abs(p - p0 - half * (v + v0)) - ROUNDING) / period**3
    return max(by_acceleration, by_velocity, by_position)


@compiled(i8(_BOUNDS, _ROWS, _ROW))
def check_setpoint(bounds: NDArray[np.void], rows: Array, found: Array) -> int:
    """Check solved sliders, as many of position, velocity, acceleration, cross slide as there are [m, s].

    A value that is not a number is beyond every limit.
    """
    for row in range(min(len(rows), 4)):
        for n in range(3):
            limits = bounds[0].rows[row, n]
            low, high, slack = limits[0], limits[1], limits[2]
            value = rows[row, n]
            if not low - slack <= value <= high + slack:
                return _found(row, n, value, low if value < low else high, found)
    return 0


@compiled(i8(_BOUNDS, _ROW, _ROW))
def check_pose(bounds: NDArray[np.void], pose: Array, found: Array) -> int:
    """Check a pose x, y [m], phi [rad] alone."""
    edge = bounds[0].edge
    for n in range(3):
        low, high = bounds[0].pose[n, 0], bounds[0].pose[n, 1]
        if not low - edge <= pose[n] <= high + edge:
            return _found(_POSE, n, pose[n], low if pose[n] < low else high, found)
    return 0


@compiled()
def _check_step(bounds: NDArray[np.void], rows: Array, before: Array, found: Array) -> int:
    """Check solved sliders against those of the cycle before: how far they go, and with which jerk."""
    for n in range(3):
        step, most = rows[0, n] - before[0, n], bounds[0].step[n]
        if not abs(step) <= most:
            return _found(_STEP, n, step, most, found)
    for n in range(3):
        jerk, jerk_limit = _jerk(rows, before, n, bounds[0].period), bounds[0].slider_jerk[n]
        if not jerk <= jerk_limit * (1.0 + EXCESS):
            return _found(_JERK, n, jerk, jerk_limit, found)
    return 0


@compiled()
def _check_platform(bounds: NDArray[np.void], motion: Array, before: Array, found: Array) -> int:
    """Check the platform's velocity and acceleration, and the jerk since the cycle before."""
    for n in range(3):
        limits = bounds[0].platform[n]
        for row in range(2):
            value = motion[1 + row, n]
            if not abs(value) <= limits[row] * (1.0 + EXCESS):
                return _found(_PLATFORM + row, n, value, math.copysign(limits[row], value), found)
        jerk = _jerk(motion, before, n, bounds[0].period)
        if not jerk <= limits[2] * (1.0 + EXCESS):
            return _found(_PLATFORM + 2, n, jerk, limits[2], found)
    return 0


@compiled(i8(_BOUNDS, _ROWS, _ROWS, _ROWS, _ROWS, _ROW))
def gate(
    bounds: NDArray[np.void], rows: Array, rows_before: Array, motion: Array, motion_before: Array, found: Array
) -> int:
    """Check solved sliders and the platform's motion against limits, and against those of the cycle before.

    `rows` as of check_setpoint, `motion` (3, 3) the rows pose, velocity, acceleration. Returns 0, or a code for
    Bounds.violation; then `found` (2,) holds the value and its limit.
    """
    code = check_setpoint(bounds, rows, found)
    if code == 0:
        code = check_pose(bounds, motion[0], found)
    if code == 0:
        code = _check_step(bounds, rows, rows_before, found)
    if code == 0:
        code = _check_platform(bounds, motion, motion_before, found)
    return code


class Bounds:
    """The limits of a robot, as bounds on the rows of a solved motion and on the pose.

    `edge` [m, rad] is by how much a position may be beyond its limit, `labels` what people call the sliders.
    """

    def __init__(self, limits: Limits, period: float, edge: float = ROUNDING, labels: Labels = LEGS) -> None:
        slider, platform = limits.slider, limits.platform
        self.labels = labels
        self.packed = np.zeros(1, BOUNDS)
        """As compiled code takes them, (1,) of BOUNDS."""
        self.found = np.zeros(2)
        """The value that was last found to be beyond its limit, and that limit."""
        bounds = self.packed[0]
        bounds["rows"] = (
            [(*ends, edge) for ends in slider.positions],
            [(-velocity, velocity, velocity * EXCESS) for velocity in slider.velocities],
            [(-acceleration, acceleration, acceleration * EXCESS) for acceleration in slider.accelerations],
            [(*slider.passive, edge)] * 3,
        )
        bounds["pose"] = platform.x, platform.y, platform.phi
        bounds["edge"] = edge
        bounds["step"] = [velocity * (1.0 + EXCESS) * period for velocity in slider.velocities]
        bounds["slider_jerk"] = slider.jerks
        bounds["platform"] = np.transpose((platform.velocity, platform.acceleration, platform.jerk))
        bounds["period"] = period

    @property
    def box(self) -> Array:
        """Low and high of x, y [m] and phi [rad], (2, 3)."""
        box: Array = self.packed[0]["pose"].T
        return box

    def pose(self, pose: ArrayLike) -> Violation | None:
        """Check a pose x, y [m], phi [rad] alone."""
        return self.violation(check_pose(self.packed, np.array(pose, dtype=np.float64), self.found))

    def setpoint(self, rows: ArrayLike) -> Violation | None:
        """Check solved sliders, as many of position, velocity, acceleration, cross slide as given [m, s]."""
        return self.violation(check_setpoint(self.packed, np.array(rows, dtype=np.float64), self.found))

    def violation(self, code: int) -> Violation | None:
        """Put into words what has just been found; None for 0."""
        if code == 0:
            return None
        check, n = divmod(code - 1, 3)
        subject, quantity, unit = _CHECKS[check]
        value, limit = self.found.tolist()
        if subject == "slider":
            return Violation(LEGS[n], quantity, value, limit, unit, self.labels[n])
        return Violation(COORDINATES[n], quantity, value, limit, UNITS[n] + unit)
