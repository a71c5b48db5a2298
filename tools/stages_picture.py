"""Picture of the two kinds of stages, tools/pictures/stages.svg, drawn from the shipped geometries. Needs matplotlib.

python tools/stages_picture.py [FILE]
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from trirail.config import SIM, geometry, load
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import inverse
from trirail.workspace import part_positions
from trirail.workspace.part_positions import RobotParts

FILE = Path(__file__).parent / "pictures/stages.svg"
INK, GREY, RAIL, TABLE, CARRIAGE, CROSS = "#1f2933", "#7b8794", "#d3d9e0", "#f0772b", "#1b7f4d", "#2166ac"
TURNED = 0.0, 0.0, math.radians(12.0)
"""Pose of the stages [m, m, rad]. To be visible, the angle exceeds the rotation limit of the shipped stages."""
PANELS = (
    ("uvw", "kind 1, 3-PRP: the cross slides turn with the table"),
    ("uvw-ppr", "kind 2, 3-PPR: the cross slides keep their direction"),
)
SLIDE = 0.014
"""Half of the drawn length of a cross slide [m]."""


def draw(file: Path) -> None:
    """Draw both kinds of stages with a turned table, in millimetres. Dashed lines show the tables at angle zero."""
    # Text is stored as text, and no date is stored, so that the file is small and depends only on the stages.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "stages"}):
        figure = Figure(figsize=(10.0, 5.2), layout="constrained")
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for panel, (name, title) in zip(panels, PANELS, strict=True):
            config = load(SIM.with_name(f"{name}.toml"))
            robot = geometry(config.geometry)
            _stage(panel, robot, RobotParts.from_geometry(robot, config.limits.slider))
            panel.set_title(title, color=INK, fontsize=12)
            panel.set_aspect("equal")
            panel.set_axis_off()
        _legend(panels[0])
        figure.savefig(file, format="svg", metadata={"Date": None})


def _stage(panel: Axes, robot: Geometry, parts: RobotParts) -> None:
    """Draw rails, table, carriages, cross slides and pivots."""
    for rail in parts.rails:
        panel.plot(*(1e3 * rail.T), color=RAIL, linewidth=9.0, solid_capstyle="round", zorder=1)
    table = parts.outline[-1]
    panel.plot(*(1e3 * table.T), color=GREY, linewidth=1.0, linestyle=(0, (4, 3)), zorder=2)
    (turned,) = part_positions.transform_lines([table], TURNED)
    panel.add_patch(Polygon(1e3 * turned, facecolor=TABLE, edgecolor=TABLE, alpha=0.15, zorder=2))
    panel.plot(*(1e3 * turned.T), color=TABLE, linewidth=1.8, zorder=3)
    pose = np.array([TURNED])
    at = part_positions.slider_points(robot, inverse(robot, pose).position)
    held = part_positions.pivot_points(robot, at, pose)[0]
    lines = part_positions.cross_slide_lines(robot, parts, at, pose[:, 2])[0]
    for label, carriage, pivot, line in zip(robot.labels, at[0], held, lines, strict=True):
        along = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
        slide = np.array([carriage - SLIDE * along, carriage + SLIDE * along])
        panel.plot(*(1e3 * slide.T), color=CROSS, linewidth=5.0, solid_capstyle="butt", zorder=4)
        for point, shape, colour, size, order in ((carriage, "s", CARRIAGE, 13, 3.5), (pivot, "o", INK, 7, 6)):
            x, y = 1e3 * point
            panel.plot(x, y, shape, color="white", markeredgecolor=colour, markersize=size, mew=2.0, zorder=order)
        x, y = 1e3 * carriage + 19.0 * carriage / np.linalg.norm(carriage)
        panel.text(x, y, label, color=CARRIAGE, fontsize=14, fontweight="bold", ha="center", va="center", zorder=7)


def _legend(panel: Axes) -> None:
    """Draw the legend, which explains the symbols of the parts."""
    for style, colour, name in (
        ("s", CARRIAGE, "carriage, driven on its rail"),
        ("|", CROSS, "cross slide, not driven"),
        ("o", INK, "pivot"),
        ("-", TABLE, "table, turned"),
    ):
        face, width = ("white", 2.0) if style in "so" else (colour, 3.0)
        panel.plot([], [], style, color=colour, markersize=10, markeredgewidth=width, markerfacecolor=face, label=name)
    panel.legend(loc="center", fontsize=9, frameon=False, labelcolor=INK)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
