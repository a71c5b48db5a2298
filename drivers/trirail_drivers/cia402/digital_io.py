"""Set-up of a CiA 402 drive's digital outputs 60FEh and inputs 60FDh."""

from __future__ import annotations

from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.pdos import Pdos
from trirail_drivers.config import DigitalIo
from trirail_drivers.errors import ConfigurationRefused, DriveError


async def configure_digital_io(drive: Differences, pdos: Pdos, io: DigitalIo) -> tuple[int | None, int | None]:
    """Map what is used of them; return the identifiers of the outputs' RPDO and of the inputs' TPDO.

    The mask 60FEh:02 gets the bits of the configuration alone, since other bits belong to the drive: bit 0 sets the
    brake (CiA 402-2). An output that cannot be mapped is written by SDO, and its identifier is None.

    Raises DriveError where the drive lacks an object, or keeps a bit for itself.
    """
    name = drive.remote.name
    outputs = inputs = None
    if io.outputs:
        for key in ((0x60FE, 1), (0x60FE, 2)):
            if not await drive.remote.has(*key):
                raise DriveError(
                    f"drive {name}: lacks object {key[0]:04X}:{key[1]:02X} (digital outputs); leave its [outputs] out"
                )
        held = await drive.remote.peek(0x60FE, 1) or 0
        try:
            # The value first: where the mask is set before it, an output would show its old value for a moment.
            await drive.ensure(0x60FE, 1, held & ~io.outputs | io.safe)
            await drive.ensure(0x60FE, 2, io.outputs)
        except ConfigurationRefused as error:
            raise DriveError(
                f"drive {name}: keeps bits of its digital outputs for itself ({error}); use other bits in [outputs]"
            ) from error
        outputs = await pdos.outputs()
        if outputs is None:
            drive.add_note("60FE cannot be mapped: its digital outputs are written by SDO, and cannot switch on a path")
    if io.inputs:
        if not await drive.remote.has(0x60FD):
            raise DriveError(f"drive {name}: lacks object 60FD (digital inputs); leave its [inputs] out")
        inputs = await pdos.inputs()
    return outputs, inputs
