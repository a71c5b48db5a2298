"""Concurrent set-up of three CiA 402 drives before the cycle runs, and checks that they can share a bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import can

from trirail_drivers.bus.frames import send_in_setup
from trirail_drivers.cia402 import canopen_frames, eds
from trirail_drivers.cia402.one_drive import SetUp, SetupTask, Start, configure_drive, read_start, rehearse_setup
from trirail_drivers.cia402.sdo import Remote, run_setups
from trirail_drivers.cia402.sdo_client import Client
from trirail_drivers.cia402.settings import check_nodes, heartbeat_period_ms, interpolation_periods
from trirail_drivers.config import NO_IO, DigitalIo, Drives
from trirail_drivers.driver.refusals import raise_combined
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import DriveAbsentError, DriveError
from trirail_drivers.interface import NAMES, Clock, Travel


def configure(
    bus: can.BusABC, drives: Drives, each: Sequence[SetupTask], fastest: float | None = None, *, awaits: bool = False
) -> tuple[tuple[SetUp, Start] | None, ...]:
    """Set up three drives concurrently, without power. Afterwards the drives are in NMT operational.

    `fastest` is the velocity limit of the sliders [m/s]; if it is given, it must fit the drives' units. With `awaits`,
    the result for a drive that does not answer is None.

    Raises ConfigurationRefused for a value that reads back differently, DriveTimeout for a drive that does not answer,
    and DriveError for other failures.
    """
    clock = each[0].remote.client.clock
    for drive in drives.each:
        send_in_setup(bus, canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, drive.node))
    # All checks for which reading is enough are made for all drives before the first value is written.
    looked = run_setups(bus, clock, [one.remote for one in each], "reading", [rehearse_setup(one) for one in each])
    absent = [awaits and isinstance(end, DriveAbsentError) for end in looked]
    _accepted([end for end, away in zip(looked, absent, strict=True) if not away])
    each = [one for one, away in zip(each, absent, strict=True) if not away]
    done = _accepted(
        run_setups(
            bus, clock, [one.remote for one in each], "writing", [configure_drive(one, one.remote) for one in each]
        )
    )
    raise_combined([error for error in (_velocity_refused(made, fastest) for made in done) if error is not None])
    for one in each:
        send_in_setup(bus, canopen_frames.nmt(canopen_frames.NMT_START, one.drive.node))
    states = [read_start(one.remote, one.io) for one in each]
    starts = run_setups(bus, clock, [one.remote for one in each], "starting", states)
    raise_combined([each for each in starts if isinstance(each, DriveError)])
    pairs = iter([(made, each) for made, each in zip(done, starts, strict=True) if isinstance(each, Start)])
    return tuple(None if away else next(pairs) for away in absent)


async def configure_one(one: SetupTask, fastest: float | None, check: Callable[[SetUp], None]) -> tuple[SetUp, Start]:
    """Set up one drive as `configure` does. After the dry run, `check` is called, which raises if the
    drive cannot share the bus.
    """
    bus, node = one.remote.client.bus, one.drive.node
    send_in_setup(bus, canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, node))
    looked = await rehearse_setup(one)
    _accepted([looked])
    check(looked)
    made = await configure_drive(one, one.remote)
    _accepted([made])
    if (refused := _velocity_refused(made, fastest)) is not None:
        raise refused
    send_in_setup(bus, canopen_frames.nmt(canopen_frames.NMT_START, node))
    return made, await read_start(one.remote, one.io)


def survey(
    bus: can.BusABC,
    drives: Drives,
    scales: tuple[Scale, ...],
    period: float,
    clock: Clock,
    fastest: float | None = None,
    io: Sequence[DigitalIo] = NO_IO,
    *,
    velocity_offset: bool = True,
    travel: Travel | None = None,
) -> list[SetUp | DriveError]:
    """Read the identity of each drive and find the values that its set-up would change.

    Nothing is written, and no state of a drive is changed.
    """
    each = _drives(bus, drives, scales, period, clock, io, velocity_offset=velocity_offset, travel=travel)
    conversations = [rehearse_setup(one, read_only=True) for one in each]
    ends = run_setups(bus, clock, [one.remote for one in each], "reading", conversations)
    return [end if isinstance(end, DriveError) else _velocity_refused(end, fastest) or end for end in ends]


def setup_tasks(
    bus: can.BusABC,
    drives: Drives,
    scales: tuple[Scale, ...],
    period: float,
    clock: Clock,
    io: Sequence[DigitalIo] = NO_IO,
    *,
    velocity_offset: bool = True,
    travel: Travel | None = None,
) -> list[SetupTask]:
    """Return the set-up tasks of the three drives, given the cycle period [s], the drives' digital I/O, whether the
    setpoints contain the velocity offset, and the `travel` of each slider [m].

    Raises DriveError for settings that no drive can accept.
    """
    check_nodes(drives)
    heartbeat_period_ms(drives)
    interpolation_periods(period)
    return _drives(bus, drives, scales, period, clock, io, velocity_offset=velocity_offset, travel=travel)


def _drives(
    bus: can.BusABC,
    drives: Drives,
    scales: tuple[Scale, ...],
    period: float,
    clock: Clock,
    io: Sequence[DigitalIo],
    *,
    velocity_offset: bool,
    travel: Travel | None,
) -> list[SetupTask]:
    asked = remotes(bus, drives, clock)
    each = zip(asked, drives.each, scales, io, travel or (None, None, None), strict=True)
    return [
        SetupTask(remote, drive, drives, scale, period, digital, velocity_offset, own)
        for remote, drive, scale, digital, own in each
    ]


def _accepted(ends: Sequence[SetUp | DriveError]) -> list[SetUp]:
    """Return the set-ups if all drives are accepted and can share a bus; otherwise raise the errors of all drives as
    one.
    """
    refused = [end if isinstance(end, DriveError) else DriveError(end.refused) if end.refused else None for end in ends]
    raise_combined([error for error in refused if error is not None])
    accepted = [end for end in ends if not isinstance(end, DriveError)]
    check_identifiers(accepted)
    return accepted


def _velocity_refused(made: SetUp, fastest: float | None) -> DriveError | None:
    """Return an error if a velocity is mapped whose unit is unknown or does not fit, otherwise None."""
    if made.exchange.setpoints.has_velocity:
        try:
            made.units.check_velocity(made.name, fastest)
        except DriveError as error:
            return error
    return None


def check_identifiers(done: Sequence[SetUp]) -> None:
    """Raise DriveError if PDOs, EMCYs or SYNC share an identifier, such as equal defaults that are fixed.

    Only unused RPDOs that stay on may share an identifier, if nobody sends it.
    """
    owners = {canopen_frames.SYNC: "SYNC"}
    for made in done:
        for identifier in (*sorted(made.exchange.identifiers), *sorted(made.exchange.unused_tpdos)):
            if identifier in owners:
                raise _shared_identifier(identifier, owners[identifier], made.name)
            owners[identifier] = f"drive {made.name}"
    for made in done:
        for identifier in sorted(made.exchange.unused_rpdos & owners.keys()):
            raise _shared_identifier(identifier, owners[identifier], made.name)


def _shared_identifier(identifier: int, owner: str, name: str) -> DriveError:
    shared = "more than one PDO or its EMCY has" if owner == f"drive {name}" else f"shares with {owner} the"
    return DriveError(
        f"drive {name}: {shared} identifier {identifier:03X}h that cannot be changed or switched off (1014, 1400:01, "
        "1800:01 and on); give each PDO and EMCY its own identifier with the manufacturer's tool"
    )


def remotes(bus: can.BusABC, drives: Drives, clock: Clock) -> list[Remote]:
    """Return the object dictionaries of the three drives over SDO."""
    made = []
    for name, drive in zip(NAMES, drives.each, strict=True):
        objects, skipped = eds.load(name, Path(drive.eds) if drive.eds else eds.SERVO, drive.node)
        made.append(Remote(name, Client(bus, drive.node, objects, drives.sdo_timeout, clock), skipped))
    return made
