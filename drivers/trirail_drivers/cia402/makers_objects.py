"""Gives a drive what its configuration says of its maker's own objects: [[drives.A.write]]."""

from __future__ import annotations

import re
from typing import Final

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import Key, use
from trirail_drivers.cia402.parameters import named
from trirail_drivers.cia402.sdo import is_pdo
from trirail_drivers.config import Drive, ObjectWrite
from trirail_drivers.errors import DriveError

_STORES: Final = "would store it in the drive, or restore what is stored"
_ADDRESS: Final = "changes node id or bitrate: that is for its maker's tool"
_NEVER: Final = {0x1010: _STORES, 0x1011: _STORES, 0x100B: _ADDRESS}
_UNITS: Final = (0x60A9, 0x60AA)
"""That the set-up may give itself, beside what it uses."""
_ADDRESSES: Final = {
    0x0000_00FB: (0x2000, 0x2001),  # maxon, EPOS4 Firmware Specification: Node-ID, CAN bit rate
    0x0000_026C: (0x2005, 0x2009),  # Nanotec, manuals, object dictionary: CANopen Baudrate, CANopen NodeID
}
"""Objects with node id and bitrate, by vendor (1018h:01)."""
_NAMED_SO: Final = re.compile(r"node.?id|bit.?rate|baud", re.IGNORECASE)


def check(name: str, drive: Drive, number: int) -> None:
    """Refuse with DriveError what a configuration may not write to the drive called `name`: entry `number` of it."""
    each = drive.write[number]
    key = each.object, each.sub
    twice = key in [(other.object, other.sub) for other in drive.write[:number]]
    if why := owned(key) or ("is there twice" if twice else ""):
        raise DriveError(f"drives.{name}.write: object {named(key)} {why}")


def owned(key: Key) -> str:
    """Why an object is not for others to write: the set-up gives it, it stores, or is the drive's address; else ""."""
    used = use(key)
    if used is not None or is_pdo(key[0]) or key[0] in _UNITS:
        return f"is the set-up's own{f', for {used[1].purpose}' if used else ''}"
    return _NEVER.get(key[0], "")


def address(key: Key, name: str, vendor: int | None) -> str:
    """Why an object is not to be written that its maker or its name says to be node id or bitrate; "" for others."""
    return _ADDRESS if key[0] in _ADDRESSES.get(vendor or 0, ()) or _NAMED_SO.search(name) else ""


async def give_makers_objects(drive: Differences, writes: tuple[ObjectWrite, ...]) -> None:
    """Write what differs, and read it back; DriveError where the drive lacks an object, or has another kind of it."""
    remote = drive.remote
    for each in writes:
        key = each.object, each.sub
        remote.describe(key, each.bits // 8, signed=each.signed)
        where = f"drives.{remote.name}.write: object {named(key)}"
        if why := address(key, remote.name_of(key), await remote.peek(0x1018, 1)):
            raise DriveError(f"{where} {why}")
        if not await remote.has(*key):
            raise DriveError(f"{where}: the drive has no such object")
        if (bits := await remote.bits(*key)) != each.bits:
            raise DriveError(f'{where} has {bits} bits, and type = "{each.type}"')
        found = await remote.peek(*key)
        if found != each.value:
            await drive.put(key, found, each.value, each.why)
