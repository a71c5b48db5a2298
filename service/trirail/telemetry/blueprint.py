"""How the viewer is laid out: the robot large with mode and events below it, beside it the curves."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trirail.telemetry import curves, readout
from trirail.telemetry.shown_robot import ShownRobot
from trirail.workspace.mechanism import Points

WINDOW = 8.0
"""How much of the past the plots show [s]."""
MARGIN = 0.09
"""Room around the robot, as a share of its size."""


def layout(robot: ShownRobot, bounds: Points) -> rrb.Blueprint:
    """Return the layout for a robot that lies within `bounds`, (2, 2): lowest and highest x and y [m]."""
    window = rrb.TimeAxis(view_range=_last(WINDOW))
    error_mm = robot.limits.slider.following_error * 1e3
    sliders = rrb.Vertical(
        _plot("Slider position λ  [mm]", curves.POSITION, window, legend=True),
        _plot("Slider velocity  [mm/s]", curves.VELOCITY, window),
        _plot("Slider acceleration  [m/s²]", curves.ACCELERATION, window),
        _plot(f"Following error  [µm], limit ±{error_mm:g} mm", curves.ERROR, window),
    )
    platform = rrb.Vertical(
        _plot("Centre x, y  [mm]", curves.CENTRE, window, legend=True),
        _plot("Angle φ  [°]", curves.PHI, window),
        _plot("Distance to singularity  [°]", curves.SINGULARITY, window),
        _plot("Loop timing  [µs]", curves.TIMING, window, legend=True),
        row_shares=[18, 19, 25, 20],
    )
    events = rrb.TextLogView(
        name="Events",
        origin="/events",
        columns=rrb.TextLogColumns(
            timeline_columns=[rrb.encodings.TimelineColumn("t")],
            text_log_columns=["LogLevel", "Body"],
        ),
    )
    left = rrb.Vertical(
        _robot(robot, bounds),
        rrb.TextDocumentView(name="Now", origin=readout.PATH),
        rrb.StateTimelineView(name="Mode", origin="/mode", time_view=window),
        events,
        row_shares=[52, 26, 10, 19],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, sliders, platform, column_shares=[8, 6, 6]),
        rrb.TimePanel(state="collapsed", timeline="t", play_state="Following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _robot(robot: ShownRobot, bounds: Points) -> rrb.Spatial2DView:
    low, high = bounds + MARGIN * np.ptp(bounds) * np.array([[-1.0], [1.0]])
    trace = rrb.VisibleTimeRanges(timeline="t", range=_last(WINDOW))
    return rrb.Spatial2DView(
        name=f"{robot.name}: 3-PRP planar robot",
        origin="/",
        contents="/robot/**",
        visual_bounds=rrb.VisualBounds2D(x_range=(low[0], high[0]), y_range=(-high[1], -low[1])),
        overrides={"/robot/trace": [rr.LineStrips2D.from_fields(), trace]},
    )


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
