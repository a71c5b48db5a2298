"""Curves of the live view's plots, in millimetres, degrees and microseconds, and the limits drawn in the same plots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trirail.config import Range
from trirail.naming import Labels
from trirail.telemetry import palette
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.palette import Colour
from trirail.wire.records import slider_positions

POSITION, VELOCITY, ACCELERATION = "/sliders/position", "/sliders/velocity", "/sliders/acceleration"
ERROR = "/sliders/following_error"
CENTRE, PHI, SINGULARITY = "/pose/centre", "/pose/phi", "/pose/singularity"
TIMING = "/loop/timing"

DRAWN_FROM = 0.7
"""Fraction of a limit that a curve must reach before the limit is drawn. A distant limit would flatten the curves."""


class Curve(NamedTuple):
    """Line of a measured or commanded value."""

    name: str
    colour: Colour


class Limit(NamedTuple):
    """Horizontal line at a constant value, such as a limit."""

    name: str
    value: float
    colour: Colour = palette.LIMIT


class Lines(NamedTuple):
    """Curves and limits of one plot."""

    moving: tuple[Curve, ...]
    still: tuple[Limit, ...] = ()
    drawn_from: float = 0.0
    """Fraction of a limit that a curve must reach before the limit is drawn; 0 if limits are always drawn."""


def plots(robot: DrawnRobot) -> dict[str, Lines]:
    """Return the lines of each plot, by the entity path of the plot. Limits are in the units of the curves."""
    slider, platform, names = robot.limits.slider, robot.limits.platform, robot.geometry.labels
    error = slider.following_error * 1e6
    margin = float(np.degrees(robot.limits.singularity_margin))
    return {
        POSITION: _sliders(names, np.multiply(slider.positions, 1e3)),
        VELOCITY: _sliders(names, _either_way(slider.velocities, 1e3)),
        ACCELERATION: _sliders(names, _either_way(slider.accelerations, 1.0)),
        ERROR: _sliders(names, np.tile((-error, error), (3, 1))),
        CENTRE: Lines((Curve("x", palette.X), Curve("y", palette.Y)), _window(platform.x, platform.y), DRAWN_FROM),
        PHI: Lines((Curve("φ", palette.PHI),)),
        SINGULARITY: Lines((Curve("distance", palette.SINGULARITY),), (Limit("margin", margin),)),
        TIMING: timing(robot.rate_hz, float("nan")),
    }


def timing(rate_hz: int, bus_load: float) -> Lines:
    """Return the lines of the plot of the loop's timing.

    `bus_load`, which is 1 for a full bus, is shown as the time per cycle in which the bus is busy.
    """
    period = 1e6 / rate_hz
    return Lines(
        (Curve("cycle", palette.CYCLE), Curve("lateness", palette.LATENESS)),
        (Limit(f"bus {bus_load:.0%}", bus_load * period, palette.BUS), Limit("period", period, palette.BUDGET)),
    )


def values(
    records: NDArray[np.void],
    newest: NDArray[np.void],
    starts: NDArray[np.intp],
    distance: NDArray[np.float64],
) -> dict[str, NDArray[np.float64]]:
    """Return the values of the curves of each plot, (N, curves), for N groups of records that begin at `starts`.

    `newest` contains the last record of each group, with NaN as positions and poses that are unknown, and `distance`
    the distance of its pose to a singularity [rad].
    """
    error = records["following_error"]
    highest, lowest = np.maximum.reduceat(error, starts), np.minimum.reduceat(error, starts)
    times = np.stack([records["parts_ns"].sum(axis=1), records["lateness_ns"]], axis=1)
    return {
        POSITION: slider_positions(newest) * 1e3,  # [mm]
        VELOCITY: newest["velocity"] * 1e3,  # [mm/s]
        ACCELERATION: newest["commanded_acceleration"],  # [m/s²]
        ERROR: np.where(highest > -lowest, highest, lowest) * 1e6,  # [µm]
        CENTRE: newest["pose"][:, :2] * 1e3,  # [mm]
        PHI: np.degrees(newest["pose"][:, 2:]),  # [°]
        SINGULARITY: np.degrees(np.where(np.isnan(newest["pose"][:, 2]), np.nan, distance))[:, np.newaxis],  # [°]
        TIMING: np.maximum.reduceat(times, starts) * 1e-3,  # [µs]
    }


def with_limits(moving: NDArray[np.float64], lines: Lines) -> NDArray[np.float64]:
    """Return the values of a plot's curves, (N, k), with one more column per limit; NaN hides a limit."""
    rows, count = moving.shape
    limits = np.array([limit.value for limit in lines.still])
    table = np.empty((rows, count + len(limits)))
    table[:, :count] = moving
    highest = np.where(limits > 0.0, np.nanmax(moving, initial=0.0), -np.nanmin(moving, initial=0.0))
    table[:, count:] = np.where(highest >= lines.drawn_from * np.abs(limits), limits, np.nan)
    return table


def _window(x: Range, y: Range) -> tuple[Limit, ...]:
    """Return the limits of the platform's centre. If x and y have the same limits, return them only once."""
    if x == y:
        return Limit("min", x[0] * 1e3), Limit("max", x[1] * 1e3)
    ends = zip(("x min", "x max", "y min", "y max"), (*x, *y), strict=True)
    return tuple(Limit(name, end * 1e3) for name, end in ends)


def _either_way(limits: Sequence[float], scale: float) -> NDArray[np.float64]:
    return np.multiply.outer(limits, (-scale, scale))


def _sliders(names: Labels, ends: NDArray[np.float64]) -> Lines:
    """Return the curves of the sliders and their limits `ends`, (3, 2). Limits that all sliders share appear once."""
    lines = tuple(Curve(leg, colour) for leg, colour in zip(names, palette.SLIDERS, strict=True))
    alike = bool((ends == ends[0]).all())
    named = [("", ends[0])] if alike else [(f"{leg} ", own) for leg, own in zip(names, ends, strict=True)]
    limits = tuple(
        Limit(f"{name}{end}", float(value))
        for name, own in named
        for end, value in zip(("min", "max"), own, strict=True)
    )
    return Lines(lines, limits, DRAWN_FROM)
