"""Checks that the rails and time-outs are long enough for the stopping distances and times of the sliders."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from msgspec import Struct

from trirail.config import Config, corrected_geometry
from trirail.diagnosis.check import Check, ConfigCheck, format_value, is_simulated
from trirail.kinematics.arrays import Array
from trirail.kinematics.robot import jacobians
from trirail.motion.backlash_reserve import planned_limits
from trirail.motion.time_scaling import stop_duration
from trirail.quantities import rounded_inwards

REACHABLE_FACTOR = 2.0
"""Factor by which the platform may be faster near the edge of its workspace than in the middle."""
MOST_CONDITION = 1e9
"""Greatest condition number of a matrix that is not treated as singular."""


class Stops(Struct, frozen=True):
    """Distances and durations of a slider's stops from its velocity limit, and the slider's rail."""

    velocity: float
    """Velocity limit [m/s]."""
    way: float
    """Distance of a controlled stop [m]."""
    time: float
    """Duration of a controlled stop [s]."""
    quick_way: float
    """Distance of a quick stop with the drive's ramp [m]."""
    quick_time: float
    """Duration of a quick stop with the drive's ramp [s]."""
    travel: tuple[float, float]
    """Ends of the slider's travel, from limits.slider.position [m]."""
    rail: tuple[float, float] | None
    """Ends of the rail [m]; None if the configuration contains measured legs, which do not specify the ends."""

    @property
    def left(self) -> float | None:
        """Length of the rail outside the travel, on the side where it is shorter [m]; None if the rail is unknown."""
        return None if self.rail is None else min(self.travel[0] - self.rail[0], self.rail[1] - self.travel[1])

    @property
    def longer(self) -> float:
        """Distance of the longer of the two stops [m]."""
        return max(self.way, self.quick_way)


def stops(config: Config) -> Stops:
    """Return the stops of the slider for which a controlled stop needs the largest fraction of the travel."""
    return max(each_stops(config), key=lambda each: each.way / (each.travel[1] - each.travel[0]))


def each_stops(config: Config) -> list[Stops]:
    """Return the stops of the sliders A, B, C.

    A controlled stop obeys the limits of all sliders and of the platform, and lasts equally long for every slider, see
    stop_duration. A quick stop with deceleration q takes the time v / q and the distance v² / 2q.
    """
    slider, quick = config.limits.slider, config.drives.quick_stop_deceleration
    rail = None
    if config.geometry.l0 is not None:  # the rails are the sides of the paper's triangle, with 0 at a third of each
        third = config.geometry.l0 / math.sqrt(3.0)
        rail = -third, 2.0 * third
    time = stop_duration(planned_limits(config.limits, config.correction.backlash), _reachable(config))
    return [
        Stops(v, v * time / 2.0, time, v * v / (2.0 * quick), v / quick, travel, rail)
        for v, travel in zip(slider.velocities, slider.positions, strict=True)
    ]


def _reachable(config: Config) -> Array:
    """Return velocities of the platform in x, y, phi that the sliders do not let it exceed [m/s, rad/s], (3,).

    They are those with all sliders at their limits in the middle of the workspace, with a factor for other poses.
    """
    j1, j2 = jacobians(corrected_geometry(config), (0.0, 0.0, 0.0))
    if np.linalg.cond(j2) > MOST_CONDITION:
        return np.full(3, np.inf)
    reachable: Array = REACHABLE_FACTOR * np.abs(np.linalg.solve(j2, j1)) @ config.limits.slider.velocities
    return reachable


def _rail(config: Config) -> Iterator[Check]:
    """Check that a slider that reaches the end of its travel at full velocity can still stop on the rail.

    This can happen if the scale or the home position of the slider is wrong.
    """
    every = each_stops(config)
    outermost = min(every, key=lambda each: each.left or 0.0)
    stop = outermost if (outermost.left or 0.0) < 0.0 else min(every, key=lambda each: (each.left or 0.0) - each.longer)
    speed = f"from {stop.velocity * 1e3:g} mm/s"
    ways = f"{speed} a quick stop takes {stop.quick_way * 1e3:.3g} mm, a controlled stop {stop.way * 1e3:.3g} mm"
    if stop.left is None:
        remedy = "check that each rail extends as far beyond limits.slider.position: measured legs do not contain it"
        yield Check("rail", "ok", ways, remedy)
    elif stop.left < 0.0:
        low, high = stop.rail or stop.travel
        finding = f"limits.slider.position = [{stop.travel[0]:g}, {stop.travel[1]:g}] exceeds the rails: with "
        finding += f"geometry.l0 = {config.geometry.l0:g} m they end at {low:.4g} and {high:.4g} m"
        yield Check("rail", "failure", finding, "correct one of the two", "limits.slider.position")
    elif stop.longer <= stop.left:
        yield Check("rail", "ok", f"{ways}; {stop.left * 1e3:.3g} mm are left beyond the travel")
    elif is_simulated(config.can):
        yield Check("rail", "ok", f"{ways}; {stop.left * 1e3:.3g} mm are left: enough for simulated drives")
    else:
        quick = stop.quick_way > stop.left
        ramp = (
            "drives.quick_stop_deceleration" if quick else "acceleration and jerk in limits.platform and limits.slider"
        )
        finding = f"{ways}; {stop.left * 1e3:.3g} mm of rail are left beyond limits.slider.position"
        remedy = (
            f"lower limits.slider.velocity, end the travel {stop.longer * 1e3:.3g} mm before the rail, or raise {ramp}"
        )
        yield Check("rail", "warning", finding, remedy, "limits.slider.velocity")


def _travel(config: Config) -> Iterator[Check]:
    """Check that each slider can reach its velocity limit and brake again within its travel.

    It needs the time t = v / a + a / j for each, or t = 2 sqrt(v / j) if the acceleration does not reach its limit a.
    The distance is v t / 2. The platform's limits can make it longer.
    """
    slider = config.limits.slider
    for v, a, j, (low, high) in zip(
        slider.velocities, slider.accelerations, slider.jerks, slider.positions, strict=True
    ):
        way = v * (v / a + a / j if v >= a * a / j else 2.0 * math.sqrt(v / j)) / 2.0
        if 2.0 * way > high - low:
            finding = f"acceleration to {v * 1e3:g} mm/s and braking from there take at least {way * 1e3:.3g} mm each: "
            finding += f"no motion within the travel of {(high - low) * 1e3:.3g} mm reaches that velocity"
            remedy = "set a lower limits.slider.velocity, or more acceleration and jerk"
            yield Check("travel", "warning", finding, remedy, "limits.slider.velocity")
            return


def _quick_stop(config: Config) -> Iterator[Check]:
    """Check that a quick stop ends within drives.stop_timeout, and that its ramp is plausible.

    After this time-out, the service switches the power off during the motion, with a fault.
    """
    stop, timeout = max(each_stops(config), key=lambda each: each.quick_time), config.drives.stop_timeout
    key = "drives.quick_stop_deceleration"
    ramp = format_value(key, config.drives.quick_stop_deceleration, "m/s²")
    if stop.quick_time > timeout:
        finding = f"from {stop.velocity * 1e3:g} mm/s it takes {stop.quick_time:.3g} s by {ramp}, longer than "
        finding += f"drives.stop_timeout = {timeout:g} s: power would be cut in motion, with a fault"
        minimum = rounded_inwards(stop.velocity / timeout, 3, low=True)
        remedy = f"set drives.quick_stop_deceleration above {minimum:g} m/s², or a longer drives.stop_timeout"
        yield Check("quick stop", "failure", finding, remedy, key)
    elif stop.quick_time < config.period:
        finding = f"from {stop.velocity * 1e3:g} mm/s it would take {stop.quick_time * 1e3:.2g} ms by {ramp}"
        yield Check(
            "quick stop", "warning", finding, "no slider stops within a cycle; set what the drives can brake", key
        )
    else:
        finding = (
            f"{stop.quick_time:.3g} s from {stop.velocity * 1e3:g} mm/s, within drives.stop_timeout, {timeout:g} s"
        )
        yield Check("quick stop", "ok", finding)


_STOPS = "limits.slider", "limits.platform", "drives.quick_stop_deceleration", "geometry", "correction.backlash"
"""Keys from which each_stops computes its result."""
CONFIG_CHECKS = (
    ConfigCheck((*_STOPS, "can"), _rail),
    ConfigCheck(("limits.slider",), _travel),
    ConfigCheck((*_STOPS, "drives.stop_timeout", "loop.rate_hz"), _quick_stop),
)
