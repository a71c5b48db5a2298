"""How the viewer is laid out: the robot large, its sliders beside it, the rest below."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from service.config import Config
from service.mechanism import Points

WINDOW = 8.0
"""How much of the past the plots show [s]."""
MARGIN = 0.08
"""Room around the robot, as a share of its size."""


def layout(settings: Config, bounds: Points) -> rrb.Blueprint:
    """Return the layout for a robot that lies within `bounds`, (2, 2): lowest and highest x and y [m]."""
    window = rrb.TimeAxis(view_range=_last(WINDOW))
    error_mm = settings.limits.slider.following_error * 1e3
    sliders = rrb.Vertical(
        _plot("Slider position λ  [mm]", "/sliders/position", window),
        _plot("Slider velocity  [mm/s]", "/sliders/velocity", window),
        _plot("Slider acceleration  [m/s²]", "/sliders/acceleration", window),
        _plot(f"Following error  [µm],  limit ±{error_mm:g} mm", "/sliders/following_error", window),
    )
    below = rrb.Horizontal(
        _plot("Pose x, y  [mm]", "/pose/centre", window, legend=True),
        _plot("Pose φ  [°]", "/pose/phi", window),
        _plot("Loop timing  [µs]", "/loop", window, legend=True),
        rrb.Vertical(
            rrb.StateTimelineView(name="Mode", origin="/mode", time_view=window),
            rrb.TextLogView(
                name="Events",
                origin="/events",
                columns=rrb.TextLogColumns(
                    timeline_columns=[rrb.encodings.TimelineColumn("t", visible=False)],
                    text_log_columns=["LogLevel", "Body"],
                ),
            ),
            row_shares=[2, 3],
        ),
        column_shares=[2, 2, 2, 3],
    )
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(_robot(settings, bounds), sliders, column_shares=[4, 5]), below, row_shares=[7, 3]),
        rrb.TimePanel(state="collapsed", timeline="t", play_state="Following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _robot(settings: Config, bounds: Points) -> rrb.Spatial2DView:
    low, high = bounds + MARGIN * np.ptp(bounds) * np.array([[-1.0], [1.0]])
    trace = rrb.VisibleTimeRanges(timeline="t", range=_last(WINDOW))
    return rrb.Spatial2DView(
        name=f"{settings.robot.name}: 3-PRP planar robot",
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
