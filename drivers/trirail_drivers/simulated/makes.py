"""What makers rule where CiA 402 leaves it open: held by simulated drives of their vendor id (1018h:01)."""

from __future__ import annotations

from typing import Final

from trirail_drivers.simulated.dictionary import INVALID_VALUE, Dictionary, ObjectEntry, SdoAbort

TECHNOSOFT: Final = 0x1A3
NANOTEC: Final = 0x26C
LINEAR: Final = 1 << 8
"""Technosoft's 208Eh, auxiliary settings register: bit 8."""
_MILLISECONDS: Final = -3


class MakersRules:
    """A drive of some make; one of a vendor without an entry here does as CiA 402 has it."""

    def __init__(self, objects: Dictionary) -> None:
        vendor = objects.internal(0x1018, 1).value
        self._technosoft = vendor == TECHNOSOFT
        self._auxiliary = objects.internal(0x208E, 0)
        if vendor == NANOTEC:
            objects.on_write(0x60C2, _in_milliseconds)

    @property
    def interpolates_linearly(self) -> bool:
        """Whether mode 7 follows 60C1h:01 as CiA 402 has it.

        Technosoft, iPOS CANopen Programming (P091.063), section 9.2.1, as roboticslab-uc3m/yarp-devices quotes it in
        its issues 198 and 222: linear interpolation without a buffer is with 208Eh bit 8; else 60C0h = 0 is PT mode,
        whose points have their time in 60C1h:02 and wait in a buffer, so that a position alone moves nothing.
        """
        return not self._technosoft or bool(self._auxiliary.value & LINEAR)

    @property
    def shows_mode_with_power_alone(self) -> bool:
        """Whether 6061h takes the value of 6060h in operation enabled only.

        Technosoft, the same manual of 2019, 6061h, as yarp-devices quotes it in its issue 215.
        """
        return self._technosoft


def _in_milliseconds(entry: ObjectEntry, _old: int) -> None:
    """Nanotec, manual of the PD4-C, 60C2h:02: must hold -3, milliseconds."""
    if entry.subindex == 2 and entry.value != _MILLISECONDS:
        raise SdoAbort(INVALID_VALUE)
