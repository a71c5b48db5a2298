"""Description of the drives on the bus and of the values that their set-up changes, for `trirail drives`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import can

from trirail_drivers.cia402 import canopen_frames, setup
from trirail_drivers.cia402.one_drive import SetUp
from trirail_drivers.cia402.sdo import run_setups
from trirail_drivers.config import NO_IO, DigitalIo, Drives
from trirail_drivers.driver.refusals import raise_combined
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import BusError, DriveError
from trirail_drivers.interface import NAMES, Clock


def inspect(
    bus: can.BusABC,
    drives: Drives,
    period: float,
    clock: Clock,
    fastest: float | None = None,
    *,
    apply: bool,
    io: Sequence[DigitalIo] = NO_IO,
) -> list[dict[str, Any]]:
    """Return a description of each drive, with the differences between its values and those that the cycle needs.

    `fastest` is the velocity limit of the sliders [m/s], which must fit the drives' units; `io` contains the digital
    outputs and inputs of each drive.

    With `apply`, the required values are written to all three drives or, if one of them is refused, to none. The drives
    have no power then and do not store the values permanently. Without `apply`, nothing is written. "refused" contains
    the reason if a drive does not answer or is refused. Raises DriveError if `apply` fails.
    """
    scales = tuple(scale_of(name, drive) for name, drive in zip(NAMES, drives.each, strict=True))
    if apply:
        results = inspect(bus, drives, period, clock, fastest, apply=False, io=io)
        refused = dict.fromkeys(each["refused"] for each in results if each["refused"])
        raise_combined([DriveError(text) for text in refused])
        done = setup.configure(bus, drives, setup.setup_tasks(bus, drives, scales, period, clock, io), fastest)
        for drive in drives.each:
            bus.send(canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, drive.node).message())
        return [_as_json(result[0]) for result in done if result is not None]
    ends = setup.survey(bus, drives, scales, period, clock, fastest, io)
    looked = [end for end in ends if not isinstance(end, DriveError)]
    results = [
        {"name": name, "node": drive.node, "refused": str(end)} if isinstance(end, DriveError) else _as_json(end)
        for name, drive, end in zip(NAMES, drives.each, ends, strict=True)
    ]
    try:
        setup.check_identifiers(looked)
    except DriveError as error:
        for each in results:
            each["refused"] = each["refused"] or str(error)
    return results


def inputs(bus: can.BusABC, drives: Drives, clock: Clock) -> Callable[[str], int | None]:
    """Return a function that reads the digital inputs 60FDh of a named drive; it returns None if reading fails.

    The function waits for the answer and drops other frames. Use it only while the drives have no power, between two
    cycles.
    """
    remotes = {remote.name: remote for remote in setup.remotes(bus, drives, clock)}

    def read(name: str) -> int | None:
        remote = remotes[name]
        try:
            (value,) = run_setups(bus, clock, [remote], "reading", [remote.read(0x60FD)])
        except BusError:
            return None
        return None if isinstance(value, DriveError) else value

    return read


def _as_json(made: SetUp) -> dict[str, Any]:
    who = made.identity
    return {
        "name": made.name,
        "node": made.node,
        "device_type": f"{who.device_type:08X}",
        "vendor": who.vendor,
        "product": who.product,
        "revision": who.revision,
        "serial": who.serial,
        "modes": None if who.modes is None else f"{who.modes & 0xFFFF_FFFF:08X}",
        "way": made.exchange.name,
        "velocity_unit": made.units.velocity_name,
        "acceleration_unit": made.units.acceleration_name,
        "differences": [difference._asdict() for difference in made.differences],
        "notes": list(made.notes),
        "lacking": list(made.missing_protections),
        "refused": made.refused,
    }
