"""Detection of "in position": windows, dwell and time-out.

While the commanded motion is at rest, each cycle compares the measured sliders and pose with the commanded ones. The
robot is in position if all six values have been inside their windows in every cycle of the dwell.
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
"""Velocity of setpoints above which a slider counts as moving [m/s]; a lower one is rounding."""

MONITOR = np.dtype(
    [
        ("window", "<f8", (2, 3)),  # of the sliders [m]; of x, y [m] and phi [rad]
        ("residual", "<f8", (2, 3)),  # commanded less measured, in the same order
        ("heading", "<f8", 3),  # 1 or -1: direction in which a slider was last commanded to move; 0 for no motion
        ("overshoot", "<f8", 3),  # of the sliders, since the end of the path [m]
        ("dwell", "<i8"),  # cycles
        ("inside", "<i8"),  # cycles in a row until now
        ("moved", "u1"),  # whether the commanded motion moved in the previous cycle
    ],
    align=True,
)
"""State of the monitor between cycles, for compiled code."""


class SettlingResult(NamedTuple):
    """Result of settling, with the fields of the event of the goal's end."""

    settle: float | None
    """Time from the end of the path to the first cycle of the dwell [s]; None if it did not settle in time."""
    residual: Residual
    """Commanded less measured values at the end."""
    overshoot: Triple
    """Greatest distance of each slider beyond its target since the end of the path [m]."""


class Settling:
    """Monitor of a goal whose path has ended; `monitored` is its state in the compiled cycle."""

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
        """Whether a goal's path has ended but the goal has not."""
        return self._since is not None

    @property
    def ends(self) -> int | None:
        """Cycle of the time-out; None while no goal settles."""
        return self._since + self._timeout if self._since is not None else None

    def begin(self, cycle: int) -> None:
        """Begin to monitor a goal whose path has ended with the setpoints of this cycle."""
        self._since = cycle
        self.monitored["inside"] = 0
        self.monitored["overshoot"] = 0.0

    def cancel(self) -> None:
        """Stop monitoring the goal."""
        self._since = None

    def result(self, cycle: int) -> SettlingResult | None:
        """Return the result after this cycle; None while undecided."""
        if self._since is None:
            return None
        inside = int(self.monitored["inside"][0])
        if inside >= self.monitored["dwell"][0]:
            return self.now((cycle + 1 - inside - self._since) * self._period)
        return self.now(None) if cycle - self._since >= self._timeout else None

    def now(self, settle: float | None) -> SettlingResult:
        """Return a result with the present residuals and overshoot."""
        sliders, pose, overshoot = map(
            tuple, (*self.monitored["residual"][0].tolist(), *self.monitored["overshoot"].tolist())
        )
        return SettlingResult(settle, Residual(sliders, pose), overshoot)

    def describe(self, settled: SettlingResult, labels: Labels = NAMES) -> EventText:
        """Return a result as text, with the settling time or the residuals."""
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
            f"not in position {self._limits.timeout:g} s after the end of its path; "
            f"residuals: {', '.join(residuals)} (limits.in_position)"
        )
        return coded(words, EventCode.NOT_IN_POSITION, timeout=self._limits.timeout)


@compiled()
def monitor(record: NDArray[np.void], known: bool, at_rest: bool, monitored: NDArray[np.void]) -> None:
    """Compare the measured values in the record with the commanded ones, and record whether the robot is in position.

    Parameters
    ----------
    record : (1,)
        The cycle's record.
    known
        Whether the measured sliders belong to a pose.
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
