"""How far and how long the sliders go on once they are to stop, and whether rails and time-outs have room for it."""

from __future__ import annotations

import math
from collections.abc import Iterator

from msgspec import Struct

from trirail.config import Config
from trirail.diagnosis.check import Check, Judgement, is_simulated, value


class Stops(Struct, frozen=True):
    """A slider that stops from its limit of velocity, and the rail that is left for it."""

    velocity: float
    """[m/s]."""
    way: float
    """Of a controlled stop [m]."""
    time: float
    """[s]."""
    quick_way: float
    """Of the drives' quick-stop ramp [m]."""
    quick_time: float
    """[s]."""
    travel: tuple[float, float]
    """limits.slider.position [m]."""
    rail: tuple[float, float] | None
    """Where the rails end [m]; None where legs were measured, which does not tell."""

    @property
    def left(self) -> float | None:
        """The rail beyond the travel, on the side where there is less [m]."""
        return None if self.rail is None else min(self.travel[0] - self.rail[0], self.rail[1] - self.travel[1])


def stops(config: Config) -> Stops:
    """Return how a slider stops from its limit of velocity: the one that needs most of its travel for that.

    A controlled stop is limited in acceleration a and jerk j: it takes v / a + a / j, or 2 sqrt(v / j) where a is not
    reached, and half of that times v is its way. A quick stop takes v / q, and v² / 2q.
    """
    slider, quick = config.limits.slider, config.drives.quick_stop_deceleration
    rail = None
    if config.geometry.l0 is not None:  # the sides of the paper's triangle; a slider reads 0 at a third of one
        third = config.geometry.l0 / math.sqrt(3.0)
        rail = -third, 2.0 * third
    found = []
    for v, a, j, travel in zip(slider.velocities, slider.accelerations, slider.jerks, slider.positions, strict=True):
        time = v / a + a / j if v >= a * a / j else 2.0 * math.sqrt(v / j)
        found.append(Stops(v, v * time / 2.0, time, v * v / (2.0 * quick), v / quick, travel, rail))
    return max(found, key=lambda each: each.way / (each.travel[1] - each.travel[0]))


def _rail(config: Config) -> Iterator[Check]:
    """A slider at full velocity at the end of its travel, by a wrong scale or home, has to stop on the rail."""
    found = stops(config)
    speed = f"from {found.velocity * 1e3:g} mm/s"
    ways = f"{speed} a quick stop takes {found.quick_way * 1e3:.3g} mm, a controlled one {found.way * 1e3:.3g} mm"
    longer = max(found.way, found.quick_way)
    if found.left is None:
        remedy = "see that so much of each rail is left beyond limits.slider.position: measured legs do not tell"
        yield Check("rail", "ok", ways, remedy)
    elif found.left < 0.0:
        low, high = found.rail or found.travel
        said = f"limits.slider.position = [{found.travel[0]:g}, {found.travel[1]:g}] goes beyond the rails: with "
        said += f"geometry.l0 = {config.geometry.l0:g} m they end at {low:.4g} and {high:.4g} m"
        yield Check("rail", "failure", said, "correct the one that is wrong", "limits.slider.position")
    elif longer <= found.left:
        yield Check("rail", "ok", f"{ways}; {found.left * 1e3:.3g} mm are left beyond the travel")
    elif is_simulated(config.can):
        yield Check("rail", "ok", f"{ways}; {found.left * 1e3:.3g} mm are left: enough for simulated drives")
    else:
        quick = found.quick_way > found.left
        ramp = "drives.quick_stop_deceleration" if quick else "limits.slider.acceleration and jerk"
        said = f"{ways}; {found.left * 1e3:.3g} mm of rail are left beyond limits.slider.position"
        remedy = (
            f"lower limits.slider.velocity, a travel that ends {longer * 1e3:.3g} mm before the rail, or more of {ramp}"
        )
        yield Check("rail", "warning", said, remedy, "limits.slider.velocity")


def _travel(config: Config) -> Iterator[Check]:
    """A velocity is reached, and left again, within the travel."""
    found = stops(config)
    travel = found.travel[1] - found.travel[0]
    if 2.0 * found.way > travel:
        said = f"from {found.velocity * 1e3:g} mm/s a controlled stop takes {found.way * 1e3:.3g} mm, as getting there "
        said += f"does: the travel is {travel * 1e3:.3g} mm, so that no motion is ever as fast"
        remedy = "a lower limits.slider.velocity, or more of its acceleration and jerk"
        yield Check("travel", "warning", said, remedy, "limits.slider.velocity")


def _quick_stop(config: Config) -> Iterator[Check]:
    """A quick stop that lasts longer than stop_timeout ends in a fault, with the power cut in motion."""
    found, timeout = stops(config), config.drives.stop_timeout
    key = "drives.quick_stop_deceleration"
    ramp = value(key, config.drives.quick_stop_deceleration, "m/s²")
    if found.quick_time > timeout:
        said = f"from {found.velocity * 1e3:g} mm/s it takes {found.quick_time:.3g} s by {ramp}, and "
        said += f"drives.stop_timeout is {timeout:g} s: power would be cut in motion, and the stop be a fault"
        least = found.velocity / timeout
        remedy = f"drives.quick_stop_deceleration beyond {least:.3g} m/s², or a longer drives.stop_timeout"
        yield Check("quick stop", "failure", said, remedy, key)
    elif found.quick_time < config.period:
        said = f"from {found.velocity * 1e3:g} mm/s it would take {found.quick_time * 1e3:.2g} ms by {ramp}"
        yield Check("quick stop", "warning", said, "no slider stops within a cycle: as the drives can brake", key)
    else:
        said = f"{found.quick_time:.3g} s from {found.velocity * 1e3:g} mm/s, within drives.stop_timeout, {timeout:g} s"
        yield Check("quick stop", "ok", said)


JUDGEMENTS = (
    Judgement(("limits.slider", "drives.quick_stop_deceleration", "geometry", "can"), _rail),
    Judgement(("limits.slider", "drives.quick_stop_deceleration", "geometry"), _travel),
    Judgement(
        ("limits.slider", "drives.quick_stop_deceleration", "drives.stop_timeout", "geometry", "loop.rate_hz"),
        _quick_stop,
    ),
)
