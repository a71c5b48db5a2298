"""What a CiA 402 drive is to hold before the cycle runs: objects, values, and what will do as well."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Final

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import Key, title
from trirail_drivers.cia402.sdo import SdoRefused, shown
from trirail_drivers.cia402.units import Units
from trirail_drivers.config import Drives, Homing
from trirail_drivers.errors import ConfigurationRefused, DriveError
from trirail_drivers.interface import NAMES

PREFERRED_EXPONENT: Final = -3
"""Of 60C2h: milliseconds, which every drive takes; some take nothing else."""


def interpolation_periods(period: float) -> list[tuple[int, int]]:
    """Values and powers of ten [s] for object 60C2h that say `period`, milliseconds first; DriveError if none does."""
    found = [
        (round(period * 10**-exponent), exponent)
        for exponent in range(0, -7, -1)
        if math.isclose(round(period * 10**-exponent) * 10.0**exponent, period, rel_tol=1e-9)
        and 1 <= round(period * 10**-exponent) <= 255
    ]
    if found:
        return sorted(found, key=lambda each: (each[1] != PREFERRED_EXPONENT, -each[1]))
    finest = max(-6, math.ceil(math.log10(period / 255)))
    nearest = max(1, round(period * 10**-finest)) * 10.0**finest
    raise DriveError(
        f"a cycle of {period:g} s ({1 / period:g} Hz) cannot be told to the drives: object 60C2h takes "
        f"1 to 255 times a power of ten from 1 us; the nearest is {nearest:g} s ({1 / nearest:g} Hz)"
    )


def check_nodes(drives: Drives) -> None:
    """Refuse node ids that CANopen does not have, or that two nodes share, with DriveError."""
    nodes = {f"drives.{name}.node": drive.node for name, drive in zip(NAMES, drives.each, strict=True)}
    nodes["drives.master_node"] = drives.master_node
    for key, node in nodes.items():
        if node == 0:
            raise DriveError(f"{key} = 0: that is all nodes' on CANopen; wanted 1 to 127")
    if len(set(nodes.values())) < len(nodes):
        told = ", ".join(f"{key} = {node}" for key, node in nodes.items())
        raise DriveError(f"node ids must differ, but are {told}")


def heartbeat_of(drives: Drives) -> int:
    """The heartbeats' period [ms]; DriveError where a drive cannot take it."""
    heartbeat = round(1000 * drives.heartbeat)
    if not 1 <= 3 * heartbeat <= 0xFFFF or heartbeat < 1:
        raise DriveError(f"heartbeat {drives.heartbeat:g} s: a drive takes 0.001 to 21.845 s")
    return heartbeat


async def give_cycle(drive: Differences, period: float) -> None:
    """Tell the drive the cycle's period [s]: 1005h, 1006h, 60C2h; and that SYNC is plain: 1007h, 1019h."""
    for key, wanted, bits in PLAIN_SYNC:
        await _give_plain(drive, key, wanted, bits)
    await drive.give(0x1006, 0, round(1e6 * period))
    await _give_interpolation(drive, interpolation_periods(period))


PLAIN_SYNC: Final = (
    ((0x1005, 0), 0x80, 0x4000_07FF),  # bit 30: it would make SYNC itself
    ((0x1007, 0), 0, 0xFFFF_FFFF),  # setpoints, and positions, that come later than this are thrown away
    ((0x1019, 0), 0, 0xFF),  # a SYNC that has no counter is EMCY 8240h to a drive that waits for one
)
"""Objects by which another master may have changed what a SYNC is to a drive: what they must hold, in these bits."""


async def _give_plain(drive: Differences, key: Key, wanted: int, bits: int) -> None:
    remote = drive.remote
    found = await remote.peek(*key)
    if found is None or found & bits == wanted:
        return
    if key == (0x1019, 0) and await remote.peek(0x1006):
        with suppress(SdoRefused):
            await remote.write(0x1006, 0, 0)  # CiA 301: the counter changes only while the period is 0
            await remote.becomes((0x1006, 0), lambda held: held == 0)
    await drive.give(*key, wanted)
    if (await remote.peek(*key) or 0) & bits != wanted:
        raise DriveError(
            f"drive {remote.name}: {title(key)} is {shown(*key, found)} and stays; wanted {shown(*key, wanted)}"
        )


async def _give_interpolation(drive: Differences, periods: list[tuple[int, int]]) -> None:
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
                if (found := await remote.peek(*key)) != wanted:
                    await drive.put(key, found, wanted)
        except (SdoRefused, ConfigurationRefused) as error:
            refusal = error
            continue
        return
    if refusal is not None:
        refusal.args = (f"{refusal}{_rate_that_it_holds(*held)}",)
        raise refusal


def _rate_that_it_holds(value: int | None, exponent: int | None) -> str:
    """The remedy where a drive keeps to an interpolation time of its own; "" where it tells none."""
    if not value or exponent is None:
        return ""
    period = value * 10.0**exponent
    return f"; it holds {1000 * period:g} ms: say loop.rate_hz = {1 / period:g}"


async def give_reactions(drive: Differences, drives: Drives, units: Units) -> None:
    """Tell the drive what it does when something is wrong: 6007h, 605Ah, 605Eh, 6065h, 6085h."""
    name = drive.remote.name
    await drive.give(
        0x6007, 0, 3, also=(2, 1)
    )  # a drive that lost its master quick-stops; power off or a fault will do
    await drive.give(0x605A, 0, 2)  # quick stop: down the ramp 6085h, then without power
    await drive.give(
        0x605E, 0, 2, also=(1, 0)
    )  # its own fault: down the same ramp; another, or none, is a stop as well
    if await drive.remote.has(0x6085):
        ramp = units.acceleration(name, "quick_stop_deceleration", drives.quick_stop_deceleration)
        await drive.give(0x6085, 0, ramp)
    else:
        drive.lack((0x6085, 0), "it has no such object")
    await drive.give(0x6065, 0, units.length(name, "following_error", drives.following_error))


async def give_homing(drive: Differences, homing: Homing, units: Units) -> None:
    """Tell the drive how it finds its home: 6098h, 6099h, 609Ah, 607Ch."""
    name = drive.remote.name
    await drive.give(0x6098, 0, homing.method)
    await drive.give(0x6099, 1, units.speed(name, "homing.speed_switch", homing.speed_switch))
    await drive.give(0x6099, 2, units.speed(name, "homing.speed_zero", homing.speed_zero))
    if await drive.remote.has(0x609A):
        await drive.give(0x609A, 0, units.acceleration(name, "homing.acceleration", homing.acceleration))
    else:
        drive.lack((0x609A, 0), "it has no such object")
    await drive.give(0x607C, 0, 0)  # makers differ in its sign; where home is, the drive's `offset` says
