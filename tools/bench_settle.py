"""How long goals take to settle on the simulated drives as they are shipped, and what is left to go then."""

from __future__ import annotations

import json as json_format
import random
from collections import Counter
from typing import Any

import numpy as np
from bench_rig import rig
from trirail.client.goal import Result

QUANTILES = (50.0, 99.0, 100.0)
SEED = 5
WITHIN = 30.0
"""How long a goal may take [s]."""


def measure(goals: int, rate: int = 1000) -> dict[str, Any]:
    """Send so many goals, one after the other; return how they ended, and milliseconds and micrometres at QUANTILES."""
    chance = random.Random(SEED)
    with rig(rate, own=True) as made:
        results = [
            made.robot.move_to(
                x=chance.uniform(-0.06, 0.06), y=chance.uniform(-0.06, 0.06), phi=chance.uniform(-0.5, 0.4)
            ).wait(WITHIN)
            for _ in range(goals)
        ]
    settled = [result for result in results if result.settle is not None]
    return {
        "rate_hz": rate,
        "quantiles": QUANTILES,
        "outcomes": dict(Counter(result.outcome for result in results)),
        "settle_ms": _spread([1e3 * (result.settle or 0.0) for result in settled]),
        "residual_um": _spread([1e6 * _residual(result) for result in settled]),
        "overshoot_um": _spread([1e6 * max(result.overshoot or (0.0,)) for result in settled]),
    }


def _residual(result: Result) -> float:
    """Return the greatest of a slider [m]."""
    return max(map(abs, result.residual.sliders)) if result.residual else 0.0


def _spread(values: list[float]) -> list[float]:
    if not values:
        raise SystemExit("no goal has settled")
    return [float(value) for value in np.percentile(values, QUANTILES)]


def main(goals: int, json: bool = False) -> None:
    """Print the measurements as a table, or as one JSON object."""
    measured = measure(goals)
    if json:
        print(json_format.dumps(measured))
        return
    ended = ", ".join(f"{count} {outcome}" for outcome, count in measured["outcomes"].items())
    print(f"from the end of a goal's path to its settling, {measured['rate_hz']} Hz, {ended}")
    print(f"{'':28}{'p50':>8}{'p99':>8}{'max':>8}")
    rows = (
        ("settle [ms]", "settle_ms"),
        ("residual of a slider [µm]", "residual_um"),
        ("overshoot [µm]", "overshoot_um"),
    )
    for name, key in rows:
        print(f"{name:28}" + "".join(f"{value:8.2f}" for value in measured[key]))
