"""Layout of the viewer: the robot on the left, with its mode and events below, and the curves on the right.

Several robots are shown next to each other, with one column per robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trirail.telemetry import curves, journal, readout, shown_alignment
from trirail.telemetry.drawn_robot import DIGITAL, DrawnRobot
from trirail.workspace.part_positions import Points

WINDOW = 8.0
"""Time span of the plots [s]."""
MARGIN = 0.09
"""Margin around the robot, as a fraction of its size."""


class RobotView(NamedTuple):
    """Robot to be shown by the viewer."""

    robot: DrawnRobot
    bounds: Points
    """Bounds of the robot's parts, (2, 2): lowest and highest x and y [m]."""
    root: str = ""
    """Path of the entity that contains all entities of the robot; empty for the root of the recording."""


def layout(shown: RobotView) -> rrb.Blueprint:
    """Return the layout for one robot."""
    window = rrb.TimeAxis(view_range=_last(WINDOW))
    sliders = rrb.Vertical(
        _plot("Slider position λ  [mm]", curves.POSITION, window, legend=True),
        _plot("Slider velocity  [mm/s]", curves.VELOCITY, window),
        _plot("Slider acceleration  [m/s²]", curves.ACCELERATION, window),
        _error(shown, window),
    )
    platform = rrb.Vertical(
        _plot("Centre x, y  [mm]", curves.CENTRE, window, legend=True),
        _plot("Angle φ  [°]", curves.PHI, window),
        rrb.Tabs(
            _plot("Distance to singularity  [°]", curves.SINGULARITY, window),
            _plot("Alignment: marks to go  [µm]", shown_alignment.RESIDUALS, window, legend=True),
        ),
        _plot("Loop timing  [µs]", curves.TIMING, window, legend=True),
        row_shares=[18, 19, 25, 20],
    )
    left = rrb.Vertical(*_situation(shown, window, "t"), row_shares=[53, 23, 11 + 6 * len(shown.robot.digital), 21])
    return _blueprint(rrb.Horizontal(left, sliders, platform, column_shares=[8, 6, 6]), "t")


def side_by_side(several: Sequence[RobotView]) -> rrb.Blueprint:
    """Return the layout for several robots, with one column per robot.

    The plots use wall-clock time, because each robot's time `t` begins with its own control loop.
    """
    window = rrb.TimeAxis(view_range=_last(WINDOW))
    columns = [
        rrb.Vertical(
            *_situation(shown, window, "wall"),
            _plot("Slider position λ  [mm]", f"{shown.root}{curves.POSITION}", window, legend=True),
            _error(shown, window),
            row_shares=[46, 24, 9, 17, 16, 16],
            name=shown.robot.name,
        )
        for shown in several
    ]
    return _blueprint(rrb.Horizontal(*columns), "wall")


def _blueprint(views: rrb.Horizontal, timeline: str) -> rrb.Blueprint:
    return rrb.Blueprint(
        views,
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="Following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _situation(shown: RobotView, window: rrb.TimeAxis, timeline: str) -> list[rrb.View | rrb.Tabs]:
    """Return the views that show the robot's drawing, its current values, its mode and its events."""
    events = rrb.TextLogView(
        name="Events",
        origin=f"{shown.root}{journal.EVENTS}",
        columns=rrb.TextLogColumns(
            timeline_columns=[rrb.encodings.TimelineColumn(timeline, visible=False)],
            text_log_columns=["LogLevel", "Body"],
        ),
    )
    aligned = f"{shown.root}{shown_alignment.TABLE}"
    return [
        _robot(shown, timeline),
        rrb.TextDocumentView(name="Now", origin=f"{shown.root}{readout.PATH}"),
        _states(shown, window),
        rrb.Tabs(events, rrb.TextDocumentView(name="Alignment", origin=aligned)),
    ]


def _states(shown: RobotView, window: rrb.TimeAxis) -> rrb.StateTimelineView:
    """Return the view of the mode. It also shows the digital outputs and inputs, if the robot has any."""
    if not shown.robot.digital:
        return rrb.StateTimelineView(name="Mode", origin=f"{shown.root}/mode", time_view=window)
    return rrb.StateTimelineView(
        name="Mode, outputs and inputs",
        origin=shown.root or "/",
        contents=[f"{shown.root}/mode", f"{shown.root}{DIGITAL}/**"],
        time_view=window,
    )


def _robot(shown: RobotView, timeline: str) -> rrb.Spatial2DView:
    low, high = shown.bounds + MARGIN * np.ptp(shown.bounds) * np.array([[-1.0], [1.0]])
    trace = rrb.VisibleTimeRanges(timeline=timeline, range=_last(WINDOW))
    return rrb.Spatial2DView(
        name=f"{shown.robot.name}: {shown.robot.geometry.kind} planar robot",
        origin=shown.root or "/",
        contents=f"{shown.root}/robot/**",
        visual_bounds=rrb.VisualBounds2D(x_range=(low[0], high[0]), y_range=(-high[1], -low[1])),
        overrides={f"{shown.root}/robot/trace": [rr.LineStrips2D.from_fields(), trace]},
    )


def _error(shown: RobotView, window: rrb.TimeAxis) -> rrb.TimeSeriesView:
    error_mm = shown.robot.limits.slider.following_error * 1e3
    return _plot(f"Following error  [µm], limit ±{error_mm:g} mm", f"{shown.root}{curves.ERROR}", window)


def _plot(name: str, origin: str, window: rrb.TimeAxis, *, legend: bool = False) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name,
        origin=origin,
        axis_x=window,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
    )


def _last(seconds: float) -> rr.TimeRange:
    return rr.TimeRange(
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-seconds),
        end=rr.TimeRangeBoundary.cursor_relative(seconds=0.02 * seconds),
    )
