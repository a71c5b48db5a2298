"""Sets three CiA 402 drives up side by side before the cycle runs, and refuses what cannot be on one bus."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import can

from trirail_drivers.bus.frames import send_in_setup
from trirail_drivers.cia402 import canopen_frames, eds
from trirail_drivers.cia402.one_drive import OneDrive, SetUp, Start, bring, look_over, start
from trirail_drivers.cia402.sdo import Remote, together
from trirail_drivers.cia402.sdo_client import Client
from trirail_drivers.cia402.settings import check_nodes, heartbeat_of, interpolation_periods
from trirail_drivers.config import Drives
from trirail_drivers.driver.refusals import raise_all
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES, Clock


def configure(
    bus: can.BusABC,
    drives: Drives,
    scales: tuple[Scale, ...],
    period: float,
    clock: Clock,
    fastest: float | None = None,
) -> tuple[tuple[SetUp, Start], ...]:
    """Set the three drives up for a cycle of `period` seconds; without power, and NMT operational at the end.

    `fastest` is the sliders' limit of velocity [m/s]: where it is given, the drives' units must be able to say it.

    Raises DriveError; of its kinds, ConfigurationRefused for a value that reads back differently and
    DriveTimeout for a drive that does not answer.
    """
    check_nodes(drives)
    heartbeat_of(drives)
    interpolation_periods(period)
    each = _drives(bus, drives, scales, period, clock)
    for drive in drives.each:
        send_in_setup(bus, canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, drive.node))
    # Everything is refused that can be told by reading, of every drive, before the first value is written.
    _accepted(together(bus, clock, [one.remote for one in each], "reading", [look_over(one) for one in each]))
    done = _accepted(
        together(bus, clock, [one.remote for one in each], "writing", [bring(one, one.remote) for one in each])
    )
    raise_all([found for found in (_velocity_refused(made, fastest) for made in done) if found is not None])
    for drive in drives.each:
        send_in_setup(bus, canopen_frames.nmt(canopen_frames.NMT_START, drive.node))
    starts = together(bus, clock, [one.remote for one in each], "starting", [start(one.remote) for one in each])
    raise_all([each for each in starts if isinstance(each, DriveError)])
    return tuple((made, each) for made, each in zip(done, starts, strict=True) if isinstance(each, Start))


def survey(
    bus: can.BusABC,
    drives: Drives,
    scales: tuple[Scale, ...],
    period: float,
    clock: Clock,
    fastest: float | None = None,
) -> list[SetUp | DriveError]:
    """Read what the drives are and what their set-up would change; nothing is written, no state changes."""
    each = _drives(bus, drives, scales, period, clock)
    conversations = [look_over(one, asks=True) for one in each]
    ends = together(bus, clock, [one.remote for one in each], "reading", conversations)
    return [end if isinstance(end, DriveError) else _velocity_refused(end, fastest) or end for end in ends]


def _drives(bus: can.BusABC, drives: Drives, scales: tuple[Scale, ...], period: float, clock: Clock) -> list[OneDrive]:
    asked = remotes(bus, drives, clock)
    each = zip(asked, drives.each, scales, strict=True)
    return [OneDrive(remote, drive, drives, scale, period) for remote, drive, scale in each]


def _accepted(ends: Sequence[SetUp | DriveError]) -> list[SetUp]:
    """Refuse drives that are, all in one, and those that cannot be on one bus."""
    refused = [end if isinstance(end, DriveError) else DriveError(end.refused) if end.refused else None for end in ends]
    raise_all([error for error in refused if error is not None])
    accepted = [end for end in ends if not isinstance(end, DriveError)]
    check_identifiers(accepted)
    return accepted


def _velocity_refused(made: SetUp, fastest: float | None) -> DriveError | None:
    """Why a unit of velocities is refused: not known, or unfit. A drive may refuse to map any: then it is no matter."""
    if made.way.setpoints.has_velocity:
        try:
            made.units.check_velocity(made.name, fastest)
        except DriveError as error:
            return error
    return None


def check_identifiers(done: Sequence[SetUp]) -> None:
    """Refuse two drives that hear or send frames of one identifier, as fixed ones of drives with one default do."""
    owners: dict[int, str] = {}
    for made in done:
        way = made.way
        for identifier in (way.setpoints.identifier, way.controlword, way.feedback.identifier, way.status):
            if identifier is None:
                continue
            if identifier in owners:
                raise DriveError(
                    f"drives {owners[identifier]} and {made.name}: both have a PDO with identifier {identifier:03X}h "
                    f"that cannot be changed (1400:01, 1800:01 and on); give each its own with its maker's tool"
                )
            owners[identifier] = made.name


def remotes(bus: can.BusABC, drives: Drives, clock: Clock) -> list[Remote]:
    """The three drives' dictionaries over SDO."""
    made = []
    for name, drive in zip(NAMES, drives.each, strict=True):
        objects = eds.load(name, Path(drive.eds) if drive.eds else eds.SERVO, drive.node)
        made.append(Remote(name, Client(bus, drive.node, objects, drives.sdo_timeout, clock)))
    return made
