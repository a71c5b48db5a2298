"""Refuses settings that no CiA 402 drive could carry out."""

from __future__ import annotations

from trirail_drivers.cia402 import makers_objects, settings, units
from trirail_drivers.config import Drive, Drives
from trirail_drivers.driver.requirements import Requirements, check_resolution
from trirail_drivers.driver.scaling import INT32_MAX, Scale, scale_of
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES


def check(drives: Drives, required: Requirements) -> None:
    """Refuse what a drive cannot be told, take or resolve. Raises DriveError with the key."""
    settings.check_nodes(drives)
    for name, drive in zip(NAMES, drives.each, strict=True):
        scale = scale_of(name, drive)
        check_resolution(name, drive, drives, required, 1.0 / drive.counts_per_metre, _finer)
        _check_counts(name, drive, scale, required)
        units.check(name, drive)
        makers_objects.check(name, drive)
        _check_velocity(name, drive, required)
        units.Units(scale, scale.counts_per_metre, 1.0).length(name, "following_error", drives.following_error)
    settings.heartbeat_of(drives)
    settings.interpolation_periods(required.period)


def _check_velocity(name: str, drive: Drive, required: Requirements) -> None:
    """Feed-forward in the unit that is configured, where that is known of a metre, is a 32-bit integer, and not 0."""
    key = f"drives.{name}.velocity_unit"
    unit = units.written(key, drive.velocity_unit, 1) if drive.velocity_unit is not None else None
    per_metre = unit.per_metre(drive.counts_per_metre, drive.revolutions_per_metre) if unit is not None else None
    if per_metre is not None and (why := units.unfit(required.velocity, per_metre)):
        raise DriveError(f'{key} = "{drive.velocity_unit}": {why}')


def _finer(widest: float) -> str:
    return f"wanted counts_per_metre of at least {1.0 / widest:g}"


def _check_counts(name: str, drive: Drive, scale: Scale, required: Requirements) -> None:
    """Setpoints, positions and feed-forward are 32-bit integers."""
    reach = max(abs(scale.exact(required.low)), abs(scale.exact(required.high)))
    # A position may be a following error beyond the travel, and a velocity a little beyond its limit.
    if reach + drive.counts_per_metre * required.following_error >= INT32_MAX:
        raise DriveError(
            f"drives.{name}.counts_per_metre = {drive.counts_per_metre:g}, offset = {drive.offset:g}: "
            f"limits.slider.position = [{required.low:g}, {required.high:g}] is {reach:g} counts, and a drive takes "
            f"{INT32_MAX}; wanted fewer counts, or an offset nearer to the travel"
        )
    if 2.0 * required.velocity * drive.counts_per_metre >= INT32_MAX:
        raise DriveError(
            f"drives.{name}.counts_per_metre = {drive.counts_per_metre:g}: limits.slider.velocity = "
            f"{required.velocity:g} is {required.velocity * drive.counts_per_metre:g} counts/s, and twice that must be "
            f"below {INT32_MAX}; wanted at most {INT32_MAX / (2.0 * required.velocity):.4g} counts_per_metre"
        )
