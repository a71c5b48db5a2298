"""Refuses settings of drives that no drive could carry out, before one is asked: which, and what would be right."""

from __future__ import annotations

from typing import Final, NamedTuple

from trirail_drivers.cia402 import settings
from trirail_drivers.config import Drive, Drives
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES
from trirail_drivers.odrive import setup
from trirail_drivers.odrive.frames import MAX_FEED_FORWARD
from trirail_drivers.scaling import INT32_MAX, Scale, scale_of

FINE_ENOUGH: Final = 10
"""So many steps of a drive's position the following error must have, lest rounding alone be a fault."""
_FLOAT_DIGITS: Final = 23
"""Binary digits of an ODrive's position after the first, a 32-bit float."""


class Motion(NamedTuple):
    """What the drives are to be able to do."""

    period: float
    """Of the cycle [s]."""
    low: float
    high: float
    """Travel of the sliders [m]."""
    velocity: float
    """Of the sliders at most [m/s]."""
    following_error: float
    """Beyond which the service stops everything [m]."""


def check(drives: Drives, motion: Motion) -> None:
    """Refuse what a drive cannot be told, take or resolve. Raises DriveError with the key."""
    if drives.heartbeat < motion.period:
        raise DriveError(
            f"drives.heartbeat = {drives.heartbeat:g}: heartbeats go out with the cycle; "
            f"wanted at least its period, {motion.period:g} s"
        )
    if drives.protocol == "cia402":
        settings.check_nodes(drives)
    else:
        setup.check_nodes(drives)
    for name, drive in zip(NAMES, drives.each, strict=True):
        scale = scale_of(name, drive)
        _check_resolution(name, drive, drives, motion)
        if drives.protocol == "cia402":
            _check_counts(name, drive, scale, motion)
            settings.settings_of(name, drive, drives, scale, motion.period)
        else:
            _check_feed_forward(name, drive, motion)


def _check_resolution(name: str, drive: Drive, drives: Drives, motion: Motion) -> None:
    """Limits must be several steps of the position wide: rounding alone is no fault, nor a jump."""
    step = 1.0 / drive.counts_per_metre
    if drives.protocol == "odrive":
        farthest = max(abs(motion.low - drive.offset), abs(motion.high - drive.offset))
        step = farthest * 2.0**-_FLOAT_DIGITS
    limits = (
        ("limits.slider.following_error", "m", motion.following_error, FINE_ENOUGH),
        ("drives.following_error", "m", drives.following_error, FINE_ENOUGH),
        ("limits.slider.velocity", "m in a cycle", motion.velocity * motion.period, 1),
    )
    for key, unit, limit, steps in limits:
        if step * steps > limit:
            if drives.protocol == "odrive":
                remedy = f"wanted an offset nearer to the travel than {limit / steps * 2**_FLOAT_DIGITS:g} m"
            else:
                remedy = f"wanted counts_per_metre of at least {steps / limit:g}"
            raise DriveError(
                f"drives.{name}.counts_per_metre = {drive.counts_per_metre:g}, offset = {drive.offset:g}: the position "
                f"goes in steps of {step:g} m, too coarse for {key}, {limit:g} {unit}; {remedy}"
            )


def _check_counts(name: str, drive: Drive, scale: Scale, motion: Motion) -> None:
    """Setpoints, positions and feed-forward are 32-bit integers."""
    reach = max(abs(scale.exact(motion.low)), abs(scale.exact(motion.high)))
    # A position may be a following error beyond the travel, and a velocity a little beyond its limit.
    if reach + drive.counts_per_metre * motion.following_error >= INT32_MAX:
        raise DriveError(
            f"drives.{name}.counts_per_metre = {drive.counts_per_metre:g}, offset = {drive.offset:g}: "
            f"limits.slider.position = [{motion.low:g}, {motion.high:g}] is {reach:g} counts, and a drive takes "
            f"{INT32_MAX}; wanted fewer counts, or an offset nearer to the travel"
        )
    if 2.0 * motion.velocity * drive.counts_per_metre >= INT32_MAX:
        raise DriveError(
            f"drives.{name}.counts_per_metre = {drive.counts_per_metre:g}: limits.slider.velocity = "
            f"{motion.velocity:g} is {motion.velocity * drive.counts_per_metre:g} counts/s, and twice that must be "
            f"below {INT32_MAX}; wanted at most {INT32_MAX / (2.0 * motion.velocity):.4g} counts_per_metre"
        )


def _check_feed_forward(name: str, drive: Drive, motion: Motion) -> None:
    """CANSimple has 16 bits for the velocity feed-forward; without it an ODrive lags out of its window."""
    turns = motion.velocity * drive.counts_per_metre
    if turns > MAX_FEED_FORWARD:
        raise DriveError(
            f"limits.slider.velocity = {motion.velocity:g}: with drives.{name}.counts_per_metre = "
            f"{drive.counts_per_metre:g} that is {turns:g} turns/s, and an ODrive's feed-forward ends at "
            f"{MAX_FEED_FORWARD:g}; lower the velocity, or use a longer lead"
        )
