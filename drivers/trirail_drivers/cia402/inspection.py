"""Who is on the bus and what its set-up would change, as plain values: what `trirail drives` prints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import can

from trirail_drivers.cia402 import canopen_frames, setup
from trirail_drivers.cia402.one_drive import SetUp
from trirail_drivers.cia402.sdo import together
from trirail_drivers.config import Drives
from trirail_drivers.driver.refusals import raise_all
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import BusError, DriveError
from trirail_drivers.interface import NAMES, Clock


def inspect(
    bus: can.BusABC, drives: Drives, period: float, clock: Clock, fastest: float | None = None, *, apply: bool
) -> list[dict[str, Any]]:
    """What each drive is, and the differences between what it holds and what the cycle needs.

    `fastest` is the sliders' limit of velocity [m/s], which their units must be able to say.

    With `apply` the differences are written, to all three or none of them, without power and never stored in a drive;
    else nothing is written. A drive that does not answer, or is refused, is told of in "refused". Raises DriveError
    where `apply` fails.
    """
    scales = tuple(scale_of(name, drive) for name, drive in zip(NAMES, drives.each, strict=True))
    if apply:
        found = inspect(bus, drives, period, clock, fastest, apply=False)
        refused = dict.fromkeys(each["refused"] for each in found if each["refused"])
        raise_all([DriveError(text) for text in refused])
        done = setup.configure(bus, drives, scales, period, clock, fastest)
        for drive in drives.each:
            bus.send(canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, drive.node).message())
        return [_as_json(made) for made, _ in done]
    ends = setup.survey(bus, drives, scales, period, clock, fastest)
    looked = [end for end in ends if not isinstance(end, DriveError)]
    found = [
        {"name": name, "node": drive.node, "refused": str(end)} if isinstance(end, DriveError) else _as_json(end)
        for name, drive, end in zip(NAMES, drives.each, ends, strict=True)
    ]
    try:
        setup.check_identifiers(looked)
    except DriveError as error:
        for each in found:
            each["refused"] = each["refused"] or str(error)
    return found


def inputs(bus: can.BusABC, drives: Drives, clock: Clock) -> Callable[[str], int | None]:
    """Return what reads the digital inputs 60FDh of the drive of a name; None where it has none to tell.

    It waits for the answer and lets other frames go: for drives without power, between two cycles.
    """
    remotes = {remote.name: remote for remote in setup.remotes(bus, drives, clock)}

    def read(name: str) -> int | None:
        remote = remotes[name]
        try:
            (found,) = together(bus, clock, [remote], "reading", [remote.read(0x60FD)])
        except BusError:
            return None
        return None if isinstance(found, DriveError) else found

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
        "way": made.way.name,
        "velocity_unit": made.units.velocity_name,
        "acceleration_unit": made.units.acceleration_name,
        "differences": [difference._asdict() for difference in made.differences],
        "notes": list(made.notes),
        "lacking": list(made.lacking),
        "refused": made.refused,
    }
