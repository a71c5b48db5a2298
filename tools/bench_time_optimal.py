"""How long goals take on sliders too weak for them: as planned, and slowed as a whole, beside a bound."""

from __future__ import annotations

import random
import time
from typing import NamedTuple
from unittest.mock import patch

import msgspec
import numpy as np
from numpy.typing import NDArray
from trirail.config import SIM, Limits, geometry, load
from trirail.errors import RefusedError
from trirail.kinematics.compiled import compiled
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import inverse
from trirail.motion.feasibility import Checker
from trirail.motion.limits import Bounds
from trirail.motion.planner import Planner
from trirail.motion.runs import rest

GOALS, SEED = 300, 13
WEAK = {"velocity": 0.3, "acceleration": 3.0, "jerk": 50.0}
"""Limits of the sliders [m/s, m/s², m/s³]."""
GRID = 2000
"""Parts of a line over which the bound is computed."""
AIM = 1.10
"""Of the bound, that the median should take."""
SHOWN = {"p10": 10, "p50": 50, "p90": 90, "max": 100}

Triple = tuple[float, float, float]
Array = NDArray[np.float64]


class Times(NamedTuple):
    """How long a goal takes [s]."""

    ruckig: float
    """Were the sliders strong."""
    uniform: float
    """Slowed as a whole."""
    planned: float
    bound: float
    thinking: float
    """Processor time of planning."""


def measure() -> dict[str, object]:
    """Return the distributions of the ratios of these times, for goals all over the workspace, from rest to rest."""
    config = load(SIM)
    slider = msgspec.structs.replace(config.limits.slider, **WEAK)
    limits = msgspec.structs.replace(config.limits, slider=slider)
    robot = geometry(config.geometry)
    bounds = Bounds(limits, config.period)
    checker = Checker(robot, limits, bounds, config.period)
    planner = Planner(robot, limits.platform, limits.slider, bounds, checker, config.period)
    rnd = random.Random(SEED)
    found: list[Times] = []
    while len(found) < GOALS:
        start, target = _pose(rnd, limits), _pose(rnd, limits)
        try:
            planner.check_pose(start)
            found.append(_times(planner, robot, limits, start, target))
        except RefusedError:  # out of reach, on the way or at an end
            continue
    times = np.array(found[1:])  # the first one warms up
    ruckig, uniform, planned, bound, thinking = times.T
    return {
        "goals": len(times),
        "slowed": float((planned > ruckig).mean()),
        "uniform_to_ruckig": _shown(uniform / ruckig),
        "uniform_to_bound": _shown(uniform / bound),
        "planned_to_bound": _shown(planned / bound),
        "planned_to_uniform": _shown(planned / uniform),
        "planning_ms": _shown(thinking * 1e3) | {"p99": float(np.percentile(thinking * 1e3, 99))},
        "aim_to_bound": AIM,
    }


def report(found: dict[str, object]) -> None:
    """Print them."""
    print(
        "sliders of {velocity:g} m/s, {acceleration:g} m/s², {jerk:g} m/s³: {goals} goals, {slowed:.0%} slowed".format(
            **WEAK, **found
        )
    )
    print(f"{'time to …':<34}" + "".join(f"{name:>7}" for name in SHOWN))
    for key, name in (
        ("uniform_to_ruckig", "slowed as a whole / Ruckig's"),
        ("uniform_to_bound", "slowed as a whole / the bound"),
        ("planned_to_bound", "as planned / the bound"),
        ("planned_to_uniform", "as planned / slowed as a whole"),
    ):
        print(f"{name:<34}" + "".join(f"{found[key][shown]:7.3f}" for shown in SHOWN))  # type: ignore[index]
    print(f"The bound has no limit of jerk (TOPP-RA on the same line); the aim is {AIM:g} in the median.")
    thinking = found["planning_ms"]
    print("planning one, processor time: p50 {p50:.1f} ms, p99 {p99:.1f} ms".format(**thinking))  # type: ignore[arg-type]


def _shown(values: Array) -> dict[str, float]:
    return {name: float(np.percentile(values, share)) for name, share in SHOWN.items()}


def _pose(rnd: random.Random, limits: Limits) -> Triple:
    box = limits.platform
    return rnd.uniform(*box.x), rnd.uniform(*box.y), rnd.uniform(*box.phi)


def _times(planner: Planner, robot: Geometry, limits: Limits, start: Triple, target: Triple) -> Times:
    with patch("trirail.motion.planner.time_optimal", return_value=None):
        uniform = planner.to_pose(rest(start), target)
    began = time.thread_time()
    planned = planner.to_pose(rest(start), target)
    thinking = time.thread_time() - began
    bound = topp_ra(robot, limits, start, target)
    return Times(uniform.path.duration / uniform.slowed, uniform.path.duration, planned.path.duration, bound, thinking)


def topp_ra(robot: Geometry, limits: Limits, start: Triple, target: Triple) -> float:
    """Return the shortest time from rest to rest on a line within limits of velocity and acceleration alone [s].

    H. Pham and Q.-C. Pham, A New Approach to Time-Optimal Path Parameterization Based on Reachability Analysis (2018):
    x = sigma'² may be as large as a later stop allows (backwards), and is made as large as can be reached (forwards).
    """
    length = np.subtract(target, start)
    sigma = np.linspace(0.0, 1.0, GRID + 1)[:, None]
    sliders = inverse(robot, start + sigma * length, length)
    first = np.hstack([sliders.velocity, np.broadcast_to(length, (GRID + 1, 3))])
    second = np.hstack([sliders.acceleration, np.zeros((GRID + 1, 3))])
    slider, platform = limits.slider, limits.platform
    velocity = np.array([slider.velocity] * 3 + list(platform.velocity))
    acceleration = np.array([slider.acceleration] * 3 + list(platform.acceleration))
    first = np.where(np.abs(first) > 1e-12, first, 1e-12)
    highest = ((velocity / first) ** 2).min(axis=1)
    return float(_topp_ra(-second / first, acceleration / np.abs(first), highest))


@compiled()
def _changes(centre: Array, half: Array, x: float) -> tuple[float, float]:
    """Return the least and the greatest change of x over a step."""
    step = 2.0 / GRID
    return step * (centre * x - half).max(), step * (centre * x + half).min()


@compiled()
def _topp_ra(centre: Array, half: Array, highest: Array) -> float:
    """Return the time, where the change of x is within `half` of `centre` x, (GRID + 1, m), and x below `highest`."""
    later = np.zeros(GRID + 1)
    for k in range(GRID - 1, -1, -1):
        low, high = 0.0, highest[k]
        for _ in range(60):
            x = (low + high) / 2.0
            least, greatest = _changes(centre[k], half[k], x)
            if least <= greatest and x + greatest >= 0.0 and x + least <= later[k + 1]:
                low = x
            else:
                high = x
        later[k] = low
    x, total = 0.0, 0.0
    for k in range(GRID):
        then = max(0.0, min(x + _changes(centre[k], half[k], x)[1], later[k + 1]))
        total += 2.0 / GRID / (np.sqrt(x) + np.sqrt(then))
        x = then
    return total
