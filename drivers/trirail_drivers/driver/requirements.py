"""What a robot requires of its drives, and whether the steps of their positions are fine enough for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final, NamedTuple

from trirail_drivers.config import Drive, Drives
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES, Triple

FINE_ENOUGH: Final = 10
"""So many steps of a drive's position the following error must have, lest rounding alone be a fault."""


SEVERAL: Final = 3
"""So many steps of a drive's position a window must have to either side, lest rounding and its flicker leave it."""


class Rule(NamedTuple):
    """One thing that settings are refused for. Each can be looked at by itself, so that none hides another."""

    key: str
    """Of the configuration: what is wrong where it is refused."""
    reads: tuple[str, ...]
    """What else the answer depends on: keys, or tables for all that is in them."""
    check: Callable[[], object]
    """Raises a TrirailError that says key, value and what would be right."""


class Window(NamedTuple):
    """How far something that follows from the sliders' positions may be from where it is to be."""

    key: str
    """Of the configuration."""
    width: float
    """To either side."""
    unit: str
    gains: Triple
    """By how much at most a metre of the sliders A, B, C changes it."""


class Requirements(NamedTuple):
    """What the drives are to be able to do, A, B, C."""

    period: float
    """Of the cycle [s]."""
    low: Sequence[float]
    high: Sequence[float]
    """Travel of the sliders [m]."""
    velocity: Triple
    """Of the sliders at most [m/s]."""
    following_error: float
    """Beyond which the service stops everything [m]."""
    windows: tuple[Window, ...] = ()
    """In which the robot is to settle."""


def resolution(
    name: str, drive: Drive, drives: Drives, required: Requirements, step: float, remedy: Callable[[float], str]
) -> Iterator[Rule]:
    """Yield what refuses a `step` of the position [m] that no limit is several of wide: rounding alone is no fault.

    `remedy` says what would be right, given the widest step [m] that would do.
    """
    scale = f"drives.{name}.offset", "limits.slider.position", "can.simulated.start"
    limits = (
        ("limits.slider.following_error", "m", required.following_error, FINE_ENOUGH),
        ("drives.following_error", "m", drives.following_error, FINE_ENOUGH),
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
                f"drives.{name}.counts_per_metre = {drive.counts_per_metre:g}, offset = {drive.offset:g}: the position "
                f"goes in steps of {step:g} m, too coarse for {key}, {limit:g} {unit}; {remedy(limit / steps)}"
            )


def _check_window(name: str, step: float, window: Window) -> None:
    least = SEVERAL * step * window.gains[NAMES.index(name)]
    if window.width < least:
        raise DriveError(
            f"{window.key} = {window.width:g}: the position of drive {name} goes in steps of {step:g} m, and "
            f"{SEVERAL} of them move it by {least:g} {window.unit}; wanted at least that, to settle in"
        )
