"""Set-up of a drive's digital outputs 60FEh, and check of its digital inputs 60FDh (CiA 402-2)."""

from __future__ import annotations

from contextlib import suppress
from typing import Final

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import Key, title
from trirail_drivers.cia402.sdo import Remote, SdoRefused, shown
from trirail_drivers.config import DigitalIo
from trirail_drivers.errors import DriveError

INPUTS: Final[Key] = 0x60FD, 0
OUTPUTS: Final[Key] = 0x60FE, 1
MASK: Final[Key] = 0x60FE, 2


async def make_outputs_safe(remote: Remote, io: DigitalIo) -> None:
    """Write the safe values of the outputs, beside the present values of the other bits.

    A refusal is ignored, since the set-up configures the outputs later.
    """
    if io.outputs:
        others = (await remote.peek(*OUTPUTS) or 0) & ~io.outputs
        with suppress(SdoRefused):
            await remote.write(*OUTPUTS, others | io.safe)


async def configure_outputs(drive: Differences, io: DigitalIo) -> int:
    """Write the safe values of the outputs, and enable exactly these outputs in the mask 60FEh:02.

    The mask is optional. A drive without a mask applies every bit, so the values of its other bits are returned: they
    must be sent unchanged. Raises DriveError if the drive lacks 60FEh:01, or if bits read back differently because the
    manufacturer reserves them.
    """
    if not io.outputs:
        return 0
    remote = drive.remote
    if not await remote.has(*OUTPUTS):
        drive.lack(OUTPUTS, "it has no such object")
    current = await remote.peek(*OUTPUTS)
    has_mask = await remote.has(*MASK)
    others = (current or 0) & ~io.outputs
    kept = 0 if has_mask else others
    # The safe values are written before the mask, since they take effect as soon as the new mask is written. Until
    # then, the old mask may enable other outputs, such as a brake.
    await _write(drive, OUTPUTS, others | io.safe, io.outputs, "safe values")
    if has_mask:
        await _write(drive, MASK, io.outputs, 0xFFFF_FFFF, "the named outputs, and no others")
    held, _ = await remote.wait_until(OUTPUTS, lambda value: not (value ^ io.safe) & io.outputs)
    if held is not None and (held ^ io.safe) & io.outputs:
        # Some drives show or store only the bits that the mask enabled when the value was written.
        await remote.write(*OUTPUTS, kept | io.safe)
        held, _ = await remote.wait_until(OUTPUTS, lambda value: not (value ^ io.safe) & io.outputs)
        _refuse_differing(drive, OUTPUTS, held, io.safe, io.outputs)
    return kept


async def check_inputs(drive: Differences) -> None:
    """Raise DriveError if the drive lacks 60FDh."""
    if not await drive.remote.has(*INPUTS):
        drive.lack(INPUTS, "it has no such object")


async def _write(drive: Differences, key: Key, value: int, bits: int, why: str) -> None:
    """Write an object unless the given bits already have their values.

    Raises DriveError if a mask reads back differently.
    """
    remote = drive.remote
    current = await remote.peek(*key)
    if current is not None and not (current ^ value) & bits:
        return
    try:
        await remote.write(*key, value)
    except SdoRefused as refusal:
        raise DriveError(f"{refusal}; this is needed for [outputs] of drive {remote.name}") from refusal
    drive.note(key, current, value, why)
    if key == MASK:
        held, _ = await remote.wait_until(key, lambda held: held == value)
        _refuse_differing(drive, key, held, value, bits)


def _refuse_differing(drive: Differences, key: Key, held: int | None, wanted: int, bits: int) -> None:
    """Raise DriveError if the given bits of the value `held` differ; None is the value of an unreadable object."""
    differing = 0 if held is None else (held ^ wanted) & bits
    if not differing or held is None:
        return
    names = ", ".join(str(bit) for bit in range(32) if differing >> bit & 1)
    raise DriveError(
        f"drive {drive.remote.name}: {title(key)} stays {shown(*key, held)}, expected {shown(*key, wanted)}: the "
        "manufacturer "
        f"reserves bit {names}; use other bits in [outputs], as in the manufacturer's manual"
    )
