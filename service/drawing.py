"""The robot drawn in 2D under /robot: fixed parts and shapes once, then where the moving ones are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from service import mechanism, palette
from service.geometry import LEGS, Geometry
from service.mechanism import Mechanism, Points
from service.palette import Colour

ORIGIN = 0.02
"""Arms of the cross at the base frame's origin, as a share of the robot's size."""
_CROSS = (np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, -1.0], [0.0, 1.0]]))


def still(parts: Mechanism) -> Iterator[tuple[str, rr.AsComponents]]:
    """Yield what is logged once, as static: entity path and archetype."""
    yield "/robot", rr.Transform3D(mat3x3=[[1, 0, 0], [0, -1, 0], [0, 0, 1]])  # 2D views have y downwards
    yield "/robot/rails", _lines(parts.rails, [palette.FRAME], 4.5, order=10)
    yield "/robot/travel", _lines(parts.travel, [palette.dark(c) for c in palette.SLIDERS], 3.0, order=11)
    yield "/robot/stops", _lines(parts.stops, [palette.LIMIT], 1.2, order=12)
    yield (
        "/robot/anchors",
        rr.Points2D(
            parts.anchors,
            radii=rr.Radius.ui_points(6.0),
            colors=[palette.ANCHORS],
            labels=[f"{leg}₀" for leg in LEGS],
            show_labels=True,
            draw_order=13,
        ),
    )
    yield (
        "/robot/names",
        rr.Points2D(
            parts.names,
            radii=rr.Radius.ui_points(0.0),
            colors=palette.SLIDERS,
            labels=list(LEGS),
            show_labels=True,
            draw_order=13,
        ),
    )
    cross = ORIGIN * np.ptp(parts.bounds)
    yield "/robot/origin", _lines([axis * cross for axis in _CROSS], [palette.ARMS], 0.8, order=14)
    yield "/robot/commanded/outline", _lines(parts.outline, [palette.COMMANDED], 4.5, order=20)
    yield "/robot/platform/arms", _lines(parts.arms, [palette.ARMS], 0.8, order=21)
    yield "/robot/platform/outline", _lines(parts.outline, [palette.PLATFORM], 2.2, order=22)
    yield (
        "/robot/trace",
        rr.LineStrips2D.from_fields(colors=[palette.CENTRE], radii=rr.Radius.ui_points(1.2), draw_order=30),
    )
    yield (
        "/robot/platform/centre",
        rr.Points2D([[0.0, 0.0]], radii=rr.Radius.ui_points(4.0), colors=[palette.CENTRE], draw_order=31),
    )
    yield (  # each slider, and in it the pin that the platform turns on
        "/robot/sliders",
        rr.Points2D.from_fields(
            radii=[-8.5] * 3 + [-3.0] * 3,  # negative: points of the screen, not metres
            colors=[*palette.SLIDERS, *[palette.PIN] * 3],
            draw_order=32,
        ),
    )


def moving(
    geometry: Geometry, times: Sequence[rr.TimeColumn], before: NDArray[np.void], records: NDArray[np.void]
) -> list[Chunk]:
    """Return where the moving parts are in `records`, and the trace of the centre from `before` to there.

    Both have shape (N,), as have the times.
    """
    sliders = mechanism.sliders(geometry, records["position"])
    sliders_and_pins = np.concatenate([sliders, sliders], axis=1)
    steps = np.stack([before["pose"][:, :2], records["pose"][:, :2]], axis=1)
    return [
        Chunk.from_columns("/robot/platform", times, _placed(records["pose"])),
        Chunk.from_columns("/robot/commanded", times, _placed(records["commanded_pose"])),
        Chunk.from_columns(
            "/robot/sliders",
            times,
            rr.Points2D.columns(positions=sliders_and_pins.reshape(-1, 2)).partition(np.full(len(sliders), 6)),
        ),
        Chunk.from_columns("/robot/trace", times, rr.LineStrips2D.columns(strips=steps)),
    ]


def _lines(lines: list[Points], colours: Sequence[Colour], radius: float, *, order: float) -> rr.LineStrips2D:
    return rr.LineStrips2D(lines, colors=colours, radii=rr.Radius.ui_points(radius), draw_order=order)


def _placed(pose: Points) -> rr.ComponentColumnList:
    """Return the transforms from the platform's frame to the base frame for poses (N, 3)."""
    x, y, phi = pose.T
    zero = np.zeros(len(pose))
    turned = np.stack([zero, zero, np.sin(phi / 2.0), np.cos(phi / 2.0)], axis=1)
    return rr.Transform3D.columns(translation=np.stack([x, y, zero], axis=1), quaternion=turned)
