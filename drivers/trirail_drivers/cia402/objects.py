"""The objects that the driver uses of a CiA 402 drive: type, what each is for, and what is done where one is missing.

Makers leave out what CiA 301 and CiA 402-2 leave optional. An object is one of three: without one that is NEEDED a
drive is refused; what a REPLACEABLE one does is done otherwise, and told; without one that is a PROTECTION the drive
would go on where this service promises that it stops, so it is refused unless `accept_without` names the object.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final, NamedTuple

Key = tuple[int, int]
"""Index and subindex of an object."""
MODE: Final[Key] = 0x6060, 0
MODE_DISPLAY: Final[Key] = 0x6061, 0


class Need(StrEnum):
    """What it means that a drive lacks an object."""

    NEEDED = "needed"
    REPLACEABLE = "replaceable"
    PROTECTION = "protection"


class Use(NamedTuple):
    """What an object is used for."""

    need: Need
    name: str
    purpose: str
    without: str
    """What is so where a drive lacks it."""


_N, _R, _P = Need.NEEDED, Need.REPLACEABLE, Need.PROTECTION

USES: Final = {
    "1000": Use(_N, "Device type", "that it is a CiA 402 drive", "refused"),
    "1001": Use(_R, "Error register", "whether an EMCY is still in force", "EMCY 00xxh alone tells"),
    "1005": Use(_R, "COB-ID SYNC", "that it hears SYNC 080h", "080h, the predefined one"),
    "1006": Use(_P, "Communication cycle period", "its watch on SYNC", "it goes on without SYNC"),
    "1007": Use(_R, "Synchronous window length", "that setpoints count whenever they come", "there is none"),
    "100C": Use(_R, "Guard time", "node guarding, for want of 1016", "heartbeats"),
    "100D": Use(_R, "Life time factor", "node guarding, for want of 1016", "heartbeats"),
    "1014": Use(_R, "COB-ID EMCY", "its EMCY", "080h + node, the predefined one"),
    "1015": Use(_R, "Inhibit time EMCY", "that an EMCY comes at once", "none is taken to be there"),
    "1016": Use(_P, "Consumer heartbeat time", "its watch on this service", "node guarding 100Ch, or none"),
    "1017": Use(_R, "Producer heartbeat time", "this service's watch on it", "its answers to SYNC alone"),
    "1019": Use(_R, "Synchronous counter overflow", "SYNC without a counter", "there is none"),
    "1029": Use(_R, "Error behaviour", "pre-operational when it hears nobody", "the standard's default is that"),
    "1400:05": Use(_R, "Event timer", "that nothing has to come unchanged", "there is none"),
    "1800:03": Use(_R, "Inhibit time", "that a statusword comes at once", "there is none"),
    "1800:05": Use(_R, "Event timer", "that statuswords come also unchanged", "beside the position, or polled"),
    "6007": Use(_P, "Abort connection option code", "its stop when it hears nobody", "its own way"),
    "603F": Use(_R, "Error code", "why it was in fault at the start", "its EMCY alone tells"),
    "6040": Use(_N, "Controlword", "power, stop, reset", "refused"),
    "6041": Use(_N, "Statusword", "its state", "refused"),
    "605A": Use(_P, "Quick stop option code", "its quick-stop ramp", "its own way to stop"),
    "605E": Use(_P, "Fault reaction option code", "the ramp of its faults", "its own way to stop"),
    "6060": Use(_N, "Modes of operation", "the mode", "refused"),
    "6061": Use(_N, "Modes of operation display", "the mode", "refused"),
    "6064": Use(_N, "Position actual value", "its position", "refused"),
    "6065": Use(_P, "Following error window", "its own watch on its following error", "this service's alone"),
    "607A": Use(_N, "Target position", "setpoints of mode 8", "refused"),
    "607C": Use(_R, "Home offset", "that home is at `offset`", "0, the standard's default"),
    "6085": Use(_P, "Quick stop deceleration", "its quick-stop ramp", "its own ramp"),
    "6098": Use(_N, "Homing method", "homing, where configured", "refused"),
    "6099": Use(_N, "Homing speeds", "homing, where configured", "refused"),
    "609A": Use(_R, "Homing acceleration", "homing, where configured", "its own"),
    "60B1": Use(_R, "Velocity offset", "the velocity feed-forward", "it follows with a lag of its own"),
    "60C0": Use(_R, "Interpolation sub mode select", "linear interpolation", "its own"),
    "60C1": Use(_N, "Interpolation data record", "setpoints of mode 7", "refused"),
    "60C2": Use(_R, "Interpolation time period", "its interpolation", "the time from SYNC to SYNC"),
    "60C4": Use(_R, "Interpolation data configuration", "an empty buffer", "its own"),
    "6502": Use(_R, "Supported drive modes", "mode 8 or 7", "mode 8 is tried, then 7"),
}
"""By index, or index and subindex, of CiA 301 or, from 6000h on, of CiA 402-2. 605B (shutdown) and 605C (disable
operation) are not used: power is taken off by "disable voltage" and "quick stop", which they do not bear on."""

FOLLOWING_BIT: Final = "6041"
"""What `accept_without` names where bit 12 of the statusword says nothing."""
PROTECTIONS: Final = {name: used for name, used in USES.items() if used.need is Need.PROTECTION} | {
    FOLLOWING_BIT: Use(_P, "Bit 12 of the statusword", "saying that it follows setpoints", "that is not looked at")
}
"""What `accept_without` may name."""

_WIDTHS: Final = {
    **dict.fromkeys((0x1001, 0x1019, 0x1029, 0x6060, 0x6061, 0x6098, 0x60C2), 1),
    **dict.fromkeys((0x100C, 0x1015, 0x1017, 0x603F, 0x6040, 0x6041), 2),
    **dict.fromkeys((0x6007, 0x605A, 0x605E, 0x60C0), 2),
    0x100D: 1,
}
"""Bytes of each object's value, where it is not four (CiA 301, CiA 402-2)."""
_SIGNED: Final = frozenset(
    (0x6007, 0x605A, 0x605E, 0x6060, 0x6061, 0x6064, 0x607A, 0x607C, 0x6098, 0x60B1, 0x60C0, 0x60C1)
)


def width(key: Key) -> int:
    """Bytes of an object's value as the standards have it."""
    index, subindex = key
    if 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00:
        return {1: 4, 3: 2, 5: 2}.get(subindex, 1)
    if subindex == 0 and (0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00):
        return 1
    if index == 0x60C4:
        return {1: 4, 2: 4, 4: 2}.get(subindex, 1)
    return _WIDTHS.get(index, 4)


def signed(key: Key) -> bool:
    """Whether an object's value has a sign."""
    return key[0] in _SIGNED or key == (0x60C2, 2)


def use(key: Key) -> tuple[str, Use] | None:
    """What an object is used for, and as what USES names it; None for what is not asked of drives."""
    index, subindex = key
    if 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00:
        index &= 0xFE00
    for name in (f"{index:04X}:{subindex:02X}", f"{index:04X}"):
        if name in USES:
            return name, USES[name]
    return None


def means(protection: str) -> str:
    """What a protection is for, and what is so without, for people."""
    used = PROTECTIONS[protection]
    return f"{used.purpose}; without: {used.without}"


def title(key: Key) -> str:
    """An object as messages name it."""
    found = use(key)
    return f"object {key[0]:04X}:{key[1]:02X}" + (f" ({found[1].name})" if found else "")
