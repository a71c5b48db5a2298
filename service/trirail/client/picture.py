"""Presentation of a robot's state in notebooks: one line of text, or HTML with a drawing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from trirail.kinematics.geometry import Geometry
from trirail.quantities import worded
from trirail.telemetry import palette
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.palette import Colour
from trirail.wire.state import Info, State
from trirail.workspace import part_positions
from trirail.workspace.part_positions import RobotParts

WIDTH_PX = 360
"""Width of the drawing [px]."""
MARGIN = 0.08
"""Margin around the drawing, as a fraction of the robot's size."""
LINE, THICK = 0.005, 0.02
"""Widths of lines, as fractions of the robot's size."""


def line(name: str, state: State) -> str:
    """Return one line with the mode, goal, first fault and pose of a robot."""
    goal = f" to {state.goal.id}" if state.goal is not None else ""
    fault = f": {state.faults[0]}" if state.faults else ""
    return f"<Robot {name}: {state.mode}{goal}{fault}, {_measured_pose(state)}>"


def html(info: Info, state: State) -> str:
    """Return HTML with the state and a drawing of the robot."""
    robot = DrawnRobot.from_info(info)
    mode = palette.code(next(colour for mode, colour in palette.MODES.items() if str(mode) == state.mode))
    goal = f" to <b>{escape(state.goal.id)}</b>" if state.goal is not None else ""
    faults = "".join(f"<br/><b>{escape(fault)}</b>" for fault in state.faults)
    return (
        f'<div style="display:inline-block;font-family:sans-serif"><div><b>{escape(info.robot)}</b> '
        f'<span style="background:{mode};color:#fff;border-radius:3px;padding:0 6px">{escape(state.mode)}</span>'
        f"{goal}<br/>{escape(_measured_pose(state))}{faults}</div>{drawing(robot, state)}</div>"
    )


def drawing(robot: DrawnRobot, state: State) -> str:
    """Return an SVG drawing of the rails, sliders and platform, with x to the right and y upwards.

    The platform is drawn at its measured pose, unless that is unknown, and, in a pale colour, at its commanded pose.
    """
    parts = RobotParts.from_geometry(robot.geometry, robot.limits.slider)
    commanded = part_positions.transform_lines(parts.outline, state.commanded.pose)
    placed = part_positions.transform_lines(parts.outline, state.measured_pose or state.commanded.pose)
    everything = np.concatenate([parts.bounds, *placed])
    (left, bottom), (right, top) = everything.min(axis=0), everything.max(axis=0)
    size = max(right - left, top - bottom)
    edge, thin = MARGIN * size, LINE * size
    width, height = right - left + 2.0 * edge, top - bottom + 2.0 * edge
    shapes = [
        *_lines(parts.rails, [palette.FRAME] * 3, 2.0 * thin),
        *_lines(parts.travel, palette.SLIDERS, thin),
        *_lines(parts.stops, [palette.LIMIT] * 6, thin),
        *_lines(commanded, [palette.COMMANDED] * len(commanded), 4.0 * thin),
        *(_measured_shapes(robot.geometry, parts, state, size) if state.measured_pose is not None else ()),
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" '
        f'width="{WIDTH_PX}" height="{WIDTH_PX * height / width:.0f}" '
        f'viewBox="{left - edge:.6g} {-top - edge:.6g} {width:.6g} {height:.6g}">'
        f"<title>{escape(_measured_pose(state))}</title>"
        f'<g transform="scale(1 -1)" fill="none" stroke-linecap="round">{"".join(shapes)}</g></svg>'
    )


def _measured_shapes(geometry: Geometry, parts: RobotParts, state: State, size: float) -> list[str]:
    """Return the parts that move, at the measured positions, for a drawing of a robot of `size` [m]."""
    placed = part_positions.transform_lines(parts.outline, state.pose)
    pose, thin, colours = np.array([state.pose]), LINE * size, palette.SLIDERS
    carriages = part_positions.slider_points(geometry, np.array([state.sliders.position]))
    slides = part_positions.cross_slide_lines(geometry, parts, carriages, pose[:, 2])[0]
    held = part_positions.pivot_points(geometry, carriages, pose)[0]
    return [
        *_lines(list(slides), colours, THICK * size),
        *_lines(placed, [palette.ARMS] * len(placed), 2.0 * thin),
        *_lines(part_positions.transform_lines(parts.arms, state.pose), [palette.ARMS] * 3, thin),
        *(_disc(at, THICK * size, colour) for at, colour in zip(carriages[0], colours, strict=True)),
        *(_disc(at, 1.5 * thin, palette.PIN) for at in held),
        _disc(state.pose[:2], 2.5 * thin, palette.CENTRE),
    ]


def _measured_pose(state: State) -> str:
    if state.measured_pose is None:
        return "pose unknown: not homed"
    x, y, phi = state.measured_pose
    return f"x {worded(x, 'm')}, y {worded(y, 'm')}, φ {worded(phi, 'rad')}"


def _lines(lines: Iterable[NDArray[np.float64]], colours: Sequence[Colour], width: float) -> list[str]:
    shapes = []
    for points, colour in zip(lines, colours, strict=True):
        at = " ".join(f"{x:.6g},{y:.6g}" for x, y in points)
        pale = f' stroke-opacity="{colour[3] / 255.0:.2g}"' if len(colour) == 4 else ""
        shapes.append(f'<polyline points="{at}" stroke="{palette.code(colour)}" stroke-width="{width:.3g}"{pale}/>')
    return shapes


def _disc(at: Sequence[float] | NDArray[np.float64], radius: float, colour: Colour) -> str:
    x, y = at
    return f'<circle cx="{x:.6g}" cy="{y:.6g}" r="{radius:.3g}" fill="{palette.code(colour)}"/>'
