"""Refuses settings that no ODrive could carry out."""

from __future__ import annotations

from typing import Final

from trirail_drivers.config import Drive, Drives
from trirail_drivers.driver.requirements import Requirements, check_resolution
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES
from trirail_drivers.odrive import setup
from trirail_drivers.odrive.frames import MAX_FEED_FORWARD

_FLOAT_DIGITS: Final = 23
"""Binary digits of an ODrive's position after the first, a 32-bit float."""


def check(drives: Drives, required: Requirements) -> None:
    """Refuse what a drive has not, cannot be told or cannot resolve. Raises DriveError with the key."""
    for name, drive in zip(NAMES, drives.each, strict=True):
        _check_canopen_only(name, drive)
    setup.check_nodes(drives)
    for name, drive in zip(NAMES, drives.each, strict=True):
        scale_of(name, drive)
        farthest = max(abs(required.low - drive.offset), abs(required.high - drive.offset))
        check_resolution(name, drive, drives, required, farthest * 2.0**-_FLOAT_DIGITS, _nearer)
        _check_feed_forward(name, drive, required)


def _check_canopen_only(name: str, drive: Drive) -> None:
    if drive.homing is not None:
        raise DriveError(
            f"drives.{name}.homing: homing is CiA 402's, an ODrive must know its position at power-on; "
            "leave the table out"
        )
    if drive.eds is not None:
        raise DriveError(f"drives.{name}.eds = {drive.eds}: an ODrive has no object dictionary; leave it out")
    if drive.write:
        raise DriveError(f"drives.{name}.write: an ODrive has no object dictionary; leave it out")


def _nearer(widest: float) -> str:
    return f"wanted an offset nearer to the travel than {widest * 2**_FLOAT_DIGITS:g} m"


def _check_feed_forward(name: str, drive: Drive, required: Requirements) -> None:
    """CANSimple has 16 bits for the velocity feed-forward; without it an ODrive lags out of its window."""
    turns = required.velocity * drive.counts_per_metre
    if turns > MAX_FEED_FORWARD:
        raise DriveError(
            f"limits.slider.velocity = {required.velocity:g}: with drives.{name}.counts_per_metre = "
            f"{drive.counts_per_metre:g} that is {turns:g} turns/s, and an ODrive's feed-forward ends at "
            f"{MAX_FEED_FORWARD:g}; lower the velocity, or use a longer lead"
        )
