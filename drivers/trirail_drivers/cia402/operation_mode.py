"""Which mode a drive follows setpoints in, and bringing it there: 6060h, 6061h, 60C0h, 60C4h, 6502h (CiA 402-2)."""

from __future__ import annotations

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.homing import HOMING
from trirail_drivers.cia402.objects import MODE, MODE_DISPLAY, title
from trirail_drivers.cia402.process_data import CYCLIC_SYNCHRONOUS_POSITION, INTERPOLATED_POSITION, POSITIONS
from trirail_drivers.cia402.sdo import Remote, SdoRefused
from trirail_drivers.errors import ConfigurationRefused, DriveError

_LINEAR = 0
"""60C0h: linear interpolation."""
_NONE = 0
"""6061h: no mode (CiA 402-2); some drives show theirs only once they have power."""


async def choose_modes(remote: Remote, *, homes: bool) -> tuple[int, ...]:
    """Cyclic synchronous position mode, or interpolated position mode where the drive has no other.

    Of 6502h bit n - 1 stands for mode n; where a drive lacks that, both are to be tried. DriveError where it has
    neither, or is to home and cannot.
    """
    modes = await remote.peek(0x6502)
    if modes is not None and homes and not modes >> (HOMING - 1) & 1:
        raise DriveError(
            f"drive {remote.name}: object 6502:00 (supported drive modes) is {modes:08X}, without homing mode; "
            f"leave [drives.{remote.name}.homing] out if its encoder is absolute"
        )
    found = []
    for mode in (CYCLIC_SYNCHRONOUS_POSITION, INTERPOLATED_POSITION):
        position = POSITIONS[mode]
        told = modes is None or modes >> (mode - 1) & 1
        if told and await remote.has(position >> 16, position >> 8 & 0xFF):
            found.append(mode)
    if not found:
        why = "it has no such object" if modes is None else f"is {modes:08X}"
        raise DriveError(
            f"drive {remote.name}: object 6502:00 (supported drive modes) {why}: neither cyclic synchronous "
            f"position mode (bit 7, with 607A:00) nor interpolated position mode (bit 6, with 60C1:01)"
        )
    return tuple(found if modes is None else found[:1])


async def give_mode(drive: Differences, modes: tuple[int, ...]) -> tuple[int, bool]:
    """Put the drive into the first of these modes that it takes; return it, and whether 6061h shows it already.

    One that shows no mode at all may do so until it has power. ConfigurationRefused where it shows another.
    """
    refusal: DriveError | None = None
    untold = None
    for mode in modes:
        try:
            found, waited = await _shown_once_given(drive, mode)
        except SdoRefused as error:
            refusal = refusal or error
            continue
        if found == mode:
            return mode, True
        if found == _NONE:
            untold = untold or mode
        else:
            called = drive.remote.name_of(MODE_DISPLAY)
            refusal = refusal or ConfigurationRefused(drive.remote.name, called, *MODE_DISPLAY, mode, found, waited)
    if untold is None and refusal is not None:
        raise refusal
    chosen = untold or modes[0]
    if len(modes) > 1:
        await _write(drive, chosen)
    drive.add_note(
        f"{title(MODE_DISPLAY)} is 0: until it shows mode {chosen}, with power, the drive is held where it is"
    )
    return chosen, False


async def _shown_once_given(drive: Differences, mode: int) -> tuple[int, float]:
    """Give the drive a mode; return what 6061h shows as soon as that is the mode, and how long was waited [s]."""
    remote = drive.remote
    await _write(drive, mode)
    if mode == INTERPOLATED_POSITION:
        await _give_interpolation(drive)
    found, waited = await remote.becomes(MODE_DISPLAY, lambda shown: shown == mode)
    return (await remote.read(*MODE_DISPLAY) if found is None else found), waited


async def _write(drive: Differences, mode: int) -> None:
    remote = drive.remote
    if await remote.peek(*MODE) != mode or await remote.peek(*MODE_DISPLAY) != mode:
        drive.note(MODE, await remote.peek(*MODE), mode)
        await remote.write(*MODE, mode)


async def _give_interpolation(drive: Differences) -> None:
    """Linear interpolation between setpoints, and an empty buffer that takes one at a time."""
    remote = drive.remote
    if await remote.has(0x60C0):
        await drive.give(0x60C0, 0, _LINEAR)
    if await remote.has(0x60C4, 6):
        for value in (0, 1):  # 0 empties the buffer and closes it, 1 opens it
            try:
                await remote.write(0x60C4, 6, value)
            except SdoRefused as refusal:
                drive.lack((0x60C4, 6), "it is not taken", refusal)
                return
