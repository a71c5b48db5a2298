"""Choice of the mode in which a drive follows setpoints: 6060h, 6061h, 60C0h, 60C4h, 6502h (CiA 402-2)."""

from __future__ import annotations

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.homing import HOMING
from trirail_drivers.cia402.objects import MODE, MODE_DISPLAY, title
from trirail_drivers.cia402.process_data import CYCLIC_SYNCHRONOUS_POSITION, INTERPOLATED_POSITION, POSITIONS
from trirail_drivers.cia402.sdo import Remote, SdoRefused
from trirail_drivers.errors import ConfigurationRefused, DriveError

_LINEAR = 0
"""Value of 60C0h for linear interpolation."""
_NONE = 0
"""Value of 6061h that means no mode (CiA 402-2). Some drives show their mode only when they have power."""


async def choose_modes(remote: Remote, *, homes: bool) -> tuple[int, ...]:
    """Return the modes to try: cyclic synchronous position mode or, without it, interpolated position mode.

    Bit n - 1 of 6502h represents mode n; without that object, both modes are returned. Raises DriveError if the drive
    has neither mode, or if it `homes` but has no homing mode.
    """
    modes = await remote.peek(0x6502)
    if modes is not None and homes and not modes >> (HOMING - 1) & 1:
        raise DriveError(
            f"drive {remote.name}: object 6502:00 (supported drive modes) is {modes:08X}, without homing mode; "
            f"omit [drives.{remote.name}.homing] if its encoder is absolute"
        )
    available = []
    for mode in (CYCLIC_SYNCHRONOUS_POSITION, INTERPOLATED_POSITION):
        position = POSITIONS[mode]
        supported = modes is None or modes >> (mode - 1) & 1
        if supported and await remote.has(position >> 16, position >> 8 & 0xFF):
            available.append(mode)
    if not available:
        why = "it has no such object" if modes is None else f"is {modes:08X}"
        raise DriveError(
            f"drive {remote.name}: object 6502:00 (supported drive modes) {why}: neither cyclic synchronous "
            f"position mode (bit 7, with 607A:00) nor interpolated position mode (bit 6, with 60C1:01)"
        )
    return tuple(available if modes is None else available[:1])


async def configure_mode(drive: Differences, modes: tuple[int, ...]) -> tuple[int, bool]:
    """Set the first of the given modes that the drive accepts; return the mode, and whether 6061h already shows it.

    Some drives show no mode until they have power. Raises ConfigurationRefused if the drive shows a different mode.
    """
    refusal: DriveError | None = None
    untold = None
    for mode in modes:
        try:
            shown, waited = await _set_and_wait(drive, mode)
        except SdoRefused as error:
            refusal = refusal or error
            continue
        if shown == mode:
            return mode, True
        if shown == _NONE or (shown == HOMING and await drive.remote.read(*MODE) == mode):
            untold = untold or mode  # a drive that shows its mode only with power may show that of its last homing
        else:
            called = drive.remote.name_of(MODE_DISPLAY)
            refusal = refusal or ConfigurationRefused(drive.remote.name, called, *MODE_DISPLAY, mode, shown, waited)
    if untold is None and refusal is not None:
        raise refusal
    chosen = untold or modes[0]
    if len(modes) > 1:
        await _write(drive, chosen)
    drive.add_note(
        f"{title(MODE_DISPLAY)} is {shown}: until it shows mode {chosen}, with power, the drive holds its position"
    )
    return chosen, False


async def _set_and_wait(drive: Differences, mode: int) -> tuple[int, float]:
    """Set a mode, and wait until 6061h shows it; return the shown mode and the time waited [s]."""
    remote = drive.remote
    await _write(drive, mode)
    if mode == INTERPOLATED_POSITION:
        await _configure_interpolation(drive)
    shown, waited = await remote.wait_until(MODE_DISPLAY, lambda shown: shown == mode)
    return (await remote.read(*MODE_DISPLAY) if shown is None else shown), waited


async def _write(drive: Differences, mode: int) -> None:
    remote = drive.remote
    if await remote.peek(*MODE) != mode or await remote.peek(*MODE_DISPLAY) != mode:
        drive.note(MODE, await remote.peek(*MODE), mode)
        await remote.write(*MODE, mode)


async def _configure_interpolation(drive: Differences) -> None:
    """Set linear interpolation between setpoints, and empty the buffer."""
    remote = drive.remote
    if await remote.has(0x60C0):
        await drive.ensure(0x60C0, 0, _LINEAR)
    if await remote.has(0x60C4, 6):
        for value in (0, 1):  # 0 empties and closes the buffer, 1 opens it
            try:
                await remote.write(0x60C4, 6, value)
            except SdoRefused as refusal:
                drive.lack((0x60C4, 6), "it is refused", refusal)
                return
