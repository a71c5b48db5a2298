"""Checks of the configuration that are specific to ODrives."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final

from trirail_drivers.config import Drive, Drives
from trirail_drivers.driver.requirements import Requirements, Rule, resolution_rules
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES
from trirail_drivers.odrive import flat_endpoints, setup
from trirail_drivers.odrive.cansimple import MAX_FEED_FORWARD

_FLOAT_DIGITS: Final = 23
"""Number of fraction bits in an ODrive position, which is a 32-bit float."""

_CANOPEN_ONLY: Final = {
    "homing": "homing is CiA 402's, an ODrive must know its position at power-on; omit the table",
    "eds": "an ODrive has no object dictionary; omit the key",
    "write": "an ODrive has no object dictionary; omit the key",
}


def rules(drives: Drives, required: Requirements) -> Iterator[Rule]:
    """Yield checks for settings that an ODrive does not have, and for values that it cannot accept or resolve."""
    for name, drive in zip(NAMES, drives.each, strict=True):
        for key in _CANOPEN_ONLY:
            yield Rule(f"drives.{name}.{key}", (), partial(_check_canopen_only, name, drive, key))
    yield Rule("drives.velocity_offset", (), partial(_check_velocity_offset, drives))
    yield Rule("drives", tuple(f"drives.{name}.node" for name in NAMES), partial(setup.check_nodes, drives))
    for leg, (name, drive) in enumerate(zip(NAMES, drives.each, strict=True)):
        counts, scale = f"drives.{name}.counts_per_metre", (f"drives.{name}.offset", f"drives.{name}.direction")
        yield Rule(counts, scale, partial(scale_of, name, drive))
        farthest = max(abs(required.low[leg] - drive.offset), abs(required.high[leg] - drive.offset))
        yield from resolution_rules(name, drive, drives, required, farthest * 2.0**-_FLOAT_DIGITS, _offset_remedy)
        fastest = required.velocity[leg]
        yield Rule("limits.slider.velocity", (counts,), partial(_check_feed_forward, name, drive, fastest))


def files(drives: Drives) -> Iterator[Rule]:
    """Yield checks that report a missing or invalid flat_endpoints.json."""
    for name, drive in zip(NAMES, drives.each, strict=True):
        if drive.endpoints is not None:
            yield Rule(f"drives.{name}.endpoints", (), partial(flat_endpoints.read, name, Path(drive.endpoints)))


def _check_canopen_only(name: str, drive: Drive, key: str) -> None:
    value = getattr(drive, key)
    if value:
        shown = f" = {value}" if isinstance(value, str) else ""
        raise DriveError(f"drives.{name}.{key}{shown}: {_CANOPEN_ONLY[key]}")


def _check_velocity_offset(drives: Drives) -> None:
    if drives.velocity_offset != "auto":
        raise DriveError(
            f'drives.velocity_offset = "{drives.velocity_offset}": only CiA 402 drives have the velocity offset 60B1h; '
            "every setpoint of an ODrive contains a velocity; omit the key"
        )


def _offset_remedy(widest: float) -> str:
    return f"wanted an offset within {widest * 2**_FLOAT_DIGITS:g} m of the travel"


def _check_feed_forward(name: str, drive: Drive, velocity: float) -> None:
    """Check that the velocity limit fits into CANSimple's 16-bit velocity feed-forward.

    Without feed-forward, the lag of an ODrive behind its setpoint exceeds its following error window.
    """
    turns = velocity * drive.counts_per_metre
    if turns > MAX_FEED_FORWARD:
        raise DriveError(
            f"limits.slider.velocity = {velocity:g}: with drives.{name}.counts_per_metre = "
            f"{drive.counts_per_metre:g} that is {turns:g} turns/s, beyond the limit of an ODrive's feed-forward, "
            f"{MAX_FEED_FORWARD:g}; lower the velocity, or use a longer lead"
        )
