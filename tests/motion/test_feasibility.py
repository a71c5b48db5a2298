"""What a path and the law it is run by ask of the sliders, where their accelerations alone do not tell."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from conftest import CONFIG
from trirail.config import geometry
from trirail.motion.feasibility import Checker
from trirail.motion.limits import Bounds
from trirail.motion.paths import FOR_EVER, Path

PERIOD = CONFIG.period
PLATFORM = msgspec.structs.replace(CONFIG.limits.platform, jerk=(1e3, 1e3, 1e3))
LIMITS = msgspec.structs.replace(CONFIG.limits, platform=PLATFORM)
"""Such that the sliders' jerk is what binds."""
CHECKER = Checker(geometry(CONFIG.geometry), LIMITS, Bounds(LIMITS, PERIOD), PERIOD)
SPEED = 0.1
"""Of the platform along x, on a path of one second, at full rate [m/s]."""


def straight() -> Path:
    pieces = np.zeros((1, 3, 6))
    pieces[0, 0, :2] = -SPEED / 2.0, SPEED
    return Path(np.array([0.0, 1.0]), pieces)


def slower(by: float, within: float, edge: float) -> Path:
    """Return the law that takes so much off a rate of one; its change begins and ends at zero, in so short an edge."""
    knots = np.array([0.0, edge, within - edge, within, FOR_EVER])
    most = -by / (within - edge)
    s, rate, change = 0.0, 1.0, 0.0
    pieces = np.zeros((4, 1, 6))
    for k, jerk in enumerate((most / edge, 0.0, -most / edge, 0.0)):
        pieces[k, 0, :4] = s, rate, change / 2.0, jerk / 6.0
        t = knots[k + 1] - knots[k] if k < 3 else 0.0
        s += rate * t + change * t**2 / 2.0 + jerk * t**3 / 6.0
        rate, change = rate + change * t + jerk * t**2 / 2.0, change + jerk * t
    return Path(knots, pieces)


@pytest.mark.parametrize(("share", "within_limits"), [(0.9, True), (1.5, False)])
def test_a_change_of_rate_counts_with_what_the_velocities_tell(share: float, within_limits: bool) -> None:
    """Within one cycle the accelerations before and after are zero; a slider's velocity takes a step all the same."""
    by = share * LIMITS.slider.jerk * PERIOD**2 / 2.0 / SPEED
    law = slower(by, PERIOD, PERIOD / 20.0)
    assert CHECKER.look(straight(), law, 0.0, 0.9, (-SPEED / 2.0, 0.0, 0.0)).within_limits is within_limits
