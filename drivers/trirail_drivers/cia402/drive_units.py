"""Asks a drive for its units, and holds them against the configuration: 60A8h to 60AAh, 608Fh to 6097h."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.sdo import Remote, SdoRefused
from trirail_drivers.cia402.units import Of, Unit, Units, acceleration_unit, position_unit, velocity_unit, written
from trirail_drivers.config import Drive
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import DriveError

TOLERANCE: Final = 0.01
"""By so much a measured number of counts or revolutions per metre may differ from the drive's own."""

_IN_COUNTS: Final = {0x60A9: 0x00B5_0300, 0x60AA: 0x00B5_5700}
"""Increments per second, and per second squared."""
_KEYS: Final = {0x60A9: "velocity_unit", 0x60AA: "acceleration_unit"}
_FACTORS: Final = {0x60A9: 0x6096, 0x60AA: 0x6097}


async def read_units(drive: Differences, config: Drive, scale: Scale) -> Units:
    """The units of a drive whose positions have a `scale`.

    Raises DriveError where the drive contradicts its configuration, or where neither says what a unit is that is
    needed here: that of the velocity offset, or of the quick-stop ramp.
    """
    remote, counts = drive.remote, abs(scale.counts_per_metre)
    revolutions = await _revolutions(remote, config, counts)
    velocity = await _unit(drive, config, 0x60A9, counts, revolutions, velocity_unit)
    acceleration = await _unit(drive, config, 0x60AA, counts, revolutions, acceleration_unit, velocity)
    per_metre = [_per_metre(each, counts, revolutions) for each in (velocity, acceleration)]
    return Units(
        scale,
        math.copysign(per_metre[0], scale.counts_per_metre),
        per_metre[1],
        velocity.name if velocity else "",
        acceleration.name if acceleration else "",
    )


def _per_metre(unit: Unit | None, counts: float, revolutions: float | None) -> float:
    found = unit.per_metre(counts, revolutions) if unit is not None else None
    return math.nan if found is None else found


async def _revolutions(remote: Remote, config: Drive, counts: float) -> float | None:
    """Revolutions per metre, as configured or as the drive's own objects have it."""
    derived, source = None, ""
    told = await remote.peek(0x60A8)
    unit = position_unit(told) if told is not None else None
    if unit is not None and unit.of is Of.METRES:
        _agree(
            remote.name,
            "counts_per_metre",
            config.counts_per_metre,
            1.0 / unit.size,
            f"60A8 = {told:08X}h, {unit.name}",
        )
    elif unit is not None and unit.of is Of.TURNS:
        derived, source = counts * unit.size, f"60A8 = {told:08X}h, {unit.name}"
    else:
        for index, name in ((0x6092, "feed constant"), (0x608F, "encoder resolution")):
            per_turn = await _ratio(remote, index)
            if per_turn is not None and per_turn > 1.0:  # 1 stands for "not used"
                gear = await _ratio(remote, 0x6091) or 1.0 if index == 0x608F else 1.0
                derived, source = counts / (per_turn * gear), f"{index:04X}, {name}, {per_turn:g} a revolution"
                break
    if config.revolutions_per_metre is None:
        return derived
    if derived is not None:
        _agree(remote.name, "revolutions_per_metre", config.revolutions_per_metre, derived, source)
    return config.revolutions_per_metre


def _agree(name: str, key: str, configured: float, told: float, source: str) -> None:
    if not math.isclose(configured, told, rel_tol=TOLERANCE):
        raise DriveError(
            f"drives.{name}.{key} = {configured:g} contradicts the drive, by which it is {told:g} (object {source})"
        )


async def _ratio(remote: Remote, index: int) -> float | None:
    above, below = await remote.peek(index, 1), await remote.peek(index, 2)
    return above / below if above and below else None


async def _unit(
    drive: Differences,
    config: Drive,
    index: int,
    counts: float,
    revolutions: float | None,
    decoded: Callable[[int], Unit | None],
    velocity: Unit | None = None,
) -> Unit | None:
    """What the drive says, held against the configuration, or else what that says; None where nobody does."""
    remote, key = drive.remote, _KEYS[index]
    text = config.velocity_unit if index == 0x60A9 else config.acceleration_unit
    configured = written(f"drives.{remote.name}.{key}", text, 1 if index == 0x60A9 else 2) if text is not None else None
    code = await remote.peek(index)
    told = decoded(code) if code else None
    source = f"{index:04X} = {code:08X}h" if told is not None and code is not None else f"{_FACTORS[index]:04X}"
    if told is None:
        told = await _by_factor(remote, index, velocity)
    if told is None:
        if configured is not None and configured.per_metre(counts, revolutions) is None:
            raise DriveError(
                f'drives.{remote.name}.{key} = "{text}" is of revolutions, and nobody says how many a metre takes: '
                f"say drives.{remote.name}.revolutions_per_metre"
            )
        return configured
    if configured is not None:
        one, other = (unit.per_metre(counts, revolutions) for unit in (configured, told))
        if not (configured.same(told) or (one and other and math.isclose(one, other, rel_tol=TOLERANCE))):
            raise DriveError(
                f'drives.{remote.name}.{key} = "{text}" contradicts the drive: object {source} is {told.name}'
            )
    if told.per_metre(counts, revolutions) is None:
        return await _in_counts(drive, index, told)
    return told


async def _by_factor(remote: Remote, index: int, velocity: Unit | None) -> Unit | None:
    """The unit that 6096h or 6097h makes: counts a second, or velocity a second, * numerator / divisor."""
    factor = await _ratio(remote, _FACTORS[index])
    if factor is None:
        return None
    if index == 0x60A9:
        return Unit(Of.COUNTS, 1.0 / factor, f"{1.0 / factor:g} counts/s")
    if velocity is None:
        return None
    return Unit(velocity.of, velocity.size / factor, f"{1.0 / factor:g} * {velocity.name} a second")


async def _in_counts(drive: Differences, index: int, told: Unit) -> Unit:
    """Set the unit to counts, where nobody says what the drive's own is of a metre."""
    wanted = Unit(Of.COUNTS, 1.0, "counts/s" if index == 0x60A9 else "counts/s2")
    code, remote = _IN_COUNTS[index], drive.remote
    drive.note((index, 0), await remote.peek(index), code, "its unit, for nobody says its revolutions per metre")
    try:
        await remote.write(index, 0, code)
        if (await remote.becomes((index, 0), lambda held: held == code))[0] == code:
            return wanted
    except SdoRefused:
        pass
    raise DriveError(
        f"drive {remote.name}: object {index:04X} is {told.name} and cannot be set to {wanted.name}; "
        f"say drives.{remote.name}.revolutions_per_metre, the revolutions by which it counts that"
    )
