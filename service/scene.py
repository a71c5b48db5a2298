"""What Rerun is given of the robot: what stands still once, then columns made from records.

`/record` holds every field of every record as it came, in SI units. All else is drawn from it for people: in
millimetres, degrees and microseconds, thinned to what a screen can show. Where a curve is thinned, following
error, lateness and cycle time show their worst, the rest their newest value.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from service import columns, config, drawing, palette
from service.config import Config
from service.geometry import LEGS
from service.mechanism import Mechanism
from service.messages import Level
from service.modes import MODES
from service.palette import Colour

CURVES_HZ = 100
"""Samples a second of every curve."""
MOTION_HZ = 50
"""Positions a second of the mechanism's moving parts."""

LEVELS: dict[Level, str] = {"info": "INFO", "warning": "WARN", "error": "ERROR"}


class Lines(NamedTuple):
    """The lines of one plot: what moves, then the constant limits."""

    names: tuple[str, ...]
    colours: tuple[Colour, ...]
    limits: tuple[float, ...] = ()
    limit_names: tuple[str, ...] = ("min", "max")
    limit_colour: Colour = palette.LIMIT


class Scene:
    """A configured robot as Rerun is to show it."""

    def __init__(self, settings: Config, wall_offset_ns: int) -> None:
        self._rate_hz = settings.loop.rate_hz
        self._timelines = columns.Timelines(self._rate_hz, wall_offset_ns)
        self._geometry = config.geometry(settings.geometry)
        self._parts = Mechanism.of(self._geometry, settings.limits.slider)
        self._plots = _plots(settings)
        self.bounds = self._parts.bounds
        """Where the robot lies, (2, 2): lowest and highest x and y [m]."""

    def still(self) -> Iterator[tuple[str, rr.AsComponents]]:
        """Yield what is logged once, as static: entity path and archetype."""
        yield from drawing.still(self._parts)
        for path, lines in self._plots.items():
            moving, still = len(lines.names), len(lines.limits)
            yield (
                path,
                rr.SeriesLines(
                    names=[*lines.names, *lines.limit_names[:still]],
                    colors=[*lines.colours, *[lines.limit_colour] * still],
                    widths=[1.5] * moving + [1.0] * still,
                ),
            )
        yield (
            "/mode",
            rr.StateConfiguration(
                values=list(MODES),
                labels=[mode.capitalize() for mode in MODES],
                colors=[palette.MODES[mode] for mode in MODES],
            ),
        )

    def complete(self, records: NDArray[np.void]) -> list[Chunk]:
        """Return records as they are."""
        return columns.structs(self._timelines.of(records), "/record", records)

    def drawn(self, records: NDArray[np.void]) -> list[Chunk]:
        """Return records as people see them: one at least, in order."""
        of, rate_hz, cycles = self._timelines.of, self._rate_hz, records["cycle"]
        starts, ends = _groups(cycles, rate_hz // CURVES_HZ)
        curves = _curves(records, starts, ends)
        for path, lines in self._plots.items():
            limits = np.broadcast_to(lines.limits, (len(ends), len(lines.limits)))
            curves[path] = np.hstack([curves[path], limits])
        chunks = columns.scalars(of(records[ends]), curves)
        starts, ends = _groups(cycles, rate_hz // MOTION_HZ)
        chunks += drawing.moving(self._geometry, of(records[ends]), records[starts], records[ends])
        entered = records[np.diff(records["mode"], prepend=len(MODES)) != 0]
        states = [MODES[mode] for mode in entered["mode"]]
        chunks.append(Chunk.from_columns("/mode", of(entered), rr.StateChange.columns(state=states)))
        return chunks


def remark(t: float, wall: float, level: Level, message: str) -> Chunk:
    """Return a line of the log at nominal time `t` [s] and wall clock `wall` [s since 1970]."""
    line = rr.TextLog.columns(text=[message], level=[LEVELS[level]])
    return Chunk.from_columns("/events", columns.moment(t, wall), line)


def _groups(cycles: NDArray[np.int64], size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and the last row of every run of rows whose cycles belong to the same group of `size`."""
    changes = np.flatnonzero(np.diff(cycles // max(1, size))) + 1
    return np.concatenate([[0], changes]), np.concatenate([changes, [len(cycles)]]) - 1


def _curves(
    records: NDArray[np.void], starts: NDArray[np.intp], ends: NDArray[np.intp]
) -> dict[str, NDArray[np.float64]]:
    """Return the curves' values, (N, lines), for N groups of rows."""
    newest = records[ends]
    error = records["following_error"]
    highest, lowest = np.maximum.reduceat(error, starts), np.minimum.reduceat(error, starts)
    timing = np.stack([records["parts_ns"].sum(axis=1), records["lateness_ns"]], axis=1)
    return {
        "/sliders/position": newest["position"] * 1e3,  # [mm]
        "/sliders/velocity": newest["velocity"] * 1e3,  # [mm/s]
        "/sliders/acceleration": newest["commanded_acceleration"],  # [m/s²]
        "/sliders/following_error": np.where(highest > -lowest, highest, lowest) * 1e6,  # [µm]
        "/pose/centre": newest["pose"][:, :2] * 1e3,  # [mm]
        "/pose/phi": np.degrees(newest["pose"][:, 2:]),  # [°]
        "/loop/timing": np.maximum.reduceat(timing, starts) * 1e-3,  # [µs]
    }


def _plots(settings: Config) -> dict[str, Lines]:
    """Return what is plotted, by entity, in the units of the curves."""
    slider = settings.limits.slider
    budget = Lines(
        ("cycle", "lateness"),
        (palette.CYCLE, palette.LATENESS),
        (settings.period * 1e6,),
        ("budget",),
        palette.BUDGET,
    )
    return {
        "/sliders/position": _sliders(*(limit * 1e3 for limit in slider.position)),
        "/sliders/velocity": _sliders(-slider.velocity * 1e3, slider.velocity * 1e3),
        "/sliders/acceleration": _sliders(-slider.acceleration, slider.acceleration),
        "/sliders/following_error": _sliders(),
        "/pose/centre": Lines(("x", "y"), (palette.X, palette.Y)),
        "/pose/phi": Lines(("φ",), (palette.PHI,)),
        "/loop/timing": budget,
    }


def _sliders(*limits: float) -> Lines:
    return Lines(tuple(LEGS), palette.SLIDERS, limits)
