"""Writing of the manufacturer-specific objects that the configuration lists: [[drives.A.write]]."""

from __future__ import annotations

import re
from typing import Final

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import Key, find_use
from trirail_drivers.cia402.parameters import named
from trirail_drivers.cia402.sdo import is_pdo
from trirail_drivers.config import Drive, ObjectWrite
from trirail_drivers.errors import DriveError

_STORES: Final = "would store parameters in the drive, or restore stored ones"
_ADDRESS: Final = "changes node id or bitrate, for which the manufacturer's tool is needed"
_FORBIDDEN: Final = {0x1010: _STORES, 0x1011: _STORES, 0x100B: _ADDRESS}
_HOMING: Final = (0x605D, 0x607C, 0x6098, 0x6099, 0x609A)
"""Objects that the set-up writes only for a drive with homing."""
UNITS: Final = (0x60A9, 0x60AA)
"""Units of velocity and acceleration. The set-up writes them only for drives whose unit cannot be converted."""
_UNITS_AND_OFFSETS: Final = (*UNITS, 0x60B0, 0x60B2)
"""Objects that are not in USES but that the set-up may write: units, and offsets of the setpoints."""
_ADDRESSES: Final = {
    0x0000_00FB: (0x2000, 0x2001),  # maxon, EPOS4 Firmware Specification: Node-ID, CAN bit rate
    0x0000_026C: (0x2005, 0x2009),  # Nanotec, manuals, object dictionary: CANopen Baudrate, CANopen NodeID
}
"""Objects that contain the node id and the bit rate, by vendor id (1018h:01)."""
_MAKERS: Final = range(0x2000, 0x6000)
"""Objects of manufacturers. No object of CiA 301 and CiA 402-2 contains the node id or the bit rate; 100Bh did once."""
_BARE_ADDRESS: Final = re.compile(r"id|addr(ess)?|n(umbe)?r", re.IGNORECASE)
"""Names of sub-objects that mean the node id only together with the name of their object, such as Node and ID."""
_ADDRESS_NAMES: Final = re.compile(
    r"((node|station|slave|bus|(^|can(open)?\W*)device|(?<![a-z])can(open)?).?(id\b|id[^a-z]|addr|n(umbe)?r\b)|"
    r"node.?id|can(open)?.?node|bit.?(rate|timing)|baud)(?!\W*of\b)",
    re.IGNORECASE,
)
"""Usual names of objects that contain the node id or the bit rate; names such as "slave number of turns" differ."""
_OTHER_BUS: Final = re.compile(
    r"rs.?(232|422|485)|usb|uart|serial|\bs[cps]i\b|i2c|biss|endat|hiperface|encoder|sensor|resolver|modbus|ethernet|"
    r"ethercat|profi(bus|net)|bluetooth",
    re.IGNORECASE,
)
"""Words for other connections of a drive, which have addresses and bit rates too."""


def check(name: str, drive: Drive, number: int) -> None:
    """Raise DriveError if entry `number` of the drive's configuration names an object that it must not write."""
    each = drive.write[number]
    key = each.object, each.sub
    twice = key in [(other.object, other.sub) for other in drive.write[:number]]
    if why := owned(key, drive) or ("is listed twice" if twice else ""):
        raise DriveError(f"drives.{name}.write: object {named(key)} {why}")


def owned(key: Key, drive: Drive) -> str:
    """Return the reason why the configuration may not write an object, or "" if it may.

    It may not write the objects that the set-up of this drive writes, that store parameters, or that set the node id or
    bit rate.
    """
    if key[0] in _HOMING and drive.homing is None:
        return ""
    used = find_use(key)
    if used is not None or is_pdo(key[0]) or key[0] in _UNITS_AND_OFFSETS:
        return f"is written by the set-up{f', for {used[1].purpose}' if used else ''}"
    return _FORBIDDEN.get(key[0], "")


def address(key: Key, name: str, vendor: int | None) -> str:
    """Return an error message if an object contains the node id or the bit rate on the CAN bus, or "".

    Such an object is recognised by its index if the manufacturer's is known, otherwise by the name of the object or of
    the sub-object: "Motor device.Number of pole pairs" contains "device number" in neither name.
    """
    if key[0] in _ADDRESSES.get(vendor or 0, ()):
        return _ADDRESS
    if key[0] not in _MAKERS or (_OTHER_BUS.search(name) and not re.search(r"(?<![a-z])can", name, re.IGNORECASE)):
        return ""
    names = name.split(".")
    if _BARE_ADDRESS.fullmatch(names[-1].strip()):
        names.append(" ".join(names[-2:]))
    return _ADDRESS if any(_ADDRESS_NAMES.search(each.strip()) for each in names) else ""


async def write_makers_objects(drive: Differences, writes: tuple[ObjectWrite, ...]) -> None:
    """Write the objects that differ and read them back. Raises DriveError if one is missing or has another size."""
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
            raise DriveError(f'{where} has {bits} bits in the drive, but type = "{each.type}"')
        current = await remote.peek(*key)
        if current != each.value:
            await drive.put(key, current, each.value, each.why)
