"""Gives a drive what its configuration says of its maker's own objects: [[drives.A.write]]."""

from __future__ import annotations

import re
from typing import Final

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import Key, use
from trirail_drivers.cia402.sdo import is_pdo
from trirail_drivers.config import Drive, ObjectWrite
from trirail_drivers.errors import DriveError

_STORES: Final = "would store it in the drive, or restore what is stored"
_ADDRESS: Final = "changes node id or bitrate: that is for its maker's tool"
_NEVER: Final = {0x1010: _STORES, 0x1011: _STORES, 0x100B: _ADDRESS}
_UNITS: Final = (0x60A9, 0x60AA)
"""That the set-up may give itself, beside what it uses."""
_ADDRESSES: Final = {
    0x0000_00FB: (0x2000, 0x2001),  # maxon EPOS4, Firmware Specification: Node-ID, CAN bit rate
    0x0000_026C: (0x2005, 0x2009),  # Nanotec, manuals: CANopen Baudrate, CANopen NodeID
}
"""Objects with node id and bitrate, by vendor (1018h:01)."""
_NAMED_SO: Final = re.compile(r"node.?id|bit.?rate|baud", re.IGNORECASE)


def check(name: str, drive: Drive) -> None:
    """Refuse with DriveError what a configuration may not write to the drive called `name`."""
    seen: set[Key] = set()
    for each in drive.write:
        key = each.object, each.sub
        owned = use(key)
        why = _NEVER.get(each.object, "")
        if owned is not None or is_pdo(each.object) or each.object in _UNITS:
            why = f"is the set-up's own{f', for {owned[1].purpose}' if owned else ''}"
        elif key in seen:
            why = "is there twice"
        if why:
            raise DriveError(f"drives.{name}.write: object {_named(key)} {why}")
        seen.add(key)


async def give_makers_objects(drive: Differences, writes: tuple[ObjectWrite, ...]) -> None:
    """Write what differs, and read it back; DriveError where the drive lacks an object, or has another kind of it."""
    remote = drive.remote
    for each in writes:
        key = each.object, each.sub
        remote.describe(key, each.bits // 8, signed=each.signed)
        where = f"drives.{remote.name}.write: object {_named(key)}"
        of_maker = each.object in _ADDRESSES.get(await remote.look(0x1018, 1) or 0, ())
        if of_maker or _NAMED_SO.search(remote.name_of(key)):
            raise DriveError(f"{where} {_ADDRESS}")
        if not await remote.has(*key):
            raise DriveError(f"{where}: the drive has no such object")
        if (bits := await remote.bits(*key)) != each.bits:
            raise DriveError(f'{where} has {bits} bits, and type = "{each.type}"')
        found = await remote.look(*key)
        if found != each.value:
            await remote.write(*key, each.value)
            drive.note(key, found, each.value, each.why)
            await drive.confirm(key, each.value)


def _named(key: Key) -> str:
    return f"{key[0]:04X}:{key[1]:02X}"
