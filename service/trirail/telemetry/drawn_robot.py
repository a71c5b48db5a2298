"""Data of a robot for its drawing: from its configuration, or from its service."""

from __future__ import annotations

from dataclasses import dataclass

from trirail import config
from trirail.config import Config, FramesTable, Limits
from trirail.config.tables import GeometryTable
from trirail.kinematics.geometry import Geometry
from trirail.wire.decoding import converted, prepare
from trirail.wire.state import Info

prepare(GeometryTable)


@dataclass(frozen=True, slots=True)
class DrawnRobot:
    """Data of a robot for its drawing."""

    name: str
    geometry: Geometry
    limits: Limits
    rate_hz: int
    frames: FramesTable

    @classmethod
    def from_config(cls, settings: Config) -> DrawnRobot:
        """Return the robot of a configuration."""
        return cls(
            settings.robot.name,
            config.geometry(settings.geometry),
            settings.limits,
            settings.loop.rate_hz,
            settings.frames,
        )

    @classmethod
    def from_info(cls, info: Info) -> DrawnRobot:
        """Return the robot of a service. Raises msgspec.ValidationError or ConfigError if its version differs."""
        each = [_leg(leg) for leg in info.geometry]
        legs = converted({"kind": info.mechanism, "leg": each, "labels": info.labels}, GeometryTable)
        limits, frames = converted(info.limits, Limits), converted(info.frames, FramesTable)
        return cls(info.robot, config.geometry(legs), limits, info.rate_hz, frames)


def _leg(table: dict[str, object]) -> dict[str, object]:
    return {name: value for name, value in table.items() if name != "name"}
