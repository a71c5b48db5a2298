"""Detection that the robot is in position at the end of a path, with windows, a dwell time and a time-out.

While the commanded motion is at rest, each cycle compares the measured sliders and pose with the commanded ones. The
robot is in position once all six values have stayed inside their windows for every cycle of the dwell time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import NAMES, Triple

from trirail.config import InPosition
from trirail.kinematics.compiled import compiled
from trirail.naming import Labels
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.messages import Residual

__all__ = ["MONITOR", "Settling", "SettlingResult", "monitor"]

MIN_VELOCITY = 1e-9
"""Setpoint velocity above which a slider counts as moving [m/s]. Lower velocities are rounding."""

MONITOR = np.dtype(
    [
        ("window", "<f8", (2, 3)),  # for the sliders [m]; for x, y [m] and phi [rad]
        ("residual", "<f8", (2, 3)),  # commanded minus measured, in the same order
        ("heading", "<f8", 3),  # direction of the last commanded motion of a slider, 1 or -1; 0 if it did not move
        ("overshoot", "<f8", 3),  # overshoot of each slider since the end of the path [m]
        ("dwell", "<i8"),  # number of successive cycles inside the windows that is required
        ("inside", "<i8"),  # number of successive cycles inside the windows until now
        ("moved", "u1"),  # whether the commanded motion was moving in the previous cycle
    ],
    align=True,
)
"""State of the monitor between cycles, for compiled code."""


class SettlingResult(NamedTuple):
    """Result of the in-position monitor. The event that reports the end of the goal has the same fields."""

    settle: float | None
    """Time from the end of the path to the beginning of the dwell time [s]; None after a time-out."""
    residual: Residual
    """Commanded minus measured values when the goal ends."""
    overshoot: Triple
    """Greatest distance of each slider beyond its target since the end of the path [m]."""


class Settling:
    """Monitor that decides, after the end of a goal's path, whether the robot is in position.

    Compiled code updates the array `monitored` in every cycle.
    """

    def __init__(self, limits: InPosition, period: float) -> None:
        self.monitored = np.zeros(1, MONITOR)
        self.monitored["window"][0] = limits.sliders, limits.pose
        self.monitored["dwell"] = max(1, math.ceil(limits.dwell / period - 1e-9))
        self._limits = limits
        self._period = period
        self._timeout = math.ceil(limits.timeout / period - 1e-9)
        self._since: int | None = None

    @property
    def under_way(self) -> bool:
        """Whether a goal is still active after the end of its path, until the robot is in position."""
        return self._since is not None

    @property
    def ends(self) -> int | None:
        """Cycle in which the time-out elapses; None if no goal is settling."""
        return self._since + self._timeout if self._since is not None else None

    def begin(self, cycle: int) -> None:
        """Start monitoring a goal whose path ends with the setpoints of this cycle."""
        self._since = cycle

    def cancel(self) -> None:
        """Stop monitoring the goal."""
        self._since = None

    def result(self, cycle: int) -> SettlingResult | None:
        """Return the result after this cycle; None if the goal is still settling."""
        if self._since is None:
            return None
        inside = int(self.monitored["inside"][0])
        if inside >= self.monitored["dwell"][0]:
            return self.now((cycle + 1 - inside - self._since) * self._period)
        return self.now(None) if cycle - self._since >= self._timeout else None

    def now(self, settle: float | None) -> SettlingResult:
        """Return a result with the current residuals and overshoot, and with the given settling time [s]."""
        sliders, pose, overshoot = map(
            tuple, (*self.monitored["residual"][0].tolist(), *self.monitored["overshoot"].tolist())
        )
        return SettlingResult(settle, Residual(sliders, pose), overshoot)

    def describe(self, settled: SettlingResult, labels: Labels = NAMES) -> EventText:
        """Return a text about the result, with the settling time, or with the residuals after a time-out."""
        if settled.settle is not None:
            x, y, phi = map(abs, settled.residual.pose)
            residual = (
                f"{max(map(abs, settled.residual.sliders)) * 1e6:.2f} µm of a slider, {max(x, y) * 1e6:.2f} µm in x, y"
            )
            words = f"arrived, settled after {settled.settle * 1e3:g} ms; residual {residual}, {phi * 1e6:.2f} µrad"
            return coded(words, EventCode.SETTLED, settle=settled.settle)
        x, y, phi = settled.residual.pose
        errors = zip(labels, settled.residual.sliders, strict=True)
        residuals = [f"slider {name} {error * 1e3:.3f} mm" for name, error in errors]
        residuals += [f"x {x * 1e3:.3f} mm", f"y {y * 1e3:.3f} mm", f"phi {phi * 1e3:.3f} mrad"]
        words = (
            f"not in position {self._limits.timeout:g} s after the end of the path; "
            f"residuals: {', '.join(residuals)} (limits.in_position)"
        )
        return coded(words, EventCode.NOT_IN_POSITION, timeout=self._limits.timeout)


@compiled()
def monitor(record: NDArray[np.void], known: bool, at_rest: bool, monitored: NDArray[np.void]) -> None:
    """Compare the measured values in the record with the commanded ones, and record whether the robot is in position.

    Parameters
    ----------
    record : (1,)
        Record of the cycle.
    known
        Whether a pose matches the measured sliders.
    at_rest
        Whether the commanded motion is at rest.
    monitored : (1,)
        State of the monitor.

    """
    state, row = monitored[0], record[0]
    if not at_rest:
        for i in range(3):
            if state.moved == 0:
                state.heading[i] = 0.0
            if abs(row.commanded_velocity[i]) > MIN_VELOCITY:
                state.heading[i] = math.copysign(1.0, row.commanded_velocity[i])
            state.overshoot[i] = 0.0
        state.moved, state.inside, row.settled = 1, 0, 0
        return
    state.moved = 0
    within = known
    for i in range(3):
        state.residual[0, i] = row.commanded_position[i] - row.position[i]
        state.residual[1, i] = row.commanded_pose[i] - row.pose[i]
        within &= abs(state.residual[0, i]) <= state.window[0, i] and abs(state.residual[1, i]) <= state.window[1, i]
        beyond = -state.residual[0, i] * state.heading[i] if state.heading[i] != 0.0 else abs(state.residual[0, i])
        state.overshoot[i] = max(state.overshoot[i], beyond)
    state.inside = state.inside + 1 if within else 0
    row.settled = state.inside >= state.dwell
