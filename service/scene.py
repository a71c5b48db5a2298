"""What Rerun is given of the robot: its parts once, then columns made from records.

`/record` holds every field of every record as it came, in SI units. All else is drawn from it for people: in
millimetres, degrees and microseconds, thinned to what a screen can show. Where a curve is thinned, what must
not be missed (following error, lateness, cycle time) shows its worst value, the rest its last.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from service.config import Config
from service.geometry import LEGS
from service.messages import Event, Level
from service.mechanism import Mechanism
from service.modes import MODES, Mode
from service.records import DTYPE

CURVES_HZ = 200
"""Samples a second of every curve."""
MOTION_HZ = 50
"""Positions a second of the mechanism's moving parts."""

SECOND = 1_000_000_000
MM = 1e3
UM = 1e6

Colour = tuple[int, int, int]
SLIDERS: tuple[Colour, Colour, Colour] = ((242, 108, 79), (52, 190, 145), (82, 148, 255))
"""A, B and C, wherever they appear."""
RAIL: Colour = (74, 80, 92)
PLATFORM: Colour = (236, 238, 242)
GHOST: Colour = (240, 180, 80)
LIMIT: Colour = (196, 148, 64)
CENTRE: Colour = (76, 208, 224)
ORANGE: Colour = (250, 176, 64)
VIOLET: Colour = (166, 126, 255)
GREEN: Colour = (140, 210, 120)
GREY: Colour = (150, 160, 176)
RED: Colour = (226, 82, 82)

MODE_COLOURS: dict[Mode, Colour] = {
    Mode.DISABLED: (96, 102, 114),
    Mode.ENABLING: (190, 140, 50),
    Mode.HOLDING: (44, 128, 148),
    Mode.MOVING: (56, 146, 84),
    Mode.STOPPING: (196, 104, 44),
    Mode.FAULT: (200, 56, 56),
}
LEVELS: dict[Level, str] = {"info": "INFO", "warning": "WARN", "error": "ERROR"}


class Curves(NamedTuple):
    """Lines that share a plot and a unit."""

    names: tuple[str, ...]
    colours: tuple[Colour, ...]


CURVES = {
    "/sliders/position": Curves(tuple(LEGS), SLIDERS),  # measured [mm]
    "/sliders/velocity": Curves(tuple(LEGS), SLIDERS),  # measured [mm/s]
    "/sliders/acceleration": Curves(tuple(LEGS), SLIDERS),  # commanded [m/s²]
    "/sliders/following_error": Curves(tuple(LEGS), SLIDERS),  # worst [µm]
    "/pose/centre": Curves(("x", "y"), (CENTRE, VIOLET)),  # measured [mm]
    "/pose/phi": Curves(("φ",), (ORANGE,)),  # measured [°]
    "/loop/timing": Curves(("lateness", "cycle"), (GREEN, GREY)),  # worst [µs]
}


class Timelines(NamedTuple):
    """The two times of everything: `t`, nominal since the loop's start, and `wall`, the wall clock."""

    rate_hz: int
    wall_offset_ns: int
    """Wall clock less monotonic clock."""

    def of(self, records: NDArray[np.void]) -> list[rr.TimeColumn]:
        """Return the times of records; steps of `t` are exact where the period is whole nanoseconds."""
        t = records["cycle"] * SECOND // self.rate_hz
        wall = records["deadline_ns"] + self.wall_offset_ns
        return [
            rr.TimeColumn("t", duration=t.astype("timedelta64[ns]")),
            rr.TimeColumn("wall", timestamp=wall.astype("datetime64[ns]")),
        ]


def still(config: Config, mechanism: Mechanism) -> Iterator[tuple[str, rr.AsComponents]]:
    """Yield what never moves, as entity path and archetype, to be logged as static."""
    yield from _drawing(mechanism)
    for path, (names, colours) in CURVES.items():
        yield path, rr.SeriesLines(names=names, colors=colours, widths=[1.5] * len(names))
    for path, limits in _limits(config).items():
        dim = [RED if path == "/loop/budget" else LIMIT] * len(limits)
        names = ("budget",) if path == "/loop/budget" else ("min", "max")
        yield path, rr.SeriesLines(names=names, colors=dim, widths=[1.0] * len(limits))
    yield (
        "/mode",
        rr.StateConfiguration(
            values=list(MODES),
            labels=[mode.capitalize() for mode in MODES],
            colors=[MODE_COLOURS[mode] for mode in MODES],
        ),
    )


def moving(config: Config, timelines: Timelines, records: NDArray[np.void]) -> list[Chunk]:
    """Return what a batch of records, in order and at least one, adds to the recording."""
    rate_hz = config.loop.rate_hz
    chunks = [_all_fields(timelines, records)]
    starts, ends = _groups(records, max(1, rate_hz // CURVES_HZ))
    times = timelines.of(records[ends])
    for path, values in _curves(records, starts, ends).items():
        chunks.append(Chunk.from_columns(path, times, _scalars(values)))
    edges = np.array([0, len(records) - 1])
    for path, limits in _limits(config).items():
        columns = _scalars(np.tile(limits, (2, 1)))
        chunks.append(Chunk.from_columns(path, timelines.of(records[edges]), columns))
    chunks += _motion(timelines, records, *_groups(records, max(1, rate_hz // MOTION_HZ)))
    chunks.append(_modes(timelines, records))
    return chunks


def said(event: Event) -> Chunk:
    """Return an event as a line of the log."""
    times = [
        rr.TimeColumn("t", duration=[np.timedelta64(round(event.t * SECOND), "ns")]),
        rr.TimeColumn("wall", timestamp=[np.datetime64(round(event.time * SECOND), "ns")]),
    ]
    columns = rr.TextLog.columns(text=[event.message], level=[LEVELS[event.level]])
    return Chunk.from_columns("/events", times, columns)


def _drawing(mechanism: Mechanism) -> Iterator[tuple[str, rr.AsComponents]]:
    """The mechanism's parts: fixed ones where they are, moving ones in their own frames."""
    yield "/robot", rr.Transform3D(mat3x3=[[1, 0, 0], [0, -1, 0], [0, 0, 1]])  # 2D views have y downwards
    yield "/robot/rails", _lines(mechanism.rails, RAIL, 4.0)
    yield "/robot/travel", _lines(mechanism.travel, [_dark(colour) for colour in SLIDERS], 3.0)
    yield "/robot/stops", _lines(mechanism.stops, LIMIT, 1.2)
    yield (
        "/robot/anchors",
        rr.Points2D(
            mechanism.anchors,
            colors=RAIL,
            radii=rr.Radius.ui_points(5.0),
            labels=["A₀", "B₀", "C₀"],
            show_labels=True,
        ),
    )
    yield "/robot/commanded/outline", _lines(mechanism.outline, GHOST, 1.0, order=31)
    yield "/robot/platform/outline", _lines(mechanism.outline, PLATFORM, 2.2, order=32)
    yield "/robot/platform/arms", _lines(mechanism.arms, (92, 98, 110), 0.8, order=31)
    yield (
        "/robot/platform/centre",
        rr.Points2D([[0.0, 0.0]], colors=CENTRE, radii=rr.Radius.ui_points(4.0), draw_order=41),
    )
    yield "/robot/trace", rr.LineStrips2D.from_fields(colors=CENTRE, radii=rr.Radius.ui_points(1.0), draw_order=40)
    yield (
        "/robot/sliders",
        rr.Points2D.from_fields(
            colors=SLIDERS,
            radii=rr.Radius.ui_points(7.0),
            labels=list(LEGS),
            show_labels=True,
            draw_order=50,
        ),
    )


def _motion(
    timelines: Timelines, records: NDArray[np.void], starts: NDArray[np.intp], ends: NDArray[np.intp]
) -> Iterator[Chunk]:
    raise NotImplementedError
