"""The robot drawn in 2D under /robot: fixed parts and shapes once, then where the moving ones are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from trirail.config import FramesTable
from trirail.kinematics.geometry import Geometry
from trirail.naming import Labels
from trirail.telemetry import columns, palette
from trirail.telemetry.columns import Column
from trirail.telemetry.palette import Colour
from trirail.workspace import part_positions
from trirail.workspace.part_positions import Points, RobotParts

ORIGIN = 0.02
"""Arms of the cross at the base frame's origin, as a share of the robot's size."""
POSITIONS = rr.Points2D.descriptor_positions()
STRIPS = rr.LineStrips2D.descriptor_strips()
TRANSLATION = rr.Transform3D.descriptor_translation()
QUATERNION = rr.Transform3D.descriptor_quaternion()
_CROSS = (np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, -1.0], [0.0, 1.0]]))


def still(parts: RobotParts, frames: FramesTable, names: Labels) -> Iterator[tuple[str, rr.AsComponents]]:
    """Yield what is logged once, as static: entity path and archetype."""
    yield "/robot", rr.Transform3D(mat3x3=[[1, 0, 0], [0, -1, 0], [0, 0, 1]])  # 2D views have y downwards
    yield "/robot/rails", _lines(parts.rails, [palette.FRAME], 4.5, order=10)
    yield "/robot/travel", _lines(parts.travel, [palette.dark(c) for c in palette.SLIDERS], 3.0, order=11)
    yield "/robot/stops", _lines(parts.stops, [palette.LIMIT], 1.2, order=12)
    zeros = [f"{name}₀" for name in names]
    yield "/robot/anchors", _labelled(parts.anchors, zeros, [palette.ANCHORS], 6.0, order=13)
    yield "/robot/names", _labelled(parts.names, list(names), palette.SLIDERS, 0.0, order=13)
    cross = ORIGIN * np.ptp(parts.bounds)
    yield "/robot/origin", _lines([axis * cross for axis in _CROSS], [palette.ARMS], 0.8, order=14)
    yield from _named(frames, cross)
    yield "/robot/commanded/outline", _lines(parts.outline, [palette.COMMANDED], 4.5, order=20)
    yield "/robot/platform/arms", _lines(parts.arms, [palette.ARMS], 0.8, order=21)
    yield "/robot/platform/outline", _lines(parts.outline, [palette.PLATFORM], 2.2, order=22)
    yield "/robot/platform/stops", _lines(parts.edge_stops, [palette.LIMIT], 1.2, order=23)
    yield "/robot/workspace", _strips([palette.WORKSPACE], 0.8, order=15)
    yield "/robot/goal", _strips([palette.GOAL], 1.0, order=24)
    # Sleeves in which the platform's edges slide, or the carriages' cross slides.
    yield "/robot/passive", _strips([palette.dark(c) for c in palette.SLIDERS], 5.5, order=25)
    yield "/robot/trace", _strips([palette.CENTRE], 1.2, order=30)
    yield (
        "/robot/platform/centre",
        rr.Points2D([[0.0, 0.0]], radii=rr.Radius.ui_points(4.0), colors=[palette.CENTRE], draw_order=31),
    )
    yield (  # each slider, and the pivot that the platform turns on
        "/robot/sliders",
        rr.Points2D.from_fields(
            radii=[-8.5] * 3 + [-3.0] * 3,  # negative: points of the screen, not metres
            colors=[*palette.SLIDERS, *[palette.PIN] * 3],
            draw_order=32,
        ),
    )


def moving(geometry: Geometry, parts: RobotParts, before: NDArray[np.void], records: NDArray[np.void]) -> list[Column]:
    """Return where the moving parts are in `records`, (N,), and the trace of the centre there from `before`."""
    sliders = part_positions.sliders(geometry, records["position"])
    crossing = part_positions.cross_slides(geometry, parts, sliders, records["pose"][:, 2])
    pivots = part_positions.pivots(geometry, sliders, records["pose"])
    steps = np.stack([before["pose"][:, :2], records["pose"][:, :2]], axis=1)[:, None]
    return [
        *_placed("/robot/platform", records["pose"]),
        *_placed("/robot/commanded", records["commanded_pose"]),
        Column("/robot/sliders", POSITIONS, columns.vectors(np.concatenate([sliders, pivots], axis=1))),
        Column("/robot/passive", STRIPS, columns.strips(crossing)),
        Column("/robot/trace", STRIPS, columns.strips(steps)),
    ]


def goal(parts: RobotParts, pose: Sequence[float] | None) -> Column:
    """Return the platform where the goal leads it, with a cross at its centre; nothing without a goal."""
    if pose is None:
        return Column("/robot/goal", STRIPS, columns.ragged([[]]))
    cross = [axis * ORIGIN * np.ptp(parts.bounds) for axis in _CROSS]
    return Column("/robot/goal", STRIPS, columns.ragged([part_positions.placed([*parts.outline, *cross], pose)]))


def _named(frames: FramesTable, size: float) -> Iterator[tuple[str, rr.AsComponents]]:
    """Yield the tools on the platform and the axes of work frames, each with its name."""
    if frames.tool:
        tools = np.array(list(frames.tool.values()))
        yield "/robot/platform/tools", _labelled(tools, list(frames.tool), [palette.CENTRE], 3.0, order=31)
    for name, frame in frames.work.items():
        axes = part_positions.placed([np.array([[0.0, 0.0], [size, 0.0]]), np.array([[0.0, 0.0], [0.0, size]])], frame)
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
    """Return how lines look that come later."""
    return rr.LineStrips2D.from_fields(colors=colours, radii=rr.Radius.ui_points(radius), draw_order=order)


def _labelled(
    points: Points, labels: list[str], colours: Sequence[Colour], radius: float, *, order: float
) -> rr.Points2D:
    look = {"colors": colours, "radii": rr.Radius.ui_points(radius), "draw_order": order}
    return rr.Points2D(points, labels=labels, show_labels=True, **look)


def _placed(path: str, pose: Points) -> list[Column]:
    """Return the transforms from the platform's frame to the base frame for poses (N, 3)."""
    translation, quaternion = np.zeros((len(pose), 1, 3)), np.zeros((len(pose), 1, 4))
    translation[:, 0, :2] = pose[:, :2]
    quaternion[:, 0, 2], quaternion[:, 0, 3] = np.sin(pose[:, 2] / 2.0), np.cos(pose[:, 2] / 2.0)
    return [
        Column(path, TRANSLATION, columns.vectors(translation)),
        Column(path, QUATERNION, columns.vectors(quaternion)),
    ]
