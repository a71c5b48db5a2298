"""Plot of the workspace: slices at several angles phi, coloured by conditioning, and the area as a function of phi.

This module requires matplotlib.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from trirail.config import Limits
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry
from trirail.workspace.aspect import phi_range
from trirail.workspace.part_positions import RobotParts
from trirail.workspace.singularity import conditioning
from trirail.workspace.workspace import Extent, permitted_slice, polygon_area, reachable_slice

__all__ = ["draw_workspace"]

INK, GREY, RAIL, PLATFORM, FORBIDDEN = "#1f2933", "#7b8794", "#d3d9e0", "#f0772b", "#c0392b"
COLOURS, SCALE = colormaps["viridis"], Normalize(0.0, 1.0)
OUTSIDE_OPACITY = 0.35  # opacity of the reachable slice outside the platform's limits
SLICE_PIXELS = 160  # samples of conditioning along each side of a slice
MAX_COLUMNS, FIGURE_WIDTH_IN, STRIP_HEIGHT_IN = 4, 13.0, 3.4
VIEW_REACH_RATIO = 2.5  # greatest ratio of the displayed range to the reach, for stages with long rails
DASHES = (0, (4, 3))
MM, CM2 = 1e3, 1e4


def draw_workspace(
    file: Path,
    title: str,
    geometry: Geometry,
    limits: Limits,
    planned: Limits,
    angles: Sequence[float],
    reach: Extent,
    service: Extent,
) -> None:
    """Draw slices of the workspace and their areas into a file. The suffix of the file selects the format.

    Parameters
    ----------
    file : Path
        Output file.
    title : str
        Title of the figure.
    geometry, limits
        Geometry and limits of the robot.
    planned : Limits
        Limits that the service applies to goals, from backlash_reserve.planned_limits.
    angles : Sequence[float]
        Angles phi of the slices [rad].
    reach, service : Extent
        Extents of the reachable and of the permitted workspace.

    Raises
    ------
    ValueError
        Matplotlib does not support this format.
    OSError
        The file cannot be written.
    """
    columns = min(MAX_COLUMNS, len(angles))
    rows = math.ceil(len(angles) / columns)
    height = rows * min(0.9 * FIGURE_WIDTH_IN / columns, 5.0)
    figure = Figure(figsize=(FIGURE_WIDTH_IN, height + STRIP_HEIGHT_IN), dpi=150, layout="constrained")
    figure.suptitle(title, x=0.008, ha="left", color=INK, fontsize=16, fontweight="bold")
    slices, below = figure.subfigures(2, 1, height_ratios=[height, STRIP_HEIGHT_IN])  # type: ignore[misc]
    panels = slices.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    parts = RobotParts.from_geometry(geometry, limits.slider)
    for panel, phi in zip(panels.flat, angles, strict=False):
        _draw_slice(panel, geometry, limits, planned, parts, phi)
    for panel in panels.flat[len(angles) :]:
        panel.set_axis_off()
    reached = float(np.abs([*reach.x, *reach.y]).max())
    extent = MM * min(1.06 * max(reached, float(np.abs(parts.rails).max())), VIEW_REACH_RATIO * reached)
    panels[0, 0].set(xlim=(-extent, extent), ylim=(-extent, extent))
    for panel in panels[:, 0]:
        panel.set_ylabel("y [mm]", color=GREY, fontsize=9)
    for panel in panels.flat[max(len(angles) - columns, 0) : len(angles)]:  # the lowest panel of each column
        panel.tick_params(labelbottom=True)
    for panel in panels[-1]:
        panel.set_xlabel("x [mm]", color=GREY, fontsize=9)
    bar = slices.colorbar(ScalarMappable(SCALE, COLOURS), ax=panels, aspect=40, pad=0.01)
    bar.set_label("conditioning of J₁⁻¹J₂   (0 singular, 1 isotropic)", color=INK, fontsize=9)
    bar.ax.tick_params(colors=GREY, labelsize=8)
    _draw_areas(below.subplots(), geometry, planned, angles, reach, service)
    figure.savefig(file)


def _draw_slice(
    panel: Axes, geometry: Geometry, limits: Limits, planned: Limits, parts: RobotParts, phi: float
) -> None:
    """Draw the slice at an angle phi, with the rails, and with the platform at the origin and rotated by phi."""
    for rail in parts.rails:
        panel.plot(*(MM * rail.T), color=RAIL, linewidth=4.0, solid_capstyle="round", zorder=1)
    reach, service = reachable_slice(geometry, limits, phi), permitted_slice(geometry, planned, phi)
    _draw_conditioning(panel, geometry, reach, phi, OUTSIDE_OPACITY)
    _draw_conditioning(panel, geometry, service, phi, 1.0)
    panel.add_patch(Polygon(MM * reach, fill=False, edgecolor=GREY, linewidth=0.8, zorder=4))
    panel.add_patch(Polygon(MM * service, fill=False, edgecolor=INK, linewidth=1.4, joinstyle="round", zorder=5))
    (left, right), (bottom, top) = limits.platform.x, limits.platform.y
    window = MM * np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    panel.add_patch(Polygon(window, fill=False, edgecolor=INK, linewidth=0.7, linestyle=DASHES, zorder=6))
    turned = np.array([[math.cos(phi), math.sin(phi)], [-math.sin(phi), math.cos(phi)]])
    for line in parts.outline:
        panel.plot(*(MM * line @ turned).T, color=PLATFORM, linewidth=0.9, zorder=7)
    if len(reach) == 0:
        panel.text(0.5, 0.5, "out of reach", color=GREY, ha="center", va="center", transform=panel.transAxes, zorder=8)
    panel.set_aspect("equal")
    panel.set_title(f"φ = {_format_degrees(phi)}", loc="left", color=INK, fontsize=11, fontweight="bold", pad=4)
    panel.set_title(f"{CM2 * polygon_area(service):.4g} cm²", loc="right", color=GREY, fontsize=9, pad=4)
    _style_axes(panel)


def _draw_conditioning(panel: Axes, geometry: Geometry, polygon: Array, phi: float, opacity: float) -> None:
    if len(polygon) == 0:
        return
    (left, bottom), (right, top) = polygon.min(axis=0), polygon.max(axis=0)
    x, y = np.meshgrid(np.linspace(left, right, SLICE_PIXELS), np.linspace(bottom, top, SLICE_PIXELS))
    poses = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, phi)])
    image = panel.imshow(
        conditioning(geometry, poses).reshape(x.shape),
        cmap=COLOURS,
        norm=SCALE,
        alpha=opacity,
        origin="lower",
        extent=(MM * left, MM * right, MM * bottom, MM * top),
        interpolation="bilinear",
        zorder=2,
    )
    image.set_clip_path(Polygon(MM * polygon, transform=panel.transData))


def _draw_areas(
    strip: Axes, geometry: Geometry, limits: Limits, angles: Sequence[float], reach: Extent, service: Extent
) -> None:
    """Draw the area of the slices as a function of phi, and the singular angles with the singularity margin."""
    low, high = np.degrees(phi_range(geometry))
    margin = math.degrees(limits.singularity_margin)
    for wall, inward in ((low, margin), (high, -margin)):
        strip.axvspan(wall, wall + inward, color=FORBIDDEN, alpha=0.10, linewidth=0)
        strip.axvline(wall, color=FORBIDDEN, linewidth=1.2)
    strip.fill_between(np.degrees(reach.angles), CM2 * reach.areas, color=RAIL, alpha=0.45, linewidth=0)
    strip.plot(np.degrees(reach.angles), CM2 * reach.areas, color=GREY, linewidth=0.9)
    shown = np.degrees(service.angles)
    centre = conditioning(geometry, np.column_stack([np.zeros((len(shown), 2)), service.angles]))
    filled = strip.fill_between(shown, CM2 * service.areas, alpha=0.0)
    image = strip.imshow(
        centre[np.newaxis],
        cmap=COLOURS,
        norm=SCALE,
        aspect="auto",
        extent=(shown[0], shown[-1], 0.0, CM2 * service.best_area),
        interpolation="bilinear",
        zorder=2,
    )
    image.set_clip_path(filled.get_paths()[0], transform=strip.transData)
    strip.plot(shown, CM2 * service.areas, color=INK, linewidth=1.4, zorder=3)
    strip.plot(
        np.degrees(angles),
        [CM2 * polygon_area(permitted_slice(geometry, limits, phi)) for phi in angles],
        "o",
        color=INK,
        markersize=4,
    )
    first, last = VIEW_REACH_RATIO * np.degrees(reach.phi)
    strip.set(xlim=(max(low - 3.0, first), min(high + 3.0, last)), ylim=(0.0, 1.12 * CM2 * reach.best_area))
    strip.set_title(
        "Area of the slices along φ, coloured by the conditioning at x = y = 0",
        loc="left",
        color=INK,
        fontsize=10,
        pad=6,
    )
    strip.set_xlabel("φ [°]", color=GREY, fontsize=9)
    strip.set_ylabel("area [cm²]", color=GREY, fontsize=9)
    _style_axes(strip)
    strip.legend(
        handles=[
            Patch(
                facecolor=COLOURS(0.7),
                edgecolor=INK,
                label=f"what the service permits: {CM2 * service.volume:.4g} cm²·rad",
            ),
            Patch(
                facecolor=RAIL,
                alpha=0.6,
                edgecolor=GREY,
                label=f"the robot's own reach: {CM2 * reach.volume:.4g} cm²·rad",
            ),
            Line2D([], [], color=PLATFORM, linewidth=0.9, label="the platform, turned, with its centre at x = y = 0"),
            Line2D([], [], color=INK, linewidth=0.7, linestyle=DASHES, label="limits.platform, the window for x and y"),
            Patch(facecolor=FORBIDDEN, alpha=0.3, label=f"singular, and {margin:.1f}° of margin"),
        ],
        loc="upper left",
        bbox_to_anchor=(max(low + margin + 1.0, first), 1.0),
        bbox_transform=strip.get_xaxis_transform(),
        frameon=False,
        fontsize=9,
        labelcolor=INK,
    )


def _style_axes(axes: Axes) -> None:
    """Make the ticks and the frame unobtrusive."""
    axes.tick_params(colors=GREY, labelsize=8, length=2)
    for spine in axes.spines.values():
        spine.set_color(RAIL)


def _format_degrees(phi: float) -> str:
    return f"{round(math.degrees(phi), 2) + 0.0:g}°".replace("-", "−")
