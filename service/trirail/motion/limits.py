"""Checks of paths, poses and setpoints against the limits of sliders and platform, including the last gate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numba import f8, from_dtype, i8
from numpy.typing import ArrayLike, NDArray

from trirail.config import Limits
from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled
from trirail.kinematics.geometry import LEGS
from trirail.motion.paths import OUTWARD_ROUNDING, ROUNDING
from trirail.naming import Labels
from trirail.quantities import beyond, worded

COORDINATES = ("x", "y", "phi")
UNITS = ("m", "m", "rad")

SETPOINT_TOLERANCE = 1e-6
"""Distance by which a setpoint may exceed a position limit that was used for planning [m, rad]."""
MAX_RELATIVE_EXCESS = 1e-3
"""Relative amount by which a setpoint may exceed the velocity, acceleration and jerk limits that were used for
planning."""


class AllowedMotion(IntEnum):
    """Motion of the platform that the current mode allows. The last gate refuses all other motion."""

    ANY = 0
    """Any motion within the limits."""
    BRAKING = 1
    """Any motion until the law leads to a standstill. The limits may delay the change to a law that brakes."""
    BRAKED = 2
    """Only a motion with a law that leads to a standstill."""
    NONE = 3
    """No motion of the platform. The sliders may still move to compensate backlash."""


BOUNDS = np.dtype(
    [
        ("rows", "f8", (4, 3, 3)),  # position, velocity, acceleration, cross slide; for each leg: low, high, tolerance
        ("pose", "f8", (3, 2)),  # x, y, phi: low, high
        ("edge", "f8"),  # tolerance of the pose limits [m, rad]
        ("step", "f8", 3),  # greatest travel of each slider in one cycle [m]
        ("slider_jerk", "f8", 3),
        ("platform", "f8", (3, 3)),  # velocity, acceleration and jerk of x, y, phi
        ("period", "f8"),
        ("allowed", "u1"),  # an AllowedMotion
    ]
)
"""Layout of a robot's limits for compiled code [m, rad, s]."""
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
"""Subject, quantity and unit of each check. For the platform, the unit is appended to the unit of the coordinate."""
_PASSIVE, _POSE, _STEP, _JERK, _PLATFORM = 3, 4, 5, 6, 7  # indices of _CHECKS; 0 to 3 are the sliders' rows


class Violation(NamedTuple):
    """Description of a quantity that exceeds its limit."""

    axis: str
    """Slider (A, B, C) or platform coordinate (x, y, phi)."""
    quantity: str
    value: float
    limit: float
    unit: str
    label: str = ""
    """Label of the slider, from the key labels in [geometry]; empty for the platform."""

    def __str__(self) -> str:
        return beyond(f"{self.subject}: {self.quantity}", self.value, self.limit, self.unit)

    @property
    def subject(self) -> str:
        """Text for messages that names the slider or the coordinate, with the word "slider" or "platform"."""
        return f"{self.part} {self.name}"

    @property
    def part(self) -> str:
        """Part of the robot that exceeds its limit: "slider" or "platform"."""
        return "slider" if self.axis in LEGS else "platform"

    @property
    def name(self) -> str:
        """Name of the slider or of the coordinate for messages."""
        return self.label or self.axis

    @property
    def bound(self) -> str:
        """Text for messages that names the quantity and its limit."""
        return f"{self.subject} ({self.quantity} {worded(self.limit, self.unit)})"


_BOUNDS, _ROWS, _ROW = from_dtype(BOUNDS)[::1], f8[:, ::1], f8[::1]


@compiled()
def _store_violation(check: int, n: int, value: float, limit: float, violation: Array) -> int:
    """Store the value and the limit. Return the code of the violation, 1 + 3 * check + index of leg or coordinate."""
    violation[0], violation[1] = value, limit
    return 1 + 3 * check + n


@compiled()
def _least_jerk(now: Array, before: Array, n: int, period: float) -> float:
    """Return a lower bound of the jerk with which the motion of one cycle leads from state `before` to state `now`.

    The acceleration may change continuously or in a jump, as at the ends of some paths, but by at most j T in total
    within the cycle T. The change of velocity then differs by at most j T² / 2 from the mean acceleration times T, and
    the change of position by less than j T³ / 4 from the mean velocity times T. Without jumps, the bounds are
    j T² / 4 and j T³ / 12, and the result can be half of the jerk. The tighter bounds would refuse paths that begin or
    end with an acceleration.
    """
    half = period / 2.0
    p, v, a = now[0, n], now[1, n], now[2, n]
    p0, v0, a0 = before[0, n], before[1, n], before[2, n]
    by_acceleration: float = abs(a - a0) / period
    by_velocity: float = abs(v - v0 - half * (a + a0)) / (half * period)
    by_position: float = 4.0 * (abs(p - p0 - half * (v + v0)) - ROUNDING) / period**3
    return max(by_acceleration, by_velocity, by_position)


@compiled()
def _check_row(bounds: NDArray[np.void], rows: Array, row: int, violation: Array) -> int:
    """Check one row of the sliders' motion against its limits. Return 0 or the code of the first violation."""
    for n in range(3):
        limits = bounds[0].rows[row, n]
        low, high, slack = limits[0], limits[1], limits[2]
        value = rows[row, n]
        if not low - slack <= value <= high + slack:
            return _store_violation(row, n, value, low if value < low else high, violation)
    return 0


@compiled(i8(_BOUNDS, _ROWS, _ROW))
def check_setpoint(bounds: NDArray[np.void], rows: Array, violation: Array) -> int:
    """Check the sliders of a setpoint. The rows are position, velocity, acceleration and cross slide [m, s].

    Later rows may be missing. NaN violates every limit. Returns 0, or a code for Bounds.violation.
    """
    for row in range(min(len(rows), 4)):
        code = _check_row(bounds, rows, row, violation)
        if code:
            return code
    return 0


@compiled()
def _check_rates(bounds: NDArray[np.void], rows: Array, violation: Array) -> int:
    """Check only the velocities and accelerations of the sliders."""
    for row in (1, 2):
        code = _check_row(bounds, rows, row, violation)
        if code:
            return code
    return 0


@compiled(i8(_BOUNDS, _ROW, _ROW))
def check_pose(bounds: NDArray[np.void], pose: Array, violation: Array) -> int:
    """Check a pose x, y [m], phi [rad] against the platform's limits. Returns 0, or a code for Bounds.violation."""
    edge = bounds[0].edge
    for n in range(3):
        low, high = bounds[0].pose[n, 0], bounds[0].pose[n, 1]
        if not low - edge <= pose[n] <= high + edge:
            return _store_violation(_POSE, n, pose[n], low if pose[n] < low else high, violation)
    return 0


@compiled()
def _check_step(bounds: NDArray[np.void], rows: Array, before: Array, violation: Array) -> int:
    """Check the travel and the jerk of the sliders since the previous cycle."""
    for n in range(3):
        step, most = rows[0, n] - before[0, n], bounds[0].step[n]
        if not abs(step) <= most:
            return _store_violation(_STEP, n, step, most, violation)
    for n in range(3):
        jerk, jerk_limit = _least_jerk(rows, before, n, bounds[0].period), bounds[0].slider_jerk[n]
        if not jerk <= jerk_limit * (1.0 + MAX_RELATIVE_EXCESS):
            return _store_violation(_JERK, n, jerk, jerk_limit, violation)
    return 0


@compiled()
def _check_platform(bounds: NDArray[np.void], motion: Array, before: Array, violation: Array) -> int:
    """Check the platform's velocity and acceleration, and its jerk since the previous cycle."""
    for n in range(3):
        limits = bounds[0].platform[n]
        for row in range(2):
            value = motion[1 + row, n]
            if not abs(value) <= limits[row] * (1.0 + MAX_RELATIVE_EXCESS):
                return _store_violation(_PLATFORM + row, n, value, math.copysign(limits[row], value), violation)
        jerk = _least_jerk(motion, before, n, bounds[0].period)
        if not jerk <= limits[2] * (1.0 + MAX_RELATIVE_EXCESS):
            return _store_violation(_PLATFORM + 2, n, jerk, limits[2], violation)
    return 0


@compiled()
def _check_positions(
    bounds: NDArray[np.void], rows: Array, before: Array, pose: Array, pose_before: Array, violation: Array
) -> int:
    """Check that each position is within its limits, or at least not farther outside than in the previous cycle."""
    for row in (0, 3):
        for n in range(3):
            limits = bounds[0].rows[row, n]
            low, high, slack = limits[0], limits[1], limits[2]
            value, last = rows[row, n], before[row, n]
            if not min(low - slack, last - OUTWARD_ROUNDING) <= value <= max(high + slack, last + OUTWARD_ROUNDING):
                return _store_violation(row, n, value, low if value < low else high, violation)
    edge = bounds[0].edge
    for n in range(3):
        low, high = bounds[0].pose[n, 0], bounds[0].pose[n, 1]
        if (
            not min(low - edge, pose_before[n] - OUTWARD_ROUNDING)
            <= pose[n]
            <= max(high + edge, pose_before[n] + OUTWARD_ROUNDING)
        ):
            return _store_violation(_POSE, n, pose[n], low if pose[n] < low else high, violation)
    return 0


@compiled(i8(_BOUNDS, _ROWS, _ROWS, _ROWS, _ROWS, _ROW))
def gate(
    bounds: NDArray[np.void], rows: Array, rows_before: Array, motion: Array, motion_before: Array, violation: Array
) -> int:
    """Check a setpoint and the commanded motion of the platform. This is the last gate.

    A position beyond its limit may return towards the limit, but must not move farther out. Steps and jerks are
    computed from the difference to the previous cycle.

    Parameters
    ----------
    bounds : (1,) of BOUNDS
        Limits of the robot.
    rows, rows_before : (4, 3)
        Motion of the sliders now and in the previous cycle, with the rows of check_setpoint.
    motion, motion_before : (3, 3)
        Pose, velocity and acceleration of the platform now and in the previous cycle.
    violation : (2,)
        Output: the value that violates its limit, and the limit.

    Returns
    -------
    int
        0, or a code for Bounds.violation.
    """
    code = _check_positions(bounds, rows, rows_before, motion[0], motion_before[0], violation)
    if code == 0:
        code = _check_rates(bounds, rows, violation)
    if code == 0:
        code = _check_step(bounds, rows, rows_before, violation)
    if code == 0:
        code = _check_platform(bounds, motion, motion_before, violation)
    return code


def standing_tolerance(limits: Limits, arm: float) -> Array:
    """Return tolerances for the measured positions of a robot that rests at its limits, (9,) [m, m, rad, m …].

    The tolerances of x, y, phi and the sliders are the in-position windows. The tolerance of the cross slides is the
    sum of the windows that affect a cross slide. `limits` come from backlash_reserve.planned_limits, and `arm` is
    Geometry.arm [m].
    """
    x, y, phi = limits.in_position.pose
    sliders = limits.in_position.sliders
    return np.array([x, y, phi, *sliders, *[max(sliders) + math.hypot(x, y) + arm * phi] * 3])


class Bounds:
    """Limits of one robot in the layout that compiled checks need, and conversion of violations to messages.

    `edge` is the tolerance of positions [m, rad]. `labels` are the names of the sliders in messages.
    """

    def __init__(self, limits: Limits, period: float, edge: float = ROUNDING, labels: Labels = LEGS) -> None:
        slider, platform = limits.slider, limits.platform
        self.labels = labels
        self.packed = np.zeros(1, BOUNDS)
        """Limits for compiled code, (1,) of dtype BOUNDS."""
        self.last_violation = np.zeros(2)
        """Last value that violated its limit, and the limit."""
        bounds = self.packed[0]
        bounds["rows"] = (
            [(*ends, edge) for ends in slider.positions],
            [(-velocity, velocity, velocity * MAX_RELATIVE_EXCESS) for velocity in slider.velocities],
            [
                (-acceleration, acceleration, acceleration * MAX_RELATIVE_EXCESS)
                for acceleration in slider.accelerations
            ],
            [(*slider.passive, edge)] * 3,
        )
        bounds["pose"] = platform.x, platform.y, platform.phi
        bounds["edge"] = edge
        bounds["step"] = [velocity * (1.0 + MAX_RELATIVE_EXCESS) * period for velocity in slider.velocities]
        bounds["slider_jerk"] = slider.jerks
        bounds["platform"] = np.transpose((platform.velocity, platform.acceleration, platform.jerk))
        bounds["period"] = period

    @property
    def box(self) -> Array:
        """Low and high limits of x, y [m] and phi [rad], (2, 3)."""
        box: Array = self.packed[0]["pose"].T
        return box

    def pose_violation(self, pose: ArrayLike) -> Violation | None:
        """Return the first violation of the platform's position limits by a pose x, y [m], phi [rad]; None if valid."""
        return self.violation(check_pose(self.packed, np.array(pose, dtype=np.float64), self.last_violation))

    def pose_violation_from(self, pose: ArrayLike, start: Sequence[float]) -> Violation | None:
        """Return the first violation by a pose, but accept a coordinate that is no farther outside than at `start`."""
        values = np.array(pose, dtype=np.float64)
        edge, begin = float(self.packed[0]["edge"]), np.array(start)
        low = np.minimum(self.box[0] - edge, begin - OUTWARD_ROUNDING)
        high = np.maximum(self.box[1] + edge, begin + OUTWARD_ROUNDING)
        outside = (values < low) | (values > high) | np.isnan(values)
        return self.position_violation(int(np.argmax(outside)), float(values[outside][0])) if outside.any() else None

    def standing_violation(self, positions: Array, tolerance: Array) -> Violation | None:
        """Return the first violation by the nine positions of a robot at rest, given their tolerances (9,)."""
        low, high = np.vstack([self.packed[0]["pose"], *self.packed[0]["rows"][(0, 3), :, :2]]).T
        outside = (positions < low - tolerance) | (positions > high + tolerance)
        number = int(np.argmax(outside))
        return self.position_violation(number, float(positions[number])) if outside.any() else None

    def setpoint_violation(self, rows: ArrayLike) -> Violation | None:
        """Return the first violation by the sliders, with the rows of check_setpoint [m, s]; None if there is none."""
        return self.violation(check_setpoint(self.packed, np.array(rows, dtype=np.float64), self.last_violation))

    def position_violation(self, number: int, value: float) -> Violation | None:
        """Describe the violation by position `number` of nine: x, y, phi, sliders A to C, cross slides A to C."""
        check, n = (_POSE, 0, _PASSIVE)[number // 3], number % 3
        bounds = self.packed[0]
        low, high = bounds["pose"][n] if check == _POSE else bounds["rows"][check, n, :2]
        self.last_violation[:] = value, low if value < low else high
        return self.violation(1 + 3 * check + n)

    def violation(self, code: int) -> Violation | None:
        """Describe the violation that a check has reported by `code` and stored in last_violation; None for 0."""
        if code == 0:
            return None
        check, n = divmod(code - 1, 3)
        subject, quantity, unit = _CHECKS[check]
        value, limit = self.last_violation.tolist()
        if subject == "slider":
            return Violation(LEGS[n], quantity, value, limit, unit, self.labels[n])
        return Violation(COORDINATES[n], quantity, value, limit, UNITS[n] + unit)
