"""How long goals take to settle on the simulated drives as they are shipped, and what is left to go then."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any

from bench_rig import QUANTILES, Rig, quantiles
from trirail.client.goal import Result

SEED = 5
WITHIN = 30.0
"""How long a goal may take [s]."""


def measure(made: Rig, goals: int) -> dict[str, Any]:
    """Send so many goals, one after the other; return how they ended, and milliseconds and micrometres at QUANTILES."""
    chance = random.Random(SEED)
    results = [
        made.robot.move_to(
            x=chance.uniform(-0.06, 0.06), y=chance.uniform(-0.06, 0.06), phi=chance.uniform(-0.5, 0.4)
        ).wait(WITHIN)
        for _ in range(goals)
    ]
    settled = [result for result in results if result.settle is not None]
    return {
        "quantiles": QUANTILES,
        "outcomes": dict(Counter(result.outcome for result in results)),
        "settle_ms": quantiles([1e3 * (result.settle or 0.0) for result in settled]),
        "residual_um": quantiles([1e6 * _residual(result) for result in settled]),
        "overshoot_um": quantiles([1e6 * max(result.overshoot or (0.0,)) for result in settled]),
    }


def _residual(result: Result) -> float:
    """Return the greatest of a slider [m]."""
    return max(map(abs, result.residual.sliders)) if result.residual else 0.0
