"""What Rerun is given of the robot: what stands still once, then columns made from records.

`/record` holds every field of every record as it came, in SI units. All else is drawn from it for people: in
millimetres, degrees and microseconds, thinned to what a screen can show. Where a curve is thinned, following
error, lateness and cycle time show their worst, the rest their newest value.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from trirail.telemetry import columns, curves, drawing, palette, readout, shown_alignment
from trirail.telemetry.columns import FIELDS, RECORD, Column
from trirail.telemetry.readout import Standing
from trirail.telemetry.shown_robot import ShownRobot
from trirail.wire.vocabulary import MODES
from trirail.workspace.part_positions import RobotParts
from trirail.workspace.reach import Reach

DRAWN_HZ = 100
"""Samples a second of what is drawn."""
OUTLINES_HZ = 10
"""Outlines of the workspace a second, at most."""

MARKDOWN = rr.components.MediaType.MARKDOWN
TEXT = rr.TextDocument.descriptor_text()
SCALARS = rr.Scalars.descriptor_scalars()
STATE = rr.StateChange.descriptor_state()


class Scene:
    """A robot as Rerun is to show it. `wall_offset_ns` is the wall clock less the monotonic one."""

    def __init__(self, robot: ShownRobot, wall_offset_ns: int) -> None:
        self._rate_hz = robot.rate_hz
        self._timelines = columns.Timelines(self._rate_hz, wall_offset_ns)
        self._geometry, self._frames = robot.geometry, robot.frames
        self._parts = RobotParts.of(robot.geometry, robot.limits.slider)
        self._reach = Reach(robot.geometry, robot.limits)
        self._plots = curves.plots(robot)
        self.bounds = self._parts.bounds
        """Where the robot lies, (2, 2): lowest and highest x and y [m]."""

    def still(self) -> Iterator[tuple[str, rr.AsComponents]]:
        """Yield what is logged once, as static: entity path and archetype."""
        yield from drawing.still(self._parts, self._frames, self._geometry.labels)
        for path, lines in self._plots.items():
            yield path, _series(lines)
        for path in (readout.PATH, shown_alignment.TABLE):
            yield path, rr.TextDocument.from_fields(media_type=MARKDOWN)
        yield (
            "/mode",
            rr.StateConfiguration(
                values=list(MODES),
                labels=[mode.capitalize() for mode in MODES],
                colors=[palette.MODES[mode] for mode in MODES],
            ),
        )

    def bus_load(self, share: float) -> Iterator[tuple[str, rr.AsComponents]]:
        """Take the bus load in, 1 for a full bus; yield what is logged as static from then on."""
        self._plots[curves.TIMING] = lines = curves.timing(self._rate_hz, share)
        yield curves.TIMING, _series(lines)

    def complete(self, records: NDArray[np.void]) -> list[Chunk]:
        """Return records as they are."""
        return columns.chunks(self._timelines.of(records), [Column(RECORD, FIELDS, columns.structs(records))])

    def drawn(self, records: NDArray[np.void], standing: Standing) -> list[Chunk]:
        """Return records as people see them: one at least, in order. `standing` holds at the last of them."""
        starts, ends = _groups(records["cycle"], self._rate_hz // DRAWN_HZ)
        newest = records[ends]
        parts = drawing.moving(self._geometry, self._parts, records[starts], newest)
        distance = self._reach.distance(newest["pose"])
        for path, values in curves.values(records, newest, starts, distance).items():
            table = curves.with_limits(values, self._plots[path])
            parts.append(Column(path, SCALARS, columns.scalars(table)))
        chunks = columns.chunks(self._timelines.of(newest), parts)
        return chunks + self._status(records) + self._readout(records[-1], standing)

    def goal(self, record: np.void, pose: Sequence[float] | None) -> list[Chunk]:
        """Return the pose that the goal leads to from the time of `record` on; None for no goal."""
        return columns.chunks(self._timelines.of(record.reshape(1)), [drawing.goal(self._parts, pose)])

    def _readout(self, record: np.void, standing: Standing) -> list[Chunk]:
        text = pa.array([[readout.markdown(record, standing, self._geometry.labels)]])
        return columns.chunks(self._timelines.of(record.reshape(1)), [Column(readout.PATH, TEXT, text)])

    def _status(self, records: NDArray[np.void]) -> list[Chunk]:
        """Return mode and outline of the workspace at the first record, where the mode changes, and as φ changes."""
        changed = np.diff(records["mode"], prepend=len(MODES)) != 0
        some = np.arange(0, len(records), max(1, self._rate_hz // OUTLINES_HZ))
        steps = self._reach.steps(records["pose"][some, 2])
        changed[some] |= np.diff(steps, prepend=steps[0]) != 0
        at = records[changed]
        modes = pa.array([[MODES[mode]] for mode in at["mode"]])
        outlines = columns.ragged([[self._reach.outline(step)] for step in self._reach.steps(at["pose"][:, 2])])
        parts = [Column("/mode", STATE, modes), Column("/robot/workspace", drawing.STRIPS, outlines)]
        return columns.chunks(self._timelines.of(at), parts)


def _groups(cycles: NDArray[np.int64], size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and the last row of every run of rows whose cycles belong to the same group of `size`."""
    changes = np.flatnonzero(np.diff(cycles // max(1, size))) + 1
    return np.concatenate([[0], changes]), np.concatenate([changes, [len(cycles)]]) - 1


def _series(lines: curves.Lines) -> rr.SeriesLines:
    moving, still = len(lines.moving), len(lines.still)
    return rr.SeriesLines(
        names=[*(line.name for line in lines.moving), *(limit.name for limit in lines.still)],
        colors=[*(line.colour for line in lines.moving), *(limit.colour for limit in lines.still)],
        widths=[1.5] * moving + [1.0] * still,
    )
