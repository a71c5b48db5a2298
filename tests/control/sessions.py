"""Whole sessions of the control, a cycle at a time, over drives that are where they were told to be; what is judged."""

from __future__ import annotations

import numpy as np
from control_rig import CONFIG, ControlRig
from numpy.typing import NDArray
from trirail.config import Config
from trirail.wire.packets import Request
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import MODES, Mode

EXCESS = 1e-3
"""By that share may a setpoint exceed a limit: what lies between the moments at which a path is looked at."""


class Session(ControlRig):
    """A robot that is enabled; `kept` are the records of its cycles."""

    def __init__(self, config: Config = CONFIG) -> None:
        self.kept: list[NDArray[np.void]] = []
        super().__init__(config)
        self.enable()

    def cycle(self, request: Request | None = None) -> None:
        """Run one cycle, with a request or without."""
        super().cycle(request)
        self.rows.clear()
        record = self.control.measured.record.copy()
        record["mode"] = MODES.index(self.mode)
        self.kept.append(record)

    @property
    def ended(self) -> dict[str | None, str | None]:
        """How each goal has ended."""
        return dict(self.outcomes())

    @property
    def records(self) -> NDArray[np.void]:
        """The records of all cycles, (cycles,)."""
        return np.concatenate(self.kept) if self.kept else np.zeros(0, DTYPE)


def shares(config: Config, records: NDArray[np.void]) -> dict[str, float]:
    """Return the greatest share of each limit that was made use of, by name; jerk from cycle to cycle.

    Where the robot follows what is measured, without power or in fault, it is commanded no motion.
    """
    commanded = np.isin(records["mode"], [MODES.index(mode) for mode in (Mode.HOLDING, Mode.MOVING, Mode.STOPPING)])
    both = commanded[1:] & commanded[:-1]
    platform, slider = config.limits.platform, config.limits.slider
    found = {}
    for name, prefix, limits in (
        ("platform", "commanded_pose", (platform.velocity, platform.acceleration, platform.jerk)),
        ("slider", "commanded", (slider.velocities, slider.accelerations, slider.jerks)),
    ):
        velocity, acceleration = records[f"{prefix}_velocity"], records[f"{prefix}_acceleration"]
        jerk = np.diff(acceleration, axis=0)[both] / config.period
        velocity, acceleration = velocity[commanded], acceleration[commanded]
        for quantity, rows, limit in zip(
            ("velocity", "acceleration", "jerk"), (velocity, acceleration, jerk), limits, strict=True
        ):
            found[f"{name} {quantity}"] = float((np.abs(rows) / limit).max(initial=0.0))
    return found


def assert_within_limits(config: Config, records: NDArray[np.void]) -> None:
    """Every limit of rate holds, but for rounding and what lies between two looks."""
    over = {name: share for name, share in shares(config, records).items() if share > 1.0 + EXCESS}
    assert not over
