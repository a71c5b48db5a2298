"""Reading of a drive's units, objects 60A8h to 60AAh and 608Fh to 6097h, and comparison with the configuration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import Key
from trirail_drivers.cia402.sdo import Remote, SdoRefused, shown
from trirail_drivers.cia402.units import (
    Unit,
    UnitBase,
    Units,
    acceleration_unit,
    parse_unit,
    position_unit,
    velocity_unit,
)
from trirail_drivers.config import Drive
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import DriveError

TOLERANCE: Final = 0.01
"""Largest relative difference between the configured counts or revolutions per metre and those of the drive."""

_IN_COUNTS: Final = {0x60A9: 0x00B5_0300, 0x60AA: 0x00B5_5700}
"""For each unit object, the code of increments per second or of increments per second squared."""
_KEYS: Final = {0x60A9: "velocity_unit", 0x60AA: "acceleration_unit"}
_POLARITIES: Final = 0xC0
"""Bits of 607Eh that reverse positions and velocities."""
_FACTORS: Final = {0x60A9: 0x6096, 0x60AA: 0x6097}
_SCALING: Final = {
    0x607E: "polarity",
    0x6089: "position notation index",
    0x608A: "position dimension index",
    0x608B: "velocity notation index",
    0x608C: "velocity dimension index",
    0x608D: "acceleration notation index",
    0x608E: "acceleration dimension index",
    0x608F: "position encoder resolution",
    0x6090: "velocity encoder resolution",
    0x6091: "gear ratio",
    0x6092: "feed constant",
    0x6093: "position factor",
    0x6094: "velocity encoder factor",
    0x6095: "velocity factor 1",
    0x6096: "velocity factor",
    0x6097: "acceleration factor",
    0x60A8: "position unit",
    0x60A9: "velocity unit",
    0x60AA: "acceleration unit",
}
"""Objects that determine the direction, the scale and the units of a drive (CiA 402-2, and its first edition)."""
_RATIOS: Final = range(0x608F, 0x6098)
"""Those of these objects that are a numerator, subindex 1, and a divisor, subindex 2."""

Scaling = Mapping[Key, int | None]
"""Values of the objects that determine the direction, the scale and the units of a drive; None for a missing one."""


async def read_units(drive: Differences, config: Drive, scale: Scale) -> Units:
    """Return the units of a drive whose positions have a `scale`. A unit that nothing defines becomes NaN.

    Raises DriveError if the drive contradicts its configuration, or if a unit in revolutions cannot be converted.
    """
    counts = abs(scale.counts_per_metre)
    revolutions = await _revolutions(drive.remote, config, counts)
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


async def read_scaling(remote: Remote) -> Scaling:
    """Return the values of the objects that determine the direction, the scale and the units of a drive."""
    values: dict[Key, int | None] = {}
    for index in _SCALING:
        for subindex in (1, 2) if index in _RATIOS else (0,):
            if subindex != 2 or await remote.has(index, 1):
                values[index, subindex] = await remote.peek(index, subindex)
    return values


def lost_settings(name: str, before: Scaling, now: Scaling) -> str:
    """Return the error message for a drive whose scaling was different `before`, or "".

    A unit in counts that the set-up itself has written may differ, since the set-up writes it again.
    """
    differing = [
        f"object {key[0]:04X}:{key[1]:02X} ({_SCALING[key[0]]}) is {_text(key, now.get(key))}, "
        f"was {_text(key, before.get(key))}"
        for key in {**before, **now}
        if now.get(key) != before.get(key) and before.get(key) != _IN_COUNTS.get(key[0], math.nan)
    ]
    if not differing:
        return ""
    return (
        f"drive {name}: the drive has lost its settings: {', '.join(differing)}; restore them and save them in the "
        "drive, or restart the service to accept the change"
    )


def _text(key: Key, value: int | None) -> str:
    if value is None:
        return "missing"
    return f"{value & 0xFF:02X}h" if key[0] == 0x607E else shown(*key, value)


async def check_polarity(remote: Remote) -> None:
    """Raise DriveError if velocities and positions have different signs, which would reverse the velocity offset."""
    polarity = await remote.peek(0x607E)
    if polarity is not None and polarity & _POLARITIES not in (0, _POLARITIES):
        raise DriveError(
            f"drive {remote.name}: object 607E:00 (polarity) is {polarity & 0xFF:02X}h: bits 7 and 6, of positions "
            f"and velocities, differ; set them alike, as with [[drives.{remote.name}.write]]"
        )


def _per_metre(unit: Unit | None, counts: float, revolutions: float | None) -> float:
    per_metre = unit.per_metre(counts, revolutions) if unit is not None else None
    return math.nan if per_metre is None else per_metre


async def _revolutions(remote: Remote, config: Drive, counts: float) -> float | None:
    """Return the revolutions per metre, from the configuration or from the drive's own objects."""
    derived, source = None, ""
    reported = await remote.peek(0x60A8)
    unit = position_unit(reported) if reported is not None else None
    if unit is not None and unit.base is UnitBase.METRES:
        _check_agreement(
            remote.name,
            "counts_per_metre",
            config.counts_per_metre,
            1.0 / unit.size,
            f"60A8 = {reported:08X}h, {unit.name}",
        )
    if unit is not None and unit.base is UnitBase.TURNS:
        derived, source = counts * unit.size, f"60A8 = {reported:08X}h, {unit.name}"
    else:
        # The feed constant is in units of position, the encoder resolution in increments (CiA 402-2).
        increments = unit is None or unit.base is UnitBase.COUNTS
        for index, name in ((0x6092, "feed constant"), *(((0x608F, "encoder resolution"),) if increments else ())):
            per_turn = await _ratio(remote, index)
            if per_turn is not None and per_turn > 1.0:  # 1 means "not used"
                gear = await _ratio(remote, 0x6091) or 1.0 if index == 0x608F else 1.0
                derived, source = counts / (per_turn * gear), f"{index:04X}, {name}, {per_turn:g} a revolution"
                break
    if config.revolutions_per_metre is None:
        return derived
    if derived is not None:
        _check_agreement(remote.name, "revolutions_per_metre", config.revolutions_per_metre, derived, source)
    return config.revolutions_per_metre


def _check_agreement(name: str, key: str, configured: float, reported: float, source: str) -> None:
    if not math.isclose(configured, reported, rel_tol=TOLERANCE):
        raise DriveError(
            f"drives.{name}.{key} = {configured:g} contradicts the drive, which has {reported:g} (object {source})"
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
    """Return the unit that the drive reports, after a comparison with the configured unit.

    If the drive reports none, return the configured unit, or None.
    """
    remote, key = drive.remote, _KEYS[index]
    text = config.velocity_unit if index == 0x60A9 else config.acceleration_unit
    configured = (
        parse_unit(f"drives.{remote.name}.{key}", text, 1 if index == 0x60A9 else 2) if text is not None else None
    )
    code = await remote.peek(index)
    reported = decoded(code) if code else None
    source = f"{index:04X} = {code:08X}h" if code else f"{_FACTORS[index]:04X}"
    if not code:
        reported = await _unit_from_factor(remote, index, velocity)
    if reported is None:
        if code and configured is None:
            raise DriveError(
                f"drive {remote.name}: object {source} is no known unit; find it in the manual, and set "
                f"drives.{remote.name}.{key}"
            )
        if configured is not None and configured.per_metre(counts, revolutions) is None:
            raise DriveError(
                f'drives.{remote.name}.{key} = "{text}" is in revolutions, whose number per metre is unknown; '
                f"set drives.{remote.name}.revolutions_per_metre"
            )
        return configured
    if configured is not None:
        one, other = (unit.per_metre(counts, revolutions) for unit in (configured, reported))
        if not (configured.is_same(reported) or (one and other and math.isclose(one, other, rel_tol=TOLERANCE))):
            raise DriveError(
                f'drives.{remote.name}.{key} = "{text}" contradicts the drive: object {source} is {reported.name}'
            )
    if reported.per_metre(counts, revolutions) is None:
        return await _switch_to_counts(drive, index, reported)
    return reported


async def _unit_from_factor(remote: Remote, index: int, velocity: Unit | None) -> Unit | None:
    """Return the unit that the factor 6096h or 6097h defines; None if it cannot be determined.

    The unit is counts per second (6096h), or the unit of velocity per second (6097h), * divisor / numerator.
    """
    factor = await _ratio(remote, _FACTORS[index])
    if factor is None:
        return None
    if index == 0x60A9:
        return Unit(UnitBase.COUNTS, 1.0 / factor, f"{1.0 / factor:g} counts/s")
    if velocity is None:
        return None
    return Unit(velocity.base, velocity.size / factor, f"{1.0 / factor:g} * {velocity.name} a second")


async def _switch_to_counts(drive: Differences, index: int, reported: Unit) -> Unit:
    """Change the drive's unit to counts, because its present unit cannot be converted to metres."""
    wanted = Unit(UnitBase.COUNTS, 1.0, "counts/s" if index == 0x60A9 else "counts/s2")
    code, remote = _IN_COUNTS[index], drive.remote
    position = await remote.peek(0x60A8)
    if position and getattr(position_unit(position), "base", None) is not UnitBase.COUNTS:
        raise DriveError(
            f"drive {remote.name}: object {index:04X} is {reported.name}, whose revolutions per metre are unknown; set "
            f"drives.{remote.name}.revolutions_per_metre"
        )
    drive.note((index, 0), await remote.peek(index), code, "its unit, since its revolutions per metre are unknown")
    try:
        await remote.write(index, 0, code)
        if (await remote.wait_until((index, 0), lambda held: held == code))[0] == code:
            return wanted
    except SdoRefused:
        pass
    raise DriveError(
        f"drive {remote.name}: object {index:04X} is {reported.name} and cannot be set to {wanted.name}; "
        f"set drives.{remote.name}.revolutions_per_metre, by the revolutions of that unit"
    )
