"""Values that the objects of a CiA 402 drive must have before the cycle runs, and the accepted alternatives."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Final

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import Key, title
from trirail_drivers.cia402.sdo import SdoRefused, same
from trirail_drivers.cia402.units import Units
from trirail_drivers.config import Drives, Homing
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import ConfigurationRefused, DriveError
from trirail_drivers.interface import NAMES

PREFERRED_EXPONENT: Final = -3
"""Exponent of 60C2h for milliseconds, which every drive accepts. Some drives accept no other exponent."""


def interpolation_periods(period: float) -> list[tuple[int, int]]:
    """Return the pairs of a value and an exponent of ten for object 60C2h that equal `period` [s], milliseconds first.

    Raises DriveError if no pair equals the period.
    """
    if candidates := _value_and_exponents(period):
        return sorted(candidates, key=lambda each: (each[1] != PREFERRED_EXPONENT, -each[1]))
    rates = (2**twos * 5**fives for twos in range(7) for fives in range(7))  # their cycles are whole microseconds
    possible = [rate for rate in rates if _value_and_exponents(1.0 / rate)]
    nearest = min(possible, key=lambda rate: abs(math.log(rate * period)))
    raise DriveError(
        f"a cycle of {period:g} s ({1 / period:g} Hz) is not possible: object 60C2h accepts "
        f"1 to 255 times a power of ten, from 1 us; set loop.rate_hz = {nearest}, the nearest"
    )


def _value_and_exponents(period: float) -> list[tuple[int, int]]:
    """Return the pairs of a value and an exponent of ten for object 60C2h that equal `period` [s]."""
    return [
        (round(period * 10**-exponent), exponent)
        for exponent in range(0, -7, -1)
        if math.isclose(round(period * 10**-exponent) * 10.0**exponent, period, rel_tol=1e-9)
        and 1 <= round(period * 10**-exponent) <= 255
    ]


def check_nodes(drives: Drives) -> None:
    """Raise DriveError for node ids that are not valid in CANopen, or that two nodes share."""
    nodes = {f"drives.{name}.node": drive.node for name, drive in zip(NAMES, drives.each, strict=True)}
    nodes["drives.master_node"] = drives.master_node
    for key, node in nodes.items():
        if node == 0:
            raise DriveError(f"{key} = 0: on CANopen, 0 addresses all nodes; use 1 to 127")
    if len(set(nodes.values())) < len(nodes):
        listed = ", ".join(f"{key} = {node}" for key, node in nodes.items())
        raise DriveError(f"node ids must differ, but are {listed}")


def heartbeat_period_ms(drives: Drives) -> int:
    """Return the heartbeat period [ms]. Raises DriveError if a drive cannot accept it."""
    heartbeat = round(1000 * drives.heartbeat)
    if not 1 <= 3 * heartbeat <= 0xFFFF or heartbeat < 1:
        raise DriveError(f"drives.heartbeat = {drives.heartbeat:g} s: a drive accepts 0.001 to 21.845 s")
    return heartbeat


async def configure_cycle_period(drive: Differences, period: float) -> None:
    """Configure the cycle period [s] (1006h, 60C2h), and a SYNC without extras (1005h, 1007h, 1019h)."""
    for key, wanted in PLAIN_SYNC:
        await _configure_sync(drive, key, wanted)
    await drive.ensure(0x1006, 0, round(1e6 * period))
    await _configure_interpolation(drive, interpolation_periods(period))


PLAIN_SYNC: Final = (
    ((0x1005, 0), 0x80),  # bit 30: the drive would send SYNC itself
    ((0x1007, 0), 0),  # setpoints and positions outside this window are dropped
    ((0x1019, 0), 0),  # a drive that expects a counter answers a SYNC without one with EMCY 8240h
)
"""SYNC objects that another master may have changed, and their required values."""


async def _configure_sync(drive: Differences, key: Key, wanted: int) -> None:
    remote = drive.remote
    current = await remote.peek(*key)
    if current is None or same(*key, current, wanted):
        return
    if key == (0x1019, 0) and await remote.peek(0x1006):
        with suppress(SdoRefused):
            await remote.write(0x1006, 0, 0)  # CiA 301: the counter may change only while the period is 0
            await remote.wait_until((0x1006, 0), lambda held: held == 0)
    await drive.ensure(*key, wanted)


async def _configure_interpolation(drive: Differences, periods: list[tuple[int, int]]) -> None:
    remote = drive.remote
    if not (await remote.has(0x60C2, 1) and await remote.has(0x60C2, 2)):
        drive.lack((0x60C2, 1), "it has no such object")
        return
    held = await remote.peek(0x60C2, 1), await remote.peek(0x60C2, 2)
    if held in periods:
        return
    refusal: SdoRefused | ConfigurationRefused | None = None
    for value, exponent in periods:
        try:
            for key, wanted in (((0x60C2, 2), exponent), ((0x60C2, 1), value)):
                if (current := await remote.peek(*key)) != wanted:
                    await drive.put(key, current, wanted)
        except (SdoRefused, ConfigurationRefused) as error:
            refusal = error
            continue
        return
    if refusal is not None:
        refusal.args = (f"{refusal}{_rate_that_it_holds(*held)}",)
        raise refusal


def _rate_that_it_holds(value: int | None, exponent: int | None) -> str:
    """Return the remedy for a drive that does not accept an interpolation time; "" if it does not report its time."""
    if not value or exponent is None:
        return ""
    period = value * 10.0**exponent
    return f"; it holds {1000 * period:g} ms: set loop.rate_hz = {1 / period:g}"


DISABLE_VOLTAGE_OPTION: Final = 2
"""Value of 6007h with which a drive that has lost its master removes power without a ramp."""
DISABLE_DRIVE_OPTION: Final = 0
"""Value of 605Eh with which a drive in fault removes power without a ramp."""
BRAKING_HALTS: Final = (1, 2, 3, 4)
"""Values of 605Dh with which a drive brakes when a homing is halted; with others, it may coast."""
MAX_FOLLOWING_TIMEOUT_MS: Final = 100
"""Maximum time for which a following error may exceed its window before the drive reacts [ms]."""


async def configure_reactions(drive: Differences, drives: Drives, units: Units) -> None:
    """Configure the drive's reactions to faults: 6007h, 605Ah, 605Eh, 6065h, 6066h, 6085h."""
    name = drive.remote.name
    # 6007h = 3: a drive without its master makes a quick stop. A fault (1), which has the ramp of 605Eh, is also
    # accepted, and finally the removal of power (2).
    if await drive.ensure(0x6007, 0, 3, also=(1, 2)) == DISABLE_VOLTAGE_OPTION:
        drive.add_note(f"{title((0x6007, 0))} accepts neither 3 nor 1: without this service, the drive coasts")
    await drive.ensure(0x605A, 0, 2)  # quick stop: follow the ramp 6085h, then remove power
    # 605Eh = 2: after a fault, the drive follows the quick-stop ramp. Another ramp (1) or coasting (0) is accepted.
    if await drive.ensure(0x605E, 0, 2, also=(1, 0)) == DISABLE_DRIVE_OPTION:
        drive.add_note(f"{title((0x605E, 0))} accepts neither 2 nor 1: after a fault, the drive coasts")
    if await drive.remote.has(0x6085):
        ramp = units.acceleration(name, "quick_stop_deceleration", drives.quick_stop_deceleration)
        await drive.ensure(0x6085, 0, ramp)
    else:
        drive.lack((0x6085, 0), "it has no such object")
    await drive.ensure(0x6065, 0, units.length(name, "following_error", drives.following_error))
    await drive.ensure_at_most((0x6066, 0), MAX_FOLLOWING_TIMEOUT_MS)


async def configure_homing(drive: Differences, homing: Homing, units: Units) -> None:
    """Configure the drive's homing: 605Dh, 6098h, 6099h, 609Ah, 607Ch."""
    name = drive.remote.name
    halt = await drive.remote.peek(0x605D)
    if halt not in BRAKING_HALTS:
        try:
            await drive.ensure(0x605D, 0, BRAKING_HALTS[0], also=BRAKING_HALTS[1:])
        except ConfigurationRefused as error:
            drive.lack((0x605D, 0), f"it keeps {halt}", error)
    await drive.ensure(0x6098, 0, homing.method)
    await drive.ensure(0x6099, 1, units.speed(name, "homing.speed_switch", homing.speed_switch))
    await drive.ensure(0x6099, 2, units.speed(name, "homing.speed_zero", homing.speed_zero))
    if await drive.remote.has(0x609A):
        await drive.ensure(0x609A, 0, units.acceleration(name, "homing.acceleration", homing.acceleration))
    else:
        drive.lack((0x609A, 0), "it has no such object")
    await drive.ensure(0x607C, 0, 0)  # manufacturers use different signs; `offset` in [drives] is used instead


_POSITION_LIMITS: Final = {
    0x607B: ("position range limit", "targets outside it wrap to its other end"),
    0x607D: ("software position limit", "the drive moves to no target outside it"),
}
"""Name of each position limit, whose subindexes 1 and 2 are its ends, and its effect (CiA 402-2)."""


async def check_position_limits(drive: Differences, scale: Scale, travel: tuple[float, float]) -> None:
    """Raise DriveError if a position limit of the drive excludes part of the `travel` of its slider [m].

    The positions of a drive with homing count from its home, as the limits do. Two zeros are no limit, nor is a
    software limit whose ends are exchanged. CiA 402-2 shifts the software limit by the home offset, but not every drive
    does so: if this decides, a note is added.
    """
    remote = drive.remote
    low, high = sorted(scale.counts(end) for end in travel)
    for index, (called, effect) in _POSITION_LIMITS.items():
        least, most = await remote.peek(index, 1), await remote.peek(index, 2)
        if least is None or most is None or least == most == 0 or (index == 0x607D and least > most):
            continue
        limit = f"object {index:04X} ({called}) is {least} to {most} counts"
        if least >= most:
            drive.add_note(f"{limit}, an empty range; make sure that it means no limit")
            continue
        shift = (await remote.peek(0x607C) or 0) if index == 0x607D else 0
        excludes = [low < least - by or most - by < high for by in (0, shift)]
        if not any(excludes):
            continue
        text = f"{limit}, but limits.slider.position = [{travel[0]:g}, {travel[1]:g}] is {low} to {high} counts"
        if not all(excludes):
            drive.add_note(f"{text}; make sure that the home offset 607C, {shift}, does not matter")
            continue
        raise DriveError(
            f"drive {remote.name}: {text}: {effect}; widen it with the manufacturer's tool or "
            f"[[drives.{remote.name}.write]], or reduce limits.slider.position"
        )
