"""Drawing of the robot in Rerun. Static parts are sent once, and moving parts as columns made from records.

The entity `/record` contains every field of every record unchanged, in SI units. All other entities are drawn from the
records for people, in millimetres, degrees and microseconds, with as many samples as a screen can show. Each sample of
following error, lateness and cycle time is the worst value of several cycles. Each sample of other values is the newest
value.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from trirail.config import FramesTable
from trirail.kinematics.geometry import Geometry
from trirail.naming import Labels
from trirail.telemetry import columns, curves, palette, readout, shown_alignment
from trirail.telemetry.columns import FIELDS, RECORD, Column
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.palette import Colour
from trirail.telemetry.readout import ReadoutState
from trirail.wire.records import slider_positions
from trirail.wire.vocabulary import MODES
from trirail.workspace import part_positions
from trirail.workspace.part_positions import Points, RobotParts
from trirail.workspace.reach import Reach

ORIGIN = 0.02
"""Length of the arms of the cross at the base frame's origin, as a fraction of the robot's size."""
POSITIONS = rr.Points2D.descriptor_positions()
STRIPS = rr.LineStrips2D.descriptor_strips()
TRANSLATION = rr.Transform3D.descriptor_translation()
QUATERNION = rr.Transform3D.descriptor_quaternion()
_ORIGIN_CROSS = (np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, -1.0], [0.0, 1.0]]))


def still(parts: RobotParts, frames: FramesTable, names: Labels) -> Iterator[tuple[str, rr.AsComponents]]:
    """Yield the entity path and archetype of each static part."""
    yield "/robot", rr.Transform3D(mat3x3=[[1, 0, 0], [0, -1, 0], [0, 0, 1]])  # the y axis of 2D views points downwards
    yield "/robot/rails", _lines(parts.rails, [palette.FRAME], 4.5, order=10)
    yield "/robot/travel", _lines(parts.travel, [palette.dark(c) for c in palette.SLIDERS], 3.0, order=11)
    yield "/robot/stops", _lines(parts.stops, [palette.LIMIT], 1.2, order=12)
    zeros = [f"{name}₀" for name in names]
    yield "/robot/anchors", _labelled(parts.anchors, zeros, [palette.ANCHORS], 6.0, order=13)
    yield "/robot/names", _labelled(parts.names, list(names), palette.SLIDERS, 0.0, order=13)
    cross = ORIGIN * np.ptp(parts.bounds)
    yield "/robot/origin", _lines([axis * cross for axis in _ORIGIN_CROSS], [palette.ARMS], 0.8, order=14)
    yield from _named(frames, cross)
    yield "/robot/commanded/outline", _lines(parts.outline, [palette.COMMANDED], 4.5, order=20)
    yield "/robot/platform/arms", _lines(parts.arms, [palette.ARMS], 0.8, order=21)
    yield "/robot/platform/outline", _lines(parts.outline, [palette.PLATFORM], 2.2, order=22)
    yield "/robot/platform/stops", _lines(parts.edge_stops, [palette.LIMIT], 1.2, order=23)
    yield "/robot/workspace", _strips([palette.WORKSPACE], 0.8, order=15)
    yield columns.GOAL, _strips([palette.GOAL], 1.0, order=24)
    # These are the sleeves in which the platform's edges slide, or the cross slides on the carriages.
    yield "/robot/passive", _strips([palette.dark(c) for c in palette.SLIDERS], 5.5, order=25)
    yield "/robot/trace", _strips([palette.CENTRE], 1.2, order=30)
    yield (
        "/robot/platform/centre",
        rr.Points2D([[0.0, 0.0]], radii=rr.Radius.ui_points(4.0), colors=[palette.CENTRE], draw_order=31),
    )
    yield (  # the three sliders, and the pivot of each leg, about which the platform turns
        "/robot/sliders",
        rr.Points2D.from_fields(
            radii=[-8.5] * 3 + [-3.0] * 3,  # negative values mean screen points instead of metres
            colors=[*palette.SLIDERS, *[palette.PIN] * 3],
            draw_order=32,
        ),
    )


def moving(geometry: Geometry, parts: RobotParts, before: NDArray[np.void], records: NDArray[np.void]) -> list[Column]:
    """Return the columns of the moving parts at `records`, (N,).

    The trace of the platform's centre connects each record of `before`, (N,), with that of `records`.
    """
    sliders = part_positions.slider_points(geometry, slider_positions(records))
    crossing = part_positions.cross_slide_lines(geometry, parts, sliders, records["pose"][:, 2])
    pivots = part_positions.pivot_points(geometry, sliders, records["pose"])
    steps = np.stack([before["pose"][:, :2], records["pose"][:, :2]], axis=1)[:, None]
    return [
        *_placed("/robot/platform", records["pose"]),
        *_placed("/robot/commanded", records["commanded_pose"]),
        Column("/robot/sliders", POSITIONS, columns.vectors(np.concatenate([sliders, pivots], axis=1))),
        Column("/robot/passive", STRIPS, columns.strips(crossing)),
        Column("/robot/trace", STRIPS, columns.strips(steps)),
    ]


def goal(parts: RobotParts, pose: Sequence[float] | None) -> Column:
    """Return the outline of the platform at the goal's pose, with a cross at the centre; empty if `pose` is None."""
    if pose is None:
        return Column(columns.GOAL, STRIPS, columns.ragged([[]]))
    cross = [axis * ORIGIN * np.ptp(parts.bounds) for axis in _ORIGIN_CROSS]
    lines = part_positions.transform_lines([*parts.outline, *cross], pose)
    return Column(columns.GOAL, STRIPS, columns.ragged([lines]))


def _named(frames: FramesTable, size: float) -> Iterator[tuple[str, rr.AsComponents]]:
    """Yield the tools on the platform and the axes of the work frames, labelled with their names."""
    if frames.tool:
        tools = np.array(list(frames.tool.values()))
        yield "/robot/platform/tools", _labelled(tools, list(frames.tool), [palette.CENTRE], 3.0, order=31)
    for name, frame in frames.work.items():
        along_x, along_y = np.array([[0.0, 0.0], [size, 0.0]]), np.array([[0.0, 0.0], [0.0, size]])
        axes = part_positions.transform_lines([along_x, along_y], frame)
        yield (
            f"/robot/frames/{name}",
            rr.LineStrips2D(
                axes,
                colors=[palette.ARMS],
                radii=rr.Radius.ui_points(1.2),
                labels=[f"{name} x", f"{name} y"],
                show_labels=True,
                draw_order=14,
            ),
        )


def _lines(lines: list[Points], colours: Sequence[Colour], radius: float, *, order: float) -> rr.LineStrips2D:
    return rr.LineStrips2D(lines, colors=colours, radii=rr.Radius.ui_points(radius), draw_order=order)


def _strips(colours: Sequence[Colour], radius: float, *, order: float) -> rr.LineStrips2D:
    """Return the style of lines whose points are sent later."""
    return rr.LineStrips2D.from_fields(colors=colours, radii=rr.Radius.ui_points(radius), draw_order=order)


def _labelled(
    points: Points, labels: list[str], colours: Sequence[Colour], radius: float, *, order: float
) -> rr.Points2D:
    look = {"colors": colours, "radii": rr.Radius.ui_points(radius), "draw_order": order}
    return rr.Points2D(points, labels=labels, show_labels=True, **look)


def _placed(path: str, pose: Points) -> list[Column]:
    """Return the transforms from the platform's frame to the base frame for N poses, (N, 3); a NaN hides the parts."""
    phi = np.nan_to_num(pose[:, 2])  # the viewer draws parts with an invalid rotation at the origin
    translation, quaternion = np.zeros((len(pose), 1, 3)), np.zeros((len(pose), 1, 4))
    translation[:, 0, :2] = pose[:, :2]
    quaternion[:, 0, 2], quaternion[:, 0, 3] = np.sin(phi / 2.0), np.cos(phi / 2.0)
    return [
        Column(path, TRANSLATION, columns.vectors(translation)),
        Column(path, QUATERNION, columns.vectors(quaternion)),
    ]


DRAWN_HZ = 100
"""Maximum number of drawn samples per second of the robot and its curves."""
OUTLINES_HZ = 10
"""Number of times per second that the outline of the workspace is updated, if φ has changed."""

MARKDOWN = rr.components.MediaType.MARKDOWN
TEXT = rr.TextDocument.descriptor_text()
SCALARS = rr.Scalars.descriptor_scalars()
STATE = rr.StateChange.descriptor_state()
LEVELS = ("off", "on")
"""Values of outputs and inputs."""


class Scene:
    """Conversion of records to drawings in Rerun. `wall_offset_ns` is the wall clock minus the monotonic clock [ns]."""

    def __init__(self, robot: DrawnRobot, wall_offset_ns: int) -> None:
        self._rate_hz = robot.rate_hz
        self._timelines = columns.Timelines(self._rate_hz, wall_offset_ns)
        self._geometry, self._frames = robot.geometry, robot.frames
        self._parts = RobotParts.from_geometry(robot.geometry, robot.limits.slider)
        self._reach = Reach(robot.geometry, robot.planned_limits)
        self._plots = curves.plots(robot)
        self._digital = robot.digital
        self.bounds = self._parts.bounds
        """Bounds of the robot, (2, 2): lowest and highest x and y [m]."""

    def set_wall_offset(self, offset_ns: int) -> None:
        """Set the wall clock minus the monotonic clock for all later drawings [ns]."""
        self._timelines = columns.Timelines(self._rate_hz, offset_ns)

    def still(self) -> Iterator[tuple[str, rr.AsComponents]]:
        """Yield the entity path and archetype of each static part."""
        yield from still(self._parts, self._frames, self._geometry.labels)
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
        for signal in self._digital:
            colours = [palette.OFF, palette.OUTPUT if signal.kind == "output" else palette.INPUT]
            yield signal.path, rr.StateConfiguration(values=list(LEVELS), labels=list(LEVELS), colors=colours)

    def bus_load(self, share: float) -> Iterator[tuple[str, rr.AsComponents]]:
        """Set the bus load, which is 1 for a full bus, and yield the static parts that show it."""
        self._plots[curves.TIMING] = lines = curves.timing(self._rate_hz, share)
        yield curves.TIMING, _series(lines)

    def complete(self, records: NDArray[np.void]) -> list[Chunk]:
        """Return complete, unchanged records as chunks for a recording file."""
        return columns.chunks(self._timelines.for_records(records), [Column(RECORD, FIELDS, columns.structs(records))])

    def drawn(self, records: NDArray[np.void], standing: ReadoutState, before: np.void | None = None) -> list[Chunk]:
        """Return the drawing of one or more records, which are in order.

        Parameters
        ----------
        records
            Records to draw, (N,).
        standing
            State at the last record.
        before
            Last record that was drawn before; None if there is none.

        """
        starts, ends = _groups(records["cycle"], self._rate_hz // DRAWN_HZ)
        distance = self._reach.singularity_distance(records["pose"][ends])
        first, newest = _hide_unknown(records[starts]), _hide_unknown(records[ends])
        parts = moving(self._geometry, self._parts, first, newest)
        at, begins = _gaps(records, starts, before)
        plots = []
        for path, values in curves.values(records, newest, starts, distance).items():
            table = np.insert(curves.with_limits(values, self._plots[path]), at, np.nan, axis=0)
            plots.append(Column(path, SCALARS, columns.scalars(table)))
        chunks = columns.chunks(self._timelines.for_records(newest), parts)
        chunks += columns.chunks(self._timelines.for_records(np.insert(newest, at, begins)), plots)
        return chunks + self._status(records) + self._switched(records) + self._readout(records, standing, before)

    def goal(self, record: np.void, pose: Sequence[float] | None) -> list[Chunk]:
        """Return the drawing of a goal's pose, shown from the time of `record` on; None erases the previous drawing."""
        return columns.chunks(self._timelines.for_records(record.reshape(1)), [goal(self._parts, pose)])

    def _readout(self, records: NDArray[np.void], standing: ReadoutState, before: np.void | None) -> list[Chunk]:
        """Return the readout at the last record and, if the mode has changed, at the first record in the last mode."""
        mode = records["mode"]
        changes = np.flatnonzero(np.diff(mode, prepend=mode[0] if before is None else before["mode"]))
        at = records[np.unique([*changes[-1:], len(records) - 1])]
        texts = pa.array([[readout.markdown(record, standing, self._geometry.labels)] for record in at])
        return columns.chunks(self._timelines.for_records(at), [Column(readout.PATH, TEXT, texts)])

    def _status(self, records: NDArray[np.void]) -> list[Chunk]:
        """Return the mode and the outline of the workspace at the first record and whenever the mode or φ changes."""
        changed = np.diff(records["mode"], prepend=len(MODES)) != 0
        some = np.arange(0, len(records), max(1, self._rate_hz // OUTLINES_HZ))
        steps = self._reach.outline_indices(records["pose"][some, 2])
        changed[some] |= np.diff(steps, prepend=steps[0]) != 0
        at = records[changed]
        modes = pa.array([[MODES[mode]] for mode in at["mode"]])
        indices = self._reach.outline_indices(at["pose"][:, 2])
        outlines = columns.ragged([[self._reach.outline(index)] for index in indices])
        parts = [Column("/mode", STATE, modes), Column("/robot/workspace", STRIPS, outlines)]
        return columns.chunks(self._timelines.for_records(at), parts)

    def _switched(self, records: NDArray[np.void]) -> list[Chunk]:
        """Return the state of each output and input at the first record and in each cycle in which it changed."""
        drawn: list[Chunk] = []
        for signal in self._digital:
            on = signal.values(records).astype(int)
            changed = np.diff(on, prepend=-1) != 0
            levels = pa.array([[LEVELS[level]] for level in on[changed]])
            times = self._timelines.for_records(records[changed])
            drawn += columns.chunks(times, [Column(signal.path, STATE, levels)])
        return drawn


def _hide_unknown(records: NDArray[np.void]) -> NDArray[np.void]:
    """Return a copy of records with NaN as the positions of sliders that are not homed, and as poses if one is not."""
    shown = records.copy()
    shown["position"][records["homed"] == 0] = np.nan
    unknown = ~np.all(records["homed"], axis=1)
    shown["pose"][unknown] = shown["commanded_pose"][unknown] = np.nan
    return shown


def _groups(cycles: NDArray[np.int64], size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and the last row of each group. A group contains the rows of up to `size` consecutive cycles."""
    changes = np.flatnonzero(np.diff(cycles // max(1, size))) + 1
    return np.concatenate([[0], changes]), np.concatenate([changes, [len(cycles)]]) - 1


def _gaps(
    records: NDArray[np.void], starts: NDArray[np.intp], before: np.void | None
) -> tuple[NDArray[np.intp], NDArray[np.void]]:
    """Return the groups before which cycles are missing, and for each a record with the time when they began."""
    previous = records[starts - 1]
    previous[0] = records[0] if before is None else before
    gaps = np.flatnonzero(records["cycle"][starts] - previous["cycle"] > 1)
    begins = previous[gaps]
    begins["cycle"] += 1
    begins["deadline_ns"] += 1
    return gaps, begins


def _series(lines: curves.Lines) -> rr.SeriesLines:
    moving, still = len(lines.moving), len(lines.still)
    return rr.SeriesLines(
        names=[*(line.name for line in lines.moving), *(limit.name for limit in lines.still)],
        colors=[*(line.colour for line in lines.moving), *(limit.colour for limit in lines.still)],
        widths=[1.5] * moving + [1.0] * still,
    )
