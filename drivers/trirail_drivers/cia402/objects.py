"""Objects of a CiA 402 drive that the driver uses: type, purpose, and the consequence if an object is missing.

Manufacturers omit objects that are optional in CiA 301 and CiA 402-2. A drive without a NEEDED object is refused. For a
REPLACEABLE object the driver uses a substitute and adds a note. Without a PROTECTION, the drive would not stop in a
situation in which this service promises a stop, so the drive is refused unless `accept_without` names the object. An
object that exists but keeps another value may have another consequence than a missing one, whose default is known.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final, NamedTuple

Key = tuple[int, int]
"""Index and subindex of an object."""
MODE: Final[Key] = 0x6060, 0
MODE_DISPLAY: Final[Key] = 0x6061, 0


class Need(StrEnum):
    """Consequence if a drive lacks an object."""

    NEEDED = "needed"
    REPLACEABLE = "replaceable"
    PROTECTION = "protection"


class ObjectUse(NamedTuple):
    """Use of an object by the driver."""

    need: Need
    name: str
    purpose: str
    without: str
    """Substitute for the object, or consequence of lacking it."""
    kept: tuple[Need, str] | None = None
    """Need and consequence if the drive has the object but keeps another value; None if both are as without it."""

    @property
    def if_kept(self) -> tuple[Need, str]:
        """Need and consequence if the drive has the object but keeps another value."""
        return self.kept or (self.need, self.without)


_N, _R, _P = Need.NEEDED, Need.REPLACEABLE, Need.PROTECTION
_REFUSED: Final = _N, "refused"

USES: Final = {
    "1000": ObjectUse(_N, "Device type", "check that it is a CiA 402 drive", "refused"),
    "1001": ObjectUse(_R, "Error register", "check that an EMCY is over", "only EMCY 00xxh shows it"),
    "1005": ObjectUse(_R, "COB-ID SYNC", "reception of SYNC 080h", "080h, the predefined one", _REFUSED),
    "1006": ObjectUse(_P, "Communication cycle period", "its monitoring of SYNC", "it continues without SYNC"),
    "1007": ObjectUse(_R, "Synchronous window length", "setpoints accepted at any time", "there is none", _REFUSED),
    "100C": ObjectUse(_R, "Guard time", "node guarding, without 1016", "heartbeats"),
    "100D": ObjectUse(_R, "Life time factor", "node guarding, without 1016", "heartbeats"),
    "1014": ObjectUse(_R, "COB-ID EMCY", "its EMCY", "080h + node, the predefined one"),
    "1015": ObjectUse(_R, "Inhibit time EMCY", "an EMCY without delay", "there is none", (_R, "delayed EMCYs")),
    "1016": ObjectUse(_P, "Consumer heartbeat time", "its monitoring of this service", "node guarding 100Ch, or none"),
    "1017": ObjectUse(_R, "Producer heartbeat time", "monitoring by this service", "only its answers to SYNC"),
    "1019": ObjectUse(_R, "Synchronous counter overflow", "SYNC without a counter", "there is none", _REFUSED),
    "1029": ObjectUse(
        _R,
        "Error behaviour",
        "pre-operational without a master",
        "the standard's default, the same",
        (_P, "only its reaction 6007"),
    ),
    "1400:05": ObjectUse(_R, "Event timer", "no deadline for controlwords", "there is none"),
    "1800:03": ObjectUse(_R, "Inhibit time", "changes without delay", "there is none", (_R, "changes come late")),
    "1800:05": ObjectUse(_R, "Event timer", "repeated values", "beside the position, or polled"),
    "6007": ObjectUse(_P, "Abort connection option code", "its stop without a master", "its own reaction"),
    "603F": ObjectUse(_R, "Error code", "the cause of a fault at the start", "only its EMCY shows it"),
    "6040": ObjectUse(_N, "Controlword", "power, stop, reset", "refused"),
    "6041": ObjectUse(_N, "Statusword", "its state", "refused"),
    "605A": ObjectUse(_P, "Quick stop option code", "its quick-stop ramp", "its own stop"),
    "605D": ObjectUse(
        _R,
        "Halt option code",
        "a ramp when homing is stopped",
        "its own stop",
        (_P, "it may coast when homing is stopped"),
    ),
    "605E": ObjectUse(_P, "Fault reaction option code", "the ramp of its faults", "its own stop"),
    "6060": ObjectUse(_N, "Modes of operation", "the mode", "refused"),
    "6061": ObjectUse(_N, "Modes of operation display", "the mode", "refused"),
    "6064": ObjectUse(_N, "Position actual value", "its position", "refused"),
    "6065": ObjectUse(_P, "Following error window", "its own monitoring of the following error", "only this service's"),
    "6066": ObjectUse(
        _R, "Following error time out", "its reaction within 100 ms", "there is none", (_P, "a later reaction")
    ),
    "607A": ObjectUse(_N, "Target position", "setpoints of mode 8", "refused"),
    "607C": ObjectUse(_R, "Home offset", "home at `offset`", "0, the standard's default", _REFUSED),
    "6085": ObjectUse(_P, "Quick stop deceleration", "its quick-stop ramp", "its own ramp"),
    "6098": ObjectUse(_N, "Homing method", "homing, where configured", "refused"),
    "6099": ObjectUse(_N, "Homing speeds", "homing, where configured", "refused"),
    "609A": ObjectUse(_R, "Homing acceleration", "homing, where configured", "its own"),
    "60B1": ObjectUse(_R, "Velocity offset", "the velocity feed-forward", "a larger following error"),
    "60C0": ObjectUse(_R, "Interpolation sub mode select", "linear interpolation", "its own"),
    "60C1": ObjectUse(_N, "Interpolation data record", "setpoints of mode 7", "refused"),
    "60C2": ObjectUse(_R, "Interpolation time period", "its interpolation", "the time from SYNC to SYNC"),
    "60C4": ObjectUse(_R, "Interpolation data configuration", "an empty buffer", "its own"),
    "60FD": ObjectUse(_N, "Digital inputs", "digital inputs, where configured", "refused"),
    "60FE": ObjectUse(_N, "Digital outputs", "digital outputs, where configured", "refused"),
    "6502": ObjectUse(_R, "Supported drive modes", "mode 8 or 7", "mode 8 is tried, then 7"),
}
"""Use of each object, by index or by index and subindex. The objects are those of CiA 301 and, from 6000h, CiA 402-2.

605B (shutdown) and 605C (disable operation) are not used: the driver removes power with "disable voltage" and
"quick stop", which do not depend on these objects.
"""

FOLLOWING_BIT: Final = "6041"
"""Name in `accept_without` that allows a drive never to set bit 12 of its statusword."""
PROTECTIONS: Final = {
    name: used._replace(without=used.if_kept[1]) for name, used in USES.items() if used.if_kept[0] is Need.PROTECTION
} | {
    FOLLOWING_BIT: ObjectUse(
        _P, "Bit 12 of the statusword", "its report that it follows setpoints", "that is not checked"
    )
}
"""Protections that `accept_without` may name."""

_WIDTHS: Final = {
    **dict.fromkeys((0x1001, 0x1019, 0x1029, 0x6060, 0x6061, 0x6098, 0x60C2), 1),
    **dict.fromkeys((0x100C, 0x1015, 0x1017, 0x603F, 0x6040, 0x6041), 2),
    **dict.fromkeys((0x6007, 0x605A, 0x605D, 0x605E, 0x6066, 0x60B2, 0x60C0), 2),
    0x100D: 1,
}
"""Size of each object's value [bytes] if it is not four (CiA 301, CiA 402-2)."""
_SIGNED: Final = frozenset(
    (0x6007, 0x605A, 0x605D, 0x605E, 0x6060, 0x6061, 0x6064, 0x607A, 0x607B, 0x607C, 0x607D, 0x6098, 0x60C0, 0x60C1)
) | {0x60B0, 0x60B1, 0x60B2}


def width(key: Key) -> int:
    """Return the size of an object's value [bytes] according to the standards."""
    index, subindex = key
    if 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00:
        return {1: 4, 3: 2, 5: 2}.get(subindex, 1)
    if subindex == 0 and (0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00):
        return 1
    if index == 0x60C4:
        return {1: 4, 2: 4, 4: 2}.get(subindex, 1)
    return _WIDTHS.get(index, 4)


def signed(key: Key) -> bool:
    """Whether an object's value is signed."""
    return key[0] in _SIGNED or key == (0x60C2, 2)


def find_use(key: Key) -> tuple[str, ObjectUse] | None:
    """Return the key of an object in the table USES, and its entry; None if the driver does not use the object."""
    index, subindex = key
    if 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00:
        index &= 0xFE00
    for name in (f"{index:04X}:{subindex:02X}", f"{index:04X}"):
        if name in USES:
            return name, USES[name]
    return None


def describe_protection(protection: str) -> str:
    """Return text for people with the purpose of a protection, and the consequence if a drive lacks the protection."""
    used = PROTECTIONS[protection]
    return f"{used.purpose}; without: {used.without}"


def title(key: Key) -> str:
    """Return an object's index and name for messages."""
    known = find_use(key)
    return f"object {key[0]:04X}:{key[1]:02X}" + (f" ({known[1].name})" if known else "")
