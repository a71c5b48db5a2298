"""What Rerun is given of the robot: what stands still once, then columns made from records.

`/record` holds every field of every record as it came, in SI units. All else is drawn from it for people: in
millimetres, degrees and microseconds, thinned to what a screen can show. Where a curve is thinned, following
error, lateness and cycle time show their worst, the rest their newest value.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from service import columns, config, drawing, palette
from service.columns import Column
from service.config import Config
from service.geometry import LEGS
from service.mechanism import Mechanism
from service.messages import Level
from service.modes import MODES
from service.palette import Colour

DRAWN_HZ = 100
"""Samples a second of what is drawn."""

FIELDS = rr.ComponentDescriptor("fields")
SCALARS = rr.Scalars.descriptor_scalars()
STATE = rr.StateChange.descriptor_state()
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
        return columns.chunks(self._timelines.of(records), [Column("/record", FIELDS, columns.structs(records))])

    def drawn(self, records: NDArray[np.void]) -> list[Chunk]:
        """Return records as people see them: one at least, in order."""
        starts, ends = _groups(records["cycle"], self._rate_hz // DRAWN_HZ)
        newest = records[ends]
        parts = drawing.moving(self._geometry, records[starts], newest)
        for path, values in _curves(records, newest, starts).items():
            parts.append(Column(path, SCALARS, columns.scalars(_beside(values, self._plots[path].limits))))
        return columns.chunks(self._timelines.of(newest), parts) + self._modes(records)

    def _modes(self, records: NDArray[np.void]) -> list[Chunk]:
        """Return the mode at the first record and wherever it changes."""
        entered = records[np.diff(records["mode"], prepend=len(MODES)) != 0]
        modes = pa.array([[MODES[mode]] for mode in entered["mode"]])
        return columns.chunks(self._timelines.of(entered), [Column("/mode", STATE, modes)])


def remark(t: float, wall: float, level: Level, message: str) -> Chunk:
    """Return a line of the log at nominal time `t` [s] and wall clock `wall` [s since 1970]."""
    line = rr.TextLog.columns(text=[message], level=[LEVELS[level]])
    return Chunk.from_columns("/events", columns.moment(t, wall), line)


def _groups(cycles: NDArray[np.int64], size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and the last row of every run of rows whose cycles belong to the same group of `size`."""
    changes = np.flatnonzero(np.diff(cycles // max(1, size))) + 1
    return np.concatenate([[0], changes]), np.concatenate([changes, [len(cycles)]]) - 1


def _curves(
    records: NDArray[np.void], newest: NDArray[np.void], starts: NDArray[np.intp]
) -> dict[str, NDArray[np.float64]]:
    """Return the values of curves, (N, lines), for N groups of records that begin at `starts`."""
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


def _beside(values: NDArray[np.float64], constants: tuple[float, ...]) -> NDArray[np.float64]:
    """Return values (N, k) with columns of constants to their right."""
    rows, lines = values.shape
    table = np.empty((rows, lines + len(constants)))
    table[:, :lines] = values
    table[:, lines:] = constants
    return table


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
