"""Data needed to draw a robot, taken from a configuration or from a running service."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import NAMES, Triple

from trirail import config
from trirail.config import Config, FramesTable, Limits
from trirail.config.tables import GeometryTable
from trirail.errors import ConfigError, ServiceError
from trirail.kinematics.geometry import Geometry
from trirail.motion.backlash_reserve import planned_limits
from trirail.wire.decoding import converted, prepare
from trirail.wire.state import Info

prepare(GeometryTable)

DIGITAL = "/signals"
"""Parent entity of outputs and inputs. Views sort their lanes by name; this name puts the lane of the mode first."""


NO_BACKLASH: Triple = (0.0, 0.0, 0.0)


class DigitalSignal(NamedTuple):
    """Digital output or input, and the position of its bit in the record of a cycle."""

    kind: Literal["output", "input"]
    name: str
    axis: int
    mask: int
    """Bit mask of the signal in the output or input word of its drive."""

    @property
    def path(self) -> str:
        """Entity path of the signal's values."""
        return f"{DIGITAL}/{self.kind}s/{self.name}"

    def values(self, records: NDArray[np.void]) -> NDArray[np.bool_]:
        """Return the value of the signal in each record, (N,)."""
        on: NDArray[np.bool_] = records[f"{self.kind}s"][:, self.axis] & self.mask != 0
        return on


@dataclass(frozen=True, slots=True)
class DrawnRobot:
    """Data needed to draw a robot."""

    name: str
    geometry: Geometry
    limits: Limits
    rate_hz: int
    frames: FramesTable
    digital: tuple[DigitalSignal, ...] = ()
    """Digital outputs, followed by digital inputs."""
    backlash: Triple = NO_BACKLASH
    """Compensated backlash of the sliders A, B, C [m]."""

    @property
    def planned_limits(self) -> Limits:
        """Limits that the service applies to goals."""
        return planned_limits(self.limits, self.backlash)

    @classmethod
    def from_config(cls, settings: Config) -> DrawnRobot:
        """Return the data of the robot that a configuration describes."""
        outputs = [_signal("output", name, each.drive, each.bit) for name, each in settings.outputs.items()]
        inputs = [_signal("input", name, each.drive, each.bit) for name, each in settings.inputs.items()]
        return cls(
            settings.robot.name,
            config.geometry(settings.geometry),
            settings.limits,
            settings.loop.rate_hz,
            settings.frames,
            (*outputs, *inputs),
            settings.correction.backlash,
        )

    @classmethod
    def from_info(cls, info: Info) -> DrawnRobot:
        """Return the data of a service's robot, given the description that the service sends.

        Raises ServiceError if the service has an incompatible version.
        """
        each = [_leg(leg) for leg in info.geometry]
        try:
            legs = converted({"kind": info.mechanism, "leg": each, "labels": info.labels}, GeometryTable)
            limits, frames = converted(info.limits, Limits), converted(info.frames, FramesTable)
            geometry = config.geometry(legs)
        except (msgspec.ValidationError, ConfigError) as error:
            raise ServiceError(f"the service has another version, {info.version}: {error}") from error
        outputs = [_signal("output", name, line.drive, line.bit) for name, line in info.output_lines.items()]
        inputs = [_signal("input", name, line.drive, line.bit) for name, line in info.input_lines.items()]
        digital = *outputs, *inputs
        backlash = info.correction.backlash if info.correction is not None else NO_BACKLASH
        return cls(info.robot, geometry, limits, info.rate_hz, frames, digital, backlash)


def _signal(kind: Literal["output", "input"], name: str, drive: str, bit: int) -> DigitalSignal:
    return DigitalSignal(kind, name, NAMES.index(drive), 1 << bit)


def _leg(table: dict[str, object]) -> dict[str, object]:
    """Return the keys of a leg in a configuration."""
    keys = {name: value for name, value in table.items() if name != "name"}
    angle = keys.get("slide_angle")
    if isinstance(angle, float) and abs(angle) > 2.0 * math.pi:
        del keys["slide_angle"]  # no configuration accepts it: it is the default for a rail_angle above 270°
    return keys
