"""Picture of the frames, tools/pictures/frames.png: the positive directions of x, y, φ and the sliders.

python tools/frames_picture.py [FILE]

Needs matplotlib.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Polygon
from numpy.typing import ArrayLike
from trirail.config import SIM, load
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import inverse
from trirail.workspace import part_positions
from trirail.workspace.part_positions import Points, RobotParts

FILE = Path(__file__).parent / "pictures/frames.png"
INK, GREY, RAIL, PLATFORM, BASE, SLIDER = "#1f2933", "#7b8794", "#d3d9e0", "#f0772b", "#2166ac", "#1b7f4d"
DASHES = (0, (4, 3))
MOVED = 60.0, 30.0, 20.0
"""Pose of the robot in the second panel [mm, mm, °]."""
ARC_ANGLES_DEG = 112.0, 200.0
"""Beginning and end of the arc that shows +φ [°]."""


def draw(file: Path) -> None:
    """Draw the robot at its centre and at another pose, in millimetres, with its coordinates."""
    limits = load(SIM).limits.slider
    robot = Geometry.symmetric(0.3)
    parts = RobotParts.from_geometry(robot, limits)
    figure = Figure(figsize=(12.0, 5.9), dpi=150, layout="constrained")
    centre, moved = figure.subplots(1, 2, sharex=True, sharey=True)
    x, y, phi = MOVED
    for panel, pose, title in (
        (centre, (0.0, 0.0, 0.0), "x = 0, y = 0, φ = 0: every slider at 0"),
        (moved, (x / 1e3, y / 1e3, math.radians(phi)), f"x = +{x:.0f} mm, y = +{y:.0f} mm, φ = +{phi:.0f}°"),
    ):
        _robot(panel, robot, parts, pose)
        panel.set_title(title, color=INK, fontsize=13)
        panel.set_aspect("equal")
        panel.set_axis_off()
    _directions(centre, robot, parts)
    _pose(moved)
    figure.savefig(file)


def _robot(panel: Axes, robot: Geometry, parts: RobotParts, pose: tuple[float, float, float]) -> None:
    """Draw the rails, the platform and the sliders, and write the position of each slider next to it."""
    for rail in parts.rails:
        panel.plot(*(1e3 * rail.T), color=RAIL, linewidth=7.0, solid_capstyle="round", zorder=1)
    for line in part_positions.transform_lines(parts.outline, pose):
        panel.add_patch(Polygon(1e3 * line, facecolor=PLATFORM, alpha=0.13, zorder=3))
        panel.plot(*(1e3 * line.T), color=PLATFORM, linewidth=2.0, solid_joinstyle="round", zorder=4)
    positions = inverse(robot, pose).position
    at = part_positions.slider_points(robot, positions[None])[0]
    panel.plot(*(1e3 * at.T), "o", color="white", markeredgecolor=SLIDER, markersize=10, markeredgewidth=2.4, zorder=6)
    for name, slider, outward, position in zip("ABC", at, _outward(parts), positions, strict=True):
        value = f"{position * 1e3:+.0f} mm".replace("-", "−") if abs(position) > 1e-9 else "0"
        side = "right" if outward[0] < -0.1 else "left"
        _text(panel, 1e3 * slider + 38.0 * outward, f"{name}  {value}", SLIDER, ha=side)


def _directions(panel: Axes, robot: Geometry, parts: RobotParts) -> None:
    """Draw the base frame, and the directions in which the slider positions and the angle increase."""
    _axes(panel, (0.0, 0.0), 0.0, 100.0, BASE, ("+x", "+y"))
    _text(panel, (8.0, -17.0), "O = G", INK, ha="left")
    for leg, outward in zip(robot.legs, _outward(parts), strict=True):
        along = _unit(math.degrees(leg.rail_angle))
        start = 1e3 * (np.array(leg.anchor) + leg.home * along) + 28.0 * along + 16.0 * outward
        _arrow(panel, start, start + 90.0 * along, SLIDER)
        _text(panel, start + 102.0 * along, "+", SLIDER)
    begin, end = ARC_ANGLES_DEG
    panel.add_patch(Arc((0.0, 0.0), 110.0, 110.0, theta1=begin, theta2=end, color=PLATFORM, linewidth=2.0, zorder=5))
    tip = 55.0 * _unit(end)
    _arrow(panel, tip - _unit(end + 86.0), tip + 7.0 * _unit(end + 94.0), PLATFORM)
    _text(panel, 84.0 * _unit((begin + end) / 2.0), "+φ", PLATFORM)


def _pose(panel: Axes) -> None:
    """Draw the base frame, the frame of the platform, and x, y and φ between these frames."""
    x, y, phi = MOVED
    _axes(panel, (0.0, 0.0), 0.0, 150.0, BASE, ("+x", "+y"))
    _axes(panel, (x, y), phi, 100.0, PLATFORM, ("", ""))
    for line in ([(x, 0.0), (x, y)], [(0.0, y), (x, y)], [(x, y), (x + 92.0, y)]):
        panel.plot(*np.array(line).T, color=GREY, linewidth=1.0, linestyle=DASHES, zorder=5)
    panel.add_patch(Arc((x, y), 150.0, 150.0, theta2=phi, color=PLATFORM, linewidth=1.6, zorder=5))
    _text(panel, np.array([x, y]) + 104.0 * _unit(phi / 2.0), "φ", PLATFORM)
    _text(panel, (x + 12.0, y - 13.0), "G", PLATFORM)
    _text(panel, (-12.0, -13.0), "O", BASE)
    _text(panel, (x, -14.0), "x", BASE)
    _text(panel, (-12.0, y), "y", BASE)


def _axes(panel: Axes, origin: ArrayLike, turned: float, length: float, colour: str, names: tuple[str, str]) -> None:
    """Draw a frame, turned by an angle [°]."""
    start = np.asarray(origin, dtype=np.float64)
    for name, angle in zip(names, (turned, turned + 90.0), strict=True):
        _arrow(panel, start, start + length * _unit(angle), colour)
        _text(panel, start + (length + 15.0) * _unit(angle), name, colour)
    panel.plot(*start, "o", color=colour, markersize=5.0, zorder=8)


def _arrow(panel: Axes, start: Points, end: Points, colour: str) -> None:
    style = {"arrowstyle": "-|>,head_length=0.55,head_width=0.22", "shrinkA": 0.0, "shrinkB": 0.0}
    panel.annotate(
        "", xy=tuple(end), xytext=tuple(start), arrowprops={**style, "color": colour, "linewidth": 2.0}, zorder=7
    )


def _text(panel: Axes, at: ArrayLike, words: str, colour: str, ha: str = "center") -> None:
    x, y = np.asarray(at)
    panel.text(x, y, words, color=colour, fontsize=13, fontweight="bold", ha=ha, va="center", zorder=9)


def _outward(parts: RobotParts) -> Points:
    """Return the unit vector from the middle of the robot towards each rail, (3, 2)."""
    away = parts.names - parts.names.mean(axis=0)
    out: Points = away / np.linalg.norm(away, axis=1, keepdims=True)
    return out


def _unit(degrees: float) -> Points:
    return np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
