"""Checks of the configuration that are specific to CiA 402 drives."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from trirail_drivers.cia402 import eds, makers_objects, settings, units
from trirail_drivers.config import Drive, Drives
from trirail_drivers.driver.requirements import Requirements, Rule, resolution_rules
from trirail_drivers.driver.scaling import INT32_MAX, scale_of
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES


def rules(drives: Drives, required: Requirements) -> Iterator[Rule]:
    """Yield checks for settings that a drive does not have, and for values that it cannot accept or resolve."""
    nodes = tuple(f"drives.{name}.node" for name in NAMES)
    yield Rule("drives.master_node", nodes, partial(settings.check_nodes, drives))
    for name, drive in zip(NAMES, drives.each, strict=True):
        table = f"drives.{name}"
        counts, scale = f"{table}.counts_per_metre", (f"{table}.offset", f"{table}.direction")
        yield Rule(counts, scale, partial(scale_of, name, drive))
        yield from resolution_rules(name, drive, drives, required, 1.0 / drive.counts_per_metre, _counts_remedy)
        limits = "limits.slider", "can.simulated.start"
        yield Rule(counts, (*scale, *limits), partial(_check_counts, name, drive, required))
        for key in ("velocity_unit", "acceleration_unit"):
            yield Rule(f"{table}.{key}", (), partial(units.check, name, drive, key))
        yield Rule(f"{table}.endpoints", (), partial(_check_endpoints, name, drive))
        for number in range(len(drive.write)):
            yield Rule(f"{table}.write[{number}]", (), partial(makers_objects.check, name, drive, number))
        reads = counts, f"{table}.revolutions_per_metre", "limits.slider.velocity"
        yield Rule(f"{table}.velocity_unit", reads, partial(_check_velocity, name, drive, required))
        yield Rule("drives.following_error", (counts, *scale), partial(_check_window, name, drive, drives))
    yield Rule("drives.heartbeat", (), partial(settings.heartbeat_period_ms, drives))
    yield Rule("loop.rate_hz", (), partial(settings.interpolation_periods, required.period))


def files(drives: Drives) -> Iterator[Rule]:
    """Yield checks that report a missing or invalid EDS."""
    for name, drive in zip(NAMES, drives.each, strict=True):
        if drive.eds is not None:
            yield Rule(f"drives.{name}.eds", (), partial(_check_eds, name, drive))


def _check_eds(name: str, drive: Drive) -> None:
    try:
        eds.load(name, Path(drive.eds or ""), drive.node)
    except DriveError as error:
        raise DriveError(
            f"drives.{name}.eds = {drive.eds!r}: {error}; correct the name or the file, or omit the key"
        ) from error


def _check_endpoints(name: str, drive: Drive) -> None:
    if drive.endpoints is not None:
        raise DriveError(f"drives.{name}.endpoints = {drive.endpoints}: only ODrives have endpoints; omit the key")


def _check_window(name: str, drive: Drive, drives: Drives) -> None:
    """Check that the drive's following error window fits into 32 bits."""
    scale = scale_of(name, drive)
    units.Units(scale, scale.counts_per_metre, 1.0).length(name, "following_error", drives.following_error)


def _check_velocity(name: str, drive: Drive, required: Requirements) -> None:
    """Check that the velocity limit is a non-zero 32-bit integer in the configured unit."""
    key = f"drives.{name}.velocity_unit"
    unit = units.parse_unit(key, drive.velocity_unit, 1) if drive.velocity_unit is not None else None
    per_metre = unit.per_metre(drive.counts_per_metre, drive.revolutions_per_metre) if unit is not None else None
    if per_metre is not None and (why := units.velocity_misfit(required.velocity[NAMES.index(name)], per_metre)):
        raise DriveError(f'{key} = "{drive.velocity_unit}": {why}')


def _counts_remedy(widest: float) -> str:
    return f"expected counts_per_metre of at least {1.0 / widest:g}"


def _check_counts(name: str, drive: Drive, required: Requirements) -> None:
    """Check that setpoints, positions and feed-forward fit into 32-bit integers."""
    scale, leg = scale_of(name, drive), NAMES.index(name)
    low, high, velocity = required.low[leg], required.high[leg], required.velocity[leg]
    reach = max(abs(scale.exact(low)), abs(scale.exact(high)))
    # A position may exceed the travel by the following error, and a velocity may slightly exceed its limit.
    if reach + drive.counts_per_metre * required.following_error >= INT32_MAX:
        raise DriveError(
            f"drives.{name}.counts_per_metre = {drive.counts_per_metre:g}, offset = {drive.offset:g}: "
            f"limits.slider.position = [{low:g}, {high:g}] is {reach:g} counts, beyond a drive's limit of "
            f"{INT32_MAX}; use fewer counts, or an offset nearer to the travel"
        )
    if 2.0 * velocity * drive.counts_per_metre >= INT32_MAX:
        raise DriveError(
            f"drives.{name}.counts_per_metre = {drive.counts_per_metre:g}: limits.slider.velocity = "
            f"{velocity:g} is {velocity * drive.counts_per_metre:g} counts/s, more than half of {INT32_MAX}; "
            f"use at most {INT32_MAX / (2.0 * velocity):.4g} counts_per_metre"
        )
