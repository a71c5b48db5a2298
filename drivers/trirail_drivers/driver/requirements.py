"""Requirements of a robot on its drives, and checks that the drives' position resolution meets them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final, NamedTuple

from trirail_drivers.config import Drive, Drives
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES, Triple

MIN_STEPS_PER_LIMIT: Final = 10
"""Minimum number of position steps in a limit of the following error: with fewer, rounding alone could cause a fault.
"""
MIN_STEPS_PER_WINDOW: Final = 3
"""Minimum number of position steps on either side of a window: with fewer, rounding and encoder flicker could exceed
it.
"""


class Rule(NamedTuple):
    """Check of the configuration. Each check runs separately, so that no error hides another."""

    key: str
    """Key that is wrong if the check fails."""
    reads: tuple[str, ...]
    """Other keys on which the result depends; the name of a table includes all its keys."""
    check: Callable[[], object]
    """Function that raises a TrirailError with the key, its value and a valid value."""


class Window(NamedTuple):
    """Tolerance window of a value that depends on the slider positions."""

    key: str
    """Key in the configuration."""
    width: float
    """Half width [unit]."""
    unit: str
    gains: Triple
    """Largest change of the value per metre of the sliders A, B, C [unit/m]."""


class Requirements(NamedTuple):
    """Requirements on the drives A, B, C."""

    period: float
    """Cycle period [s]."""
    low: Sequence[float]
    high: Sequence[float]
    """Lower and upper ends of the travel of the sliders [m]."""
    velocity: Triple
    """Largest velocities of the sliders [m/s]."""
    following_error: float
    """Following error above which the service stops all drives [m]."""
    windows: tuple[Window, ...] = ()
    """Windows within which the robot must settle."""


def resolution_rules(
    name: str, drive: Drive, drives: Drives, required: Requirements, step: float, remedy: Callable[[float], str]
) -> Iterator[Rule]:
    """Yield checks that every limit is several position steps of `step` [m] wide, so that rounding causes no fault.

    `remedy` returns the remedy for people, given the largest valid step [m].
    """
    scale = f"drives.{name}.offset", "limits.slider.position", "can.simulated.start"
    limits = (
        ("limits.slider.following_error", "m", required.following_error, MIN_STEPS_PER_LIMIT),
        ("drives.following_error", "m", drives.following_error, MIN_STEPS_PER_LIMIT),
        ("limits.slider.velocity", "m in a cycle", required.velocity[NAMES.index(name)] * required.period, 1),
    )
    reads = *scale, "loop.rate_hz", *(key for key, *_ in limits)
    yield Rule(f"drives.{name}.counts_per_metre", reads, partial(_check_limits, name, drive, step, limits, remedy))
    for window in required.windows:
        robot = "geometry", "correction", "limits.platform", "limits.singularity_margin"
        reads = f"drives.{name}.counts_per_metre", *scale, *robot
        yield Rule(window.key, reads, partial(_check_window, name, step, window))


def _check_limits(
    name: str,
    drive: Drive,
    step: float,
    limits: tuple[tuple[str, str, float, int], ...],
    remedy: Callable[[float], str],
) -> None:
    for key, unit, limit, steps in limits:
        if step * steps > limit:
            raise DriveError(
                f"drives.{name}.counts_per_metre = {drive.counts_per_metre:g}, offset = {drive.offset:g}: a position "
                f"step of {step:g} m is too coarse for {key}, {limit:g} {unit}; {remedy(limit / steps)}"
            )


def _check_window(name: str, step: float, window: Window) -> None:
    least = MIN_STEPS_PER_WINDOW * step * window.gains[NAMES.index(name)]
    if window.width < least:
        raise DriveError(
            f"{window.key} = {window.width:g}: narrower than {MIN_STEPS_PER_WINDOW} position steps of drive {name}, "
            f"{step:g} m each; expected at least {least:g} {window.unit} to settle in"
        )
