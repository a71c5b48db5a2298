"""What a client is told of the robot when it asks: from the configuration and the software that runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
from trirail_drivers.interface import NAMES

from trirail.config import Config, as_built, geometry
from trirail.telemetry.provenance import software, versions
from trirail.wire.state import Info


def info(config: Config) -> Info:
    """Return what a service of this configuration answers on …/info."""
    live = config.telemetry.live_port
    legs: list[dict[str, Any]] = []
    for name, leg in zip(NAMES, geometry(config.geometry).each, strict=True):
        legs.append({"name": name} | leg.keys())
    return Info(
        robot=config.robot.name,
        version=software().trirail,
        geometry=tuple(legs),
        mechanism=config.geometry.kind,
        labels=config.geometry.labels,
        limits=msgspec.to_builtins(config.limits),
        frames=msgspec.to_builtins(config.frames),
        rate_hz=config.loop.rate_hz,
        state_hz=config.telemetry.state_hz,
        recordings=str(Path(config.telemetry.directory).resolve()),
        live=f"rerun+http://127.0.0.1:{live}/proxy" if live else "",
        lease=config.control.lease,
        takeover=config.control.takeover.value,
        homes=tuple(name for name, drive in zip(NAMES, config.drives.each, strict=True) if drive.homing is not None),
        versions=versions(),
        correction=as_built.summary(config.correction.map, config.correction.as_built, config.correction.backlash),
    )
