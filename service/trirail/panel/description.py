"""Description of a robot, with which a tab draws the robot and labels the page's buttons."""

from __future__ import annotations

from typing import Any

import numpy as np

from trirail.client.held_jog import SPEEDS
from trirail.panel.permissions import permissions
from trirail.telemetry import palette
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.wire.sizes import MAX_FILE
from trirail.wire.state import Info
from trirail.wire.vocabulary import Command, Role
from trirail.workspace.part_positions import RobotParts

STAGE = 0.05
"""Maximum travel of the platform along x for which the page shows lengths in micrometres [m]."""
STATE_TIMEOUT_S = 1.5
"""Minimum time without a message after which the page counts the panel's server as silent [s]."""
MICROMETRES: dict[str, Any] = {
    "unit": "µm",
    "scale": 1e6,
    "decimals": 1,
    "angle_decimals": 5,
    "steps": (1e-6, 1e-5, 1e-4, 1e-3),
    "angle_steps": (1e-4, 1e-3, 1e-2, 0.1),
}
MILLIMETRES: dict[str, Any] = {
    "unit": "mm",
    "scale": 1e3,
    "decimals": 2,
    "angle_decimals": 3,
    "steps": (1e-5, 1e-4, 1e-3, 1e-2),
    "angle_steps": (1e-2, 0.1, 1.0, 1.0),
}
"""Display of lengths in MICROMETRES or MILLIMETRES on the page.

`scale` is the number of units per metre. `decimals` applies to lengths, and `angle_decimals` to degrees. The jog steps
`steps` are in [m], and `angle_steps` in [°]."""


def describe(info: Info, robot: DrawnRobot, user: str, role: Role | None) -> dict[str, Any]:
    """Return the description of a robot for a tab, as values that can be encoded as JSON.

    `role` is the role of the user; None if the user has no role.
    """
    parts = RobotParts.from_geometry(robot.geometry, robot.limits.slider)
    platform = robot.limits.platform
    return {
        "tell": "robot",
        "name": info.robot,
        "user": user,
        "role": role,
        "permissions": sorted(permissions(role, Role(info.takeover))),
        "largest_file": MAX_FILE,
        "version": info.version,
        "lease": info.lease,
        "state_timeout": info.state_timeout(STATE_TIMEOUT_S),
        "tools": robot.frames.tool,
        "frames": robot.frames.work,
        "velocity": platform.velocity,
        "speeds": SPEEDS,
        "homes": info.homes,
        "outputs": info.outputs,
        "inputs": info.inputs,
        "sliders": robot.geometry.labels,
        "mapped": info.correction is not None and any(info.correction.greatest),
        "resolution": MICROMETRES if platform.x[1] - platform.x[0] <= STAGE else MILLIMETRES,
        "ignores_lease": [each.value for each in Command if each.ignores_lease],
        "legs": [
            {
                "anchor": leg.anchor,
                "home": leg.home,
                "rail_angle": leg.rail_angle,
                "cross_angle": leg.crossing.angle,
                "turns": leg.crossing.turns,
                "pivot": leg.crossing.point,
            }
            for leg in robot.geometry.each
        ],
        "parts": {name: _lists(getattr(parts, name)) for name in parts.__slots__},
        "colours": {
            "sliders": [palette.code(colour) for colour in palette.SLIDERS],
            "modes": {mode: palette.code(colour) for mode, colour in palette.MODES.items()},
        },
    }


def _lists(part: Any) -> Any:
    if isinstance(part, np.ndarray):
        return part.tolist()
    return [line.tolist() for line in part] if isinstance(part, list) else part
