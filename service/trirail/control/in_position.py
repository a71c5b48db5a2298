"""Detection of in-position from the measurement: the windows, the dwell and the time-out.

While the commanded motion is at rest, each cycle's measured sliders and their pose are compared with the commanded
ones. In position means: all six inside their windows, in every cycle of the dwell, up to the newest.
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

__all__ = ["MONITOR", "Settled", "Settling", "monitor"]

MOVES = 1e-9
"""Greatest velocity of a slider's setpoints that is rounding [m/s]."""

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


class Settled(NamedTuple):
    """Settling of a goal, or its residuals at the time-out; fields of the event of its end."""

    settle: float | None
    """Time from the end of the path to the first cycle of the dwell [s]; None where it did not settle."""
    residual: Residual
    """Commanded less measured at its end."""
    overshoot: Triple
    """Greatest distance of each slider beyond its target since the end of the path [m]."""


class Settling:
    """Judgement of the goal whose path has ended; `monitored` is the state of the compiled cycle."""

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
        """Cycle of the goal's time-out; None where there is no such goal."""
        return self._since + self._timeout if self._since is not None else None

    def begin(self, cycle: int) -> None:
        """Begin to settle: the path has ended with the setpoints of this cycle."""
        self._since = cycle
        self.monitored["inside"] = 0
        self.monitored["overshoot"] = 0.0

    def leave(self) -> None:
        """Stop judging the goal."""
        self._since = None

    def over(self, cycle: int) -> Settled | None:
        """Return the result by the measurement of this cycle; None while undecided."""
        if self._since is None:
            return None
        inside = int(self.monitored["inside"][0])
        if inside >= self.monitored["dwell"][0]:
            return self.now((cycle + 1 - inside - self._since) * self._period)
        return self.now(None) if cycle - self._since >= self._timeout else None

    def now(self, settle: float | None) -> Settled:
        """Return the current residuals and overshoot."""
        sliders, pose, overshoot = map(
            tuple, (*self.monitored["residual"][0].tolist(), *self.monitored["overshoot"].tolist())
        )
        return Settled(settle, Residual(sliders, pose), overshoot)

    def describe(self, settled: Settled, labels: Labels = NAMES) -> EventText:
        """Return the goal's settling time, or its residuals, as text."""
        if settled.settle is not None:
            x, y, phi = map(abs, settled.residual.pose)
            left = (
                f"{max(map(abs, settled.residual.sliders)) * 1e6:.2f} µm of a slider, {max(x, y) * 1e6:.2f} µm in x, y"
            )
            words = f"arrived, settled in {settled.settle * 1e3:g} ms; left to go: {left}, {phi * 1e6:.2f} µrad"
            return coded(words, EventCode.SETTLED, settle=settled.settle)
        x, y, phi = settled.residual.pose
        errors = zip(labels, settled.residual.sliders, strict=True)
        residuals = [f"slider {name} {error * 1e3:.3f} mm" for name, error in errors]
        residuals += [f"x {x * 1e3:.3f} mm", f"y {y * 1e3:.3f} mm", f"phi {phi * 1e3:.3f} mrad"]
        words = (
            f"not in position {self._limits.timeout:g} s after the end of its path; "
            f"left to go: {', '.join(residuals)} (limits.in_position)"
        )
        return coded(words, EventCode.NOT_IN_POSITION, timeout=self._limits.timeout)


@compiled()
def monitor(record: NDArray[np.void], known: bool, stands: bool, monitored: NDArray[np.void]) -> None:
    """Compare the measured values in the record with the commanded ones; record whether the robot has settled.

    `known` is whether the measured sliders belong to a pose, `stands` whether the commanded motion is at rest.
    """
    kept, told = monitored[0], record[0]
    if not stands:
        for i in range(3):
            if kept.moved == 0:
                kept.heading[i] = 0.0
            if abs(told.commanded_velocity[i]) > MOVES:
                kept.heading[i] = math.copysign(1.0, told.commanded_velocity[i])
        kept.moved, kept.inside, told.settled = 1, 0, 0
        return
    kept.moved = 0
    within = known
    for i in range(3):
        kept.residual[0, i] = told.commanded_position[i] - told.position[i]
        kept.residual[1, i] = told.commanded_pose[i] - told.pose[i]
        within &= abs(kept.residual[0, i]) <= kept.window[0, i] and abs(kept.residual[1, i]) <= kept.window[1, i]
        beyond = -kept.residual[0, i] * kept.heading[i] if kept.heading[i] != 0.0 else abs(kept.residual[0, i])
        kept.overshoot[i] = max(kept.overshoot[i], beyond)
    kept.inside = kept.inside + 1 if within else 0
    told.settled = kept.inside >= kept.dwell
