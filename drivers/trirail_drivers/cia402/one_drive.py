"""Sets one CiA 402 drive up over SDO: waits for it, reads first, writes the differences, reads them back."""

from __future__ import annotations

from typing import Final, NamedTuple

from trirail_drivers.bus.frames import send_in_setup
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.conversations import LOG
from trirail_drivers.cia402.differences import Difference, Differences
from trirail_drivers.cia402.drive_units import read_units
from trirail_drivers.cia402.dry_run import DryRun
from trirail_drivers.cia402.guarding import give_watchdogs
from trirail_drivers.cia402.makers_objects import give_makers_objects
from trirail_drivers.cia402.objects import FOLLOWING_BIT
from trirail_drivers.cia402.operation_mode import choose_modes, give_mode
from trirail_drivers.cia402.pdos import Pdos
from trirail_drivers.cia402.process_data import Exchange
from trirail_drivers.cia402.sdo import Remote, RestartedError, SdoRefused
from trirail_drivers.cia402.settings import give_cycle, give_homing, give_reactions, heartbeat_of
from trirail_drivers.cia402.units import Units
from trirail_drivers.config import Drive, Drives
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import DriveError, DriveTimeout
from trirail_drivers.interface import PowerState

HAS_POWER = (PowerState.SWITCHED_ON, PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)
"""States in which a drive may have current in its motor."""

BOOTS_WITHIN: Final = 10
"""How long a drive may take to boot, in times of `sdo_timeout`."""


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


class OneDrive(NamedTuple):
    """A drive that is to be set up."""

    remote: Remote
    drive: Drive
    drives: Drives
    scale: Scale
    period: float
    """Of the cycle [s]."""


async def look_over(one: OneDrive, *, asks: bool = False) -> SetUp:
    """Wait for a drive and go through its whole set-up without writing, but for taking its power off.

    Where it `asks`, not even that is done: the drive tells what it would take.
    """
    await greet(one.remote, one.drive.node, wakes=not asks)
    dry_run = DryRun(one.remote, asks=asks)
    await _take_power_off(dry_run if asks else one.remote, one.drives.stop_timeout)
    made = await bring(one, dry_run)
    await start(dry_run)
    return made


async def bring(one: OneDrive, remote: Remote) -> SetUp:
    """Bring one drive to what the cycle needs, or a dry run of it."""
    drive, drives = one.drive, one.drives
    differences = Differences(remote)
    modes = await choose_modes(remote, homes=drive.homing is not None)
    await give_makers_objects(differences, drive.write)
    units = await read_units(differences, drive, one.scale)
    await give_cycle(differences, one.period)
    watched = await give_watchdogs(differences, drives, heartbeat_of(drives), drive.node)
    await give_reactions(differences, drives, units)
    mode, shown = await give_mode(differences, modes)
    if drive.homing is not None:
        await give_homing(differences, drive.homing, units)
    pdos = Pdos(differences, drive.node)
    setpoints, controlword = await pdos.setpoints(mode)
    feedback, status, polled = await pdos.feedback()
    await pdos.switch_off_others()
    for key in ((0x603F, 0), (0x1001, 0)):
        if not await remote.has(*key):
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
        shown,
    )
    vendor, product, revision, serial = [await remote.peek(0x1018, subindex) for subindex in range(1, 5)]
    device_type = await remote.peek(0x1000) or 0
    identity = Identity(device_type, vendor, product, revision, serial, await remote.peek(0x6502))
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


async def greet(remote: Remote, node: int, *, wakes: bool) -> None:
    """Wait until the node answers, as long as it may take to boot, and see that it is a CiA 402 drive.

    It is asked again once its boot-up message comes, and where it `wakes`, brought to NMT pre-operational then.
    """
    client = remote.client
    begun = client.clock()
    while True:
        try:
            device_type = await remote.read(0x1000)
            break
        except DriveTimeout as error:
            waited = client.clock() - begun
            if waited >= BOOTS_WITHIN * client.timeout:
                raise DriveTimeout(remote.name, "answer about object 1000:00 (Device type)", waited) from error
            if not remote.boots:
                LOG.warning("waiting for drive %s to boot", remote.name)
            remote.boots = True
        except RestartedError:
            if wakes:
                send_in_setup(client.bus, canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, node))
    remote.boots = False
    if device_type & 0xFFFF != 402:
        raise DriveError(
            f"drive {remote.name}: object 1000:00 (device type) is {device_type:08X}, of CiA profile "
            f"{device_type & 0xFFFF}; wanted a drive, profile 402"
        )


async def _take_power_off(remote: Remote, seconds: float) -> None:
    """Tell a drive to lose its power, and wait until it has: a brake takes its time to close."""
    await remote.write(0x6040, 0, canopen_frames.DISABLE_VOLTAGE)
    found, waited = await remote.becomes(
        (0x6041, 0), lambda statusword: canopen_frames.power_state(statusword) not in HAS_POWER, seconds
    )
    statusword = await remote.read(0x6041) if found is None else found
    if not remote.rehearsed and canopen_frames.power_state(statusword) in HAS_POWER:
        raise DriveError(
            f"drive {remote.name}: keeps its power on when told off, after {waited:.3g} s (statusword {statusword:04X})"
        )


async def start(remote: Remote) -> Start:
    """What a drive says of itself now."""
    statusword = await remote.read(0x6041)
    in_fault = canopen_frames.power_state(statusword) in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)
    error_code = 0
    if in_fault and await remote.has(0x603F):
        try:
            error_code = await remote.read(0x603F)
        except SdoRefused:
            error_code = 0
    return Start(await remote.read(0x6064), statusword, error_code)
