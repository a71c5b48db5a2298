"""Description of the drives on the bus and of the values that their set-up changes, for `trirail drives`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import can

from trirail_drivers.cia402 import canopen_frames, process_data, setup
from trirail_drivers.cia402.one_drive import SetUp
from trirail_drivers.cia402.other_masters import exclusive_bus
from trirail_drivers.cia402.sdo import SdoRefused, run_setups
from trirail_drivers.config import NO_IO, DigitalIo, Drives
from trirail_drivers.driver.refusals import raise_combined
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES, Clock, Travel
from trirail_drivers.timing import DEFAULT_TIMING, BusTiming


def inspect(
    bus: can.BusABC,
    drives: Drives,
    period: float,
    clock: Clock,
    fastest: float | None = None,
    *,
    apply: bool,
    io: Sequence[DigitalIo] = NO_IO,
    timing: BusTiming = DEFAULT_TIMING,
    travel: Travel | None = None,
) -> list[dict[str, Any]]:
    """Return a description of each drive, with the differences between its values and those that the cycle needs.

    `fastest` is the velocity limit of the sliders [m/s], which must fit the drives' units; `io` contains the digital
    outputs and inputs of each drive, `timing` contains the bit rates of the bus, and `travel` [m] is that of each
    slider, which the drives' position limits must contain. "bus_load" is the worst-case load
    of the bus with the PDOs that the drives can map, or None unless all three drives were read.

    With `apply`, the required values are written to all three drives or, if one of them is refused, to none. The drives
    have no power then and do not store the values permanently. Without `apply`, nothing is written. "refused" contains
    the reason if a drive does not answer or is refused. Raises DriveError if `apply` fails, or if another master is on
    the bus, which could be moving the robot and whose SDO requests would mix with these.
    """
    # A drive may send SYNC until its set-up: 1005h bit 30 is one of the values that are corrected.
    with exclusive_bus(bus, drives, clock, allow_sync=True) as watched:
        return _inspect(watched, drives, period, clock, fastest, apply=apply, io=io, timing=timing, travel=travel)


def _inspect(
    bus: can.BusABC,
    drives: Drives,
    period: float,
    clock: Clock,
    fastest: float | None,
    *,
    apply: bool,
    io: Sequence[DigitalIo],
    timing: BusTiming,
    travel: Travel | None,
) -> list[dict[str, Any]]:
    scales = tuple(scale_of(name, drive) for name, drive in zip(NAMES, drives.each, strict=True))
    offset = process_data.plan_traffic(drives, io, 1.0 / period, timing).velocity_offset
    if apply:
        results = _inspect(bus, drives, period, clock, fastest, apply=False, io=io, timing=timing, travel=travel)
        refused = dict.fromkeys(each["refused"] for each in results if each["refused"])
        raise_combined([DriveError(text) for text in refused])
        tasks = setup.setup_tasks(bus, drives, scales, period, clock, io, velocity_offset=offset, travel=travel)
        made = [result[0] for result in setup.configure(bus, drives, tasks, fastest) if result is not None]
        for drive in drives.each:
            bus.send(canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, drive.node).message())
        load = _bus_load(made, drives, period, timing)
        return [_as_json(each, load) for each in made]
    ends = setup.survey(bus, drives, scales, period, clock, fastest, io, velocity_offset=offset, travel=travel)
    looked = [end for end in ends if not isinstance(end, DriveError)]
    load = _bus_load(looked, drives, period, timing)
    results = [
        {"name": name, "node": drive.node, "refused": str(end)} if isinstance(end, DriveError) else _as_json(end, load)
        for name, drive, end in zip(NAMES, drives.each, ends, strict=True)
    ]
    try:
        setup.check_identifiers(looked)
    except DriveError as error:
        for each in results:
            each["refused"] = each["refused"] or str(error)
    return results


def inputs(bus: can.BusABC, drives: Drives, clock: Clock) -> Callable[[str], int | None]:
    """Return a function that reads the digital inputs 60FDh of a named drive, or None if the drive refuses to be read.

    The function raises DriveError if the drive does not answer. It waits for the answer and drops other frames. Use it
    only while the drives have no power, between two cycles.
    """
    remotes = {remote.name: remote for remote in setup.remotes(bus, drives, clock)}

    def read(name: str) -> int | None:
        remote = remotes[name]
        (value,) = run_setups(bus, clock, [remote], "reading", [remote.read(0x60FD)])
        if isinstance(value, SdoRefused):
            return None
        if isinstance(value, DriveError):
            raise value
        return value

    return read


def _bus_load(made: Sequence[SetUp], drives: Drives, period: float, timing: BusTiming) -> float | None:
    if len(made) < len(NAMES):
        return None
    return process_data.traffic(each.exchange for each in made).bus_load(1.0 / period, timing, drives.heartbeat)


def _as_json(made: SetUp, load: float | None) -> dict[str, Any]:
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
        "setpoint_bytes": made.exchange.setpoints.size,
        "bus_load": load,
        "velocity_unit": made.units.velocity_name,
        "acceleration_unit": made.units.acceleration_name,
        "differences": [difference._asdict() for difference in made.differences],
        "notes": list(made.notes),
        "lacking": list(made.missing_protections),
        "refused": made.refused,
    }
