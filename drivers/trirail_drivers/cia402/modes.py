"""Which mode a drive follows setpoints in, and bringing it there: 6060h, 6061h, 60C0h, 60C4h, 6502h (CiA 402-2)."""

from __future__ import annotations

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.homing import HOMING
from trirail_drivers.cia402.objects import MODE, MODE_DISPLAY
from trirail_drivers.cia402.sdo import Remote, SdoRefused
from trirail_drivers.cia402.ways import CYCLIC_SYNCHRONOUS_POSITION, INTERPOLATED_POSITION, POSITIONS
from trirail_drivers.errors import ConfigurationRefused, DriveError

_LINEAR = 0
"""60C0h: linear interpolation."""


def choose_mode(remote: Remote, *, homes: bool) -> int:
    """Cyclic synchronous position mode, or interpolated position mode where the drive has no other.

    Of 6502h bit n - 1 stands for mode n. DriveError where it has neither, or is to home and cannot.
    """
    modes = remote.look(0x6502)
    if modes is None:  # it does not tell: 6061h will
        return CYCLIC_SYNCHRONOUS_POSITION
    if homes and not modes >> (HOMING - 1) & 1:
        raise DriveError(
            f"drive {remote.name}: object 6502:00 (supported drive modes) is {modes:08X}, without homing mode; "
            f"leave [drives.{remote.name}.homing] out if its encoder is absolute"
        )
    for mode in (CYCLIC_SYNCHRONOUS_POSITION, INTERPOLATED_POSITION):
        position = POSITIONS[mode]
        if modes >> (mode - 1) & 1 and remote.has(position >> 16, position >> 8 & 0xFF):
            return mode
    raise DriveError(
        f"drive {remote.name}: object 6502:00 (supported drive modes) is {modes:08X}: neither cyclic synchronous "
        f"position mode (bit 7, with 607A:00) nor interpolated position mode (bit 6, with 60C1:01)"
    )


def give_mode(drive: Differences, mode: int) -> None:
    """Put the drive into a mode; ConfigurationRefused where 6061h tells another."""
    remote = drive.remote
    if remote.look(*MODE) != mode or remote.look(*MODE_DISPLAY) != mode:
        drive.note(MODE, remote.look(*MODE), mode)
        remote.write(*MODE, mode)
    if mode == INTERPOLATED_POSITION:
        _give_interpolation(drive)
    found = remote.read(*MODE_DISPLAY)
    if found != mode:
        raise ConfigurationRefused(remote.name, remote.name_of(MODE_DISPLAY), *MODE_DISPLAY, mode, found)


def _give_interpolation(drive: Differences) -> None:
    """Linear interpolation between setpoints, and an empty buffer that takes one at a time."""
    remote = drive.remote
    if remote.has(0x60C0):
        drive.give(0x60C0, 0, _LINEAR)
    if remote.has(0x60C4, 6):
        for value in (0, 1):  # 0 empties the buffer and closes it, 1 opens it
            try:
                remote.write(0x60C4, 6, value)
            except SdoRefused as refusal:
                drive.lack((0x60C4, 6), "it is not taken", refusal)
                return
