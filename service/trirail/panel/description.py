"""What a tab must know of a robot to draw it and to name its buttons: from what the service tells of itself."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from trirail.client.held_jog import SPEEDS
from trirail.errors import ConfigError, ServiceError
from trirail.panel.permissions import permissions
from trirail.telemetry import palette
from trirail.telemetry.shown_robot import ShownRobot
from trirail.wire.sizes import MAX_MESSAGE
from trirail.wire.state import Info
from trirail.wire.vocabulary import Role
from trirail.workspace.part_positions import RobotParts

STAGE = 0.05
"""Whose platform goes no further along x [m] is a stage, of which tenths of a micrometre matter."""
FINE, COARSE = 4, 2
"""Decimals of millimetres; of degrees there is one more."""


def shown(info: Info) -> ShownRobot:
    """Return the robot that a service tells of. Raises ServiceError where the service is of another version."""
    try:
        return ShownRobot.of_info(info)
    except (msgspec.ValidationError, ConfigError) as error:
        raise ServiceError(f"the service is of another version, {info.version}: {error}") from error


def describe(info: Info, robot: ShownRobot, user: str, role: Role | None) -> dict[str, Any]:
    """Return what a tab must know, ready to be encoded, whose user has a role."""
    parts = RobotParts.of(robot.geometry, robot.limits.slider)
    platform = robot.limits.platform
    return {
        "tell": "robot",
        "name": info.robot,
        "user": user,
        "role": role,
        "permissions": sorted(permissions(role, Role(info.takeover))),
        "largest_file": MAX_MESSAGE,
        "version": info.version,
        "lease": info.lease,
        "tools": robot.frames.tool,
        "frames": robot.frames.work,
        "velocity": platform.velocity,
        "speeds": SPEEDS,
        "homes": info.homes,
        "sliders": robot.geometry.labels,
        "decimals": FINE if platform.x[1] - platform.x[0] <= STAGE else COARSE,
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
