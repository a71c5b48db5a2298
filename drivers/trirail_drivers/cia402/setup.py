"""Sets CiA 402 drives up over SDO before the cycle runs: reads first, writes the differences, reads them back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import can

from trirail_drivers.bus.frames import Frame
from trirail_drivers.cia402 import eds, frames
from trirail_drivers.cia402.differences import Difference, Differences
from trirail_drivers.cia402.drive_units import read_units
from trirail_drivers.cia402.guarding import give_watchdogs
from trirail_drivers.cia402.modes import choose_mode, give_mode
from trirail_drivers.cia402.objects import FOLLOWING_BIT
from trirail_drivers.cia402.pdos import Pdos
from trirail_drivers.cia402.sdo import Client, Rehearsal, Remote, SdoRefused
from trirail_drivers.cia402.settings import (
    check_nodes,
    give_cycle,
    give_homing,
    give_reactions,
    heartbeat_of,
    interpolation_periods,
)
from trirail_drivers.cia402.units import Units
from trirail_drivers.cia402.ways import Exchange
from trirail_drivers.config import Drive, Drives
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import BusError, DriveError
from trirail_drivers.interface import NAMES, Clock, PowerState

HAS_POWER = (PowerState.SWITCHED_ON, PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)
"""States in which a drive may have current in its motor."""


class Identity(NamedTuple):
    """Who a drive says it is."""

    device_type: int
    """1000h."""
    vendor: int | None
    product: int | None
    revision: int | None
    serial: int | None
    """1018h."""
    modes: int | None
    """6502h."""


class SetUp(NamedTuple):
    """What is known of a drive once it was looked at, or set up."""

    name: str
    node: int
    identity: Identity
    way: Exchange
    units: Units
    differences: tuple[Difference, ...]
    """What was written, or would be."""
    notes: tuple[str, ...]
    """What is done otherwise than usual, and the protections that it lacks: lines for people."""
    lacking: tuple[str, ...]
    """Protections that it lacks, as `accept_without` names them."""
    refused: str
    """Why it is refused for those; "" where it is not."""


class Start(NamedTuple):
    """What a drive says of itself once it is set up."""

    counts: int
    """Actual position 6064h."""
    statusword: int
    """6041h."""
    error_code: int
    """603Fh if the drive is in fault, else 0."""


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
    asked = remotes(bus, drives, clock)
    for drive in drives.each:
        _send(bus, frames.nmt(frames.NMT_PRE_OPERATIONAL, drive.node))
    for remote in asked:
        _check_is_servo(remote)
        _take_power_off(remote)
    # Everything is refused that can be told by reading, of every drive, before the first value is written.
    rehearsed = [
        _rehearse(remote, drive, drives, scale, period, asks=False)
        for remote, drive, scale in zip(asked, drives.each, scales, strict=True)
    ]
    _check(rehearsed)
    done = [
        _bring(remote, drive, drives, scale, period)
        for remote, drive, scale in zip(asked, drives.each, scales, strict=True)
    ]
    _check(done)
    for made in done:
        _check_velocity(made, fastest)
    for drive in drives.each:
        _send(bus, frames.nmt(frames.NMT_START, drive.node))
    return tuple((made, _start(remote)) for made, remote in zip(done, asked, strict=True))


def look(
    bus: can.BusABC,
    name: str,
    drives: Drives,
    scale: Scale,
    period: float,
    clock: Clock,
    fastest: float | None = None,
) -> SetUp:
    """Read what the drive called `name` is and what its set-up would change; nothing is written, no state changes."""
    at = NAMES.index(name)
    made = _rehearse(remotes(bus, drives, clock)[at], drives.each[at], drives, scale, period, asks=True)
    _check_velocity(made, fastest)
    return made


def _rehearse(remote: Remote, drive: Drive, drives: Drives, scale: Scale, period: float, *, asks: bool) -> SetUp:
    """Go through the whole set-up of a drive without writing; where it `asks`, the drive tells what it would take."""
    rehearsal = Rehearsal(remote, asks=asks)
    _check_is_servo(rehearsal)
    _take_power_off(rehearsal)
    made = _bring(rehearsal, drive, drives, scale, period)
    _start(rehearsal)
    return made


def _check(made: Sequence[SetUp]) -> None:
    for each in made:
        if each.refused:
            raise DriveError(each.refused)
    check_identifiers(made)


def _check_velocity(made: SetUp, fastest: float | None) -> None:
    """Refuse a unit of velocities that is not known, or unfit. A drive may refuse to map any: then it is no matter."""
    if made.way.setpoints.has_velocity:
        made.units.check_velocity(made.name, fastest)


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


def told(made: Iterable[SetUp]) -> list[str]:
    """What people should know of drives, a line each: what is so of several is said once."""
    names: dict[str, list[str]] = {}
    for each in made:
        for note in each.notes:
            names.setdefault(note, []).append(each.name)
    return [f"drive{'s' * (len(of) > 1)} {', '.join(of)}: {note}" for note, of in names.items()]


def remotes(bus: can.BusABC, drives: Drives, clock: Clock) -> list[Remote]:
    """The three drives' dictionaries over SDO."""
    made = []
    for name, drive in zip(NAMES, drives.each, strict=True):
        objects = eds.load(name, Path(drive.eds) if drive.eds else eds.SERVO, drive.node)
        made.append(Remote(name, Client(bus, drive.node, objects, drives.sdo_timeout, clock)))
    return made


def _bring(remote: Remote, drive: Drive, drives: Drives, scale: Scale, period: float) -> SetUp:
    """Bring one drive to what the cycle needs."""
    differences = Differences(remote)
    mode = choose_mode(remote, homes=drive.homing is not None)
    units = read_units(differences, drive, scale)
    give_cycle(differences, period)
    watched = give_watchdogs(differences, drives, heartbeat_of(drives), drive.node)
    give_reactions(differences, drives, units)
    give_mode(differences, mode)
    if drive.homing is not None:
        give_homing(differences, drive.homing, units)
    pdos = Pdos(differences, drive.node)
    setpoints, controlword = pdos.setpoints(mode)
    feedback, status, polled = pdos.feedback()
    pdos.switch_off_others()
    for key in ((0x603F, 0), (0x1001, 0)):
        if not remote.has(*key):
            differences.lack(key, "it has no such object")
    if FOLLOWING_BIT in drive.accept_without:
        differences.lacking[FOLLOWING_BIT] = "the configuration says so"
    way = Exchange(
        mode,
        setpoints,
        controlword,
        feedback,
        status,
        polled,
        watched.guarded,
        watched.heard,
        watched.emergency,
        FOLLOWING_BIT not in drive.accept_without,
    )
    vendor, product, revision, serial = (remote.look(0x1018, subindex) for subindex in range(1, 5))
    identity = Identity(remote.look(0x1000) or 0, vendor, product, revision, serial, remote.look(0x6502))
    refused = differences.refusal(drive.accept_without)
    return SetUp(
        remote.name,
        drive.node,
        identity,
        way,
        units,
        tuple(differences.found),
        tuple(differences.notes),
        tuple(differences.lacking),
        refused,
    )


def _send(bus: can.BusABC, frame: Frame) -> None:
    try:
        bus.send(frame.message())
    except (can.CanError, OSError) as error:
        raise BusError(f"cannot send on {bus.channel_info}: {error}; is the interface up?") from error


def _check_is_servo(remote: Remote) -> None:
    """The node is there, and is a CiA 402 drive."""
    device_type = remote.read(0x1000)
    if device_type & 0xFFFF != 402:
        raise DriveError(
            f"drive {remote.name}: object 1000:00 (device type) is {device_type:08X}, of CiA profile "
            f"{device_type & 0xFFFF}; wanted a drive, profile 402"
        )


def _take_power_off(remote: Remote) -> None:
    remote.write(0x6040, 0, frames.DISABLE_VOLTAGE)
    statusword = remote.read(0x6041)
    if not remote.rehearsed and frames.power_state(statusword) in HAS_POWER:
        raise DriveError(f"drive {remote.name}: keeps its power on when told off (statusword {statusword:04X})")


def _start(remote: Remote) -> Start:
    statusword = remote.read(0x6041)
    in_fault = frames.power_state(statusword) in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)
    error_code = 0
    if in_fault and remote.has(0x603F):
        try:
            error_code = remote.read(0x603F)
        except SdoRefused:
            error_code = 0
    return Start(remote.read(0x6064), statusword, error_code)
