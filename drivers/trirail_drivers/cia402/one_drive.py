"""Set-up of one CiA 402 drive over SDO: wait for the drive, read its objects, write and read back those that differ."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType
from typing import Final, NamedTuple

from trirail_drivers.bus.frames import send_in_setup
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.differences import Difference, Differences
from trirail_drivers.cia402.digital_io import check_inputs, configure_outputs, make_outputs_safe
from trirail_drivers.cia402.drive_units import Scaling, check_polarity, read_scaling, read_units
from trirail_drivers.cia402.dry_run import DryRun
from trirail_drivers.cia402.guarding import configure_watchdogs
from trirail_drivers.cia402.makers_objects import write_makers_objects
from trirail_drivers.cia402.objects import FOLLOWING_BIT
from trirail_drivers.cia402.operation_mode import choose_modes, configure_mode
from trirail_drivers.cia402.pdos import Pdos
from trirail_drivers.cia402.process_data import Exchange
from trirail_drivers.cia402.sdo import Remote, RestartedError, SdoRefused
from trirail_drivers.cia402.settings import (
    check_position_limits,
    configure_cycle_period,
    configure_homing,
    configure_reactions,
    heartbeat_period_ms,
)
from trirail_drivers.cia402.units import Units
from trirail_drivers.config import NO_IO, DigitalIo, Drive, Drives
from trirail_drivers.driver.conversations import LOG
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.errors import DriveAbsentError, DriveError, DriveTimeout
from trirail_drivers.interface import PowerState

HAS_POWER = (
    PowerState.SWITCHED_ON,
    PowerState.OPERATION_ENABLED,
    PowerState.QUICK_STOP_ACTIVE,
    PowerState.FAULT_REACTION_ACTIVE,
)
"""States in which current may flow in a drive's motor."""

BOOT_TIMEOUTS: Final = 10
"""Longest boot time of a drive, as a multiple of `sdo_timeout`."""


class Identity(NamedTuple):
    """Identity of a drive, as reported in its own objects."""

    device_type: int
    """Device type, 1000h."""
    vendor: int | None
    product: int | None
    revision: int | None
    serial: int | None
    """Serial number, 1018h."""
    modes: int | None
    """Supported modes, 6502h."""


class SetUp(NamedTuple):
    """Result of a drive's set-up or its dry run."""

    name: str
    node: int
    identity: Identity
    exchange: Exchange
    units: Units
    differences: tuple[Difference, ...]
    """Values that were written or, in a dry run, would be written."""
    notes: tuple[str, ...]
    """Deviations from the usual set-up, and missing protections; each note is one line for people."""
    missing_protections: tuple[str, ...]
    """Protections that the drive lacks, by their names in `accept_without`."""
    refused: str
    """Error message if the drive lacks protections that it must have, or ""."""
    home_offset: int | None = None
    """Home offset 607Ch, the zero of the drive's positions."""
    scaling: Scaling = MappingProxyType({})
    """Direction, scale and units of the drive."""


class Start(NamedTuple):
    """State of a drive at the end of its set-up."""

    counts: int
    """Actual position 6064h."""
    statusword: int
    """Statusword 6041h."""
    error_code: int
    """Error code 603Fh if the drive has an error, otherwise 0."""
    in_error: bool = False
    """Whether the error register 1001h shows an error."""
    inputs: int = 0
    """Digital inputs 60FDh if the robot uses inputs of the drive, otherwise 0."""


_COMMUNICATION_ERROR: Final = (0x10, 0x11)
"""Error registers 1001h that show only a communication error. Without a fault, it ends when the cycle begins."""


class SetupTask(NamedTuple):
    """Inputs of one drive's set-up."""

    remote: Remote
    drive: Drive
    drives: Drives
    scale: Scale
    period: float
    """Cycle period [s]."""
    io: DigitalIo = NO_IO[0]
    velocity_offset: bool = True
    """Whether the setpoints contain the velocity offset if the drive has it."""
    travel: tuple[float, float] | None = None
    """Travel of the slider [m]; None if the drive's position limits are not checked."""
    check: Callable[[Identity, Scaling | None], None] | None = None
    """Function that raises DriveError for a returning drive that is not as it was; None for a drive that is set up for
    the first time. The scaling is None if it has not been read yet.
    """


async def rehearse_setup(one: SetupTask, *, read_only: bool = False) -> SetUp:
    """Wait for a drive, remove its power, and do a dry run of its whole set-up.

    The outputs of a returning drive get their safe values before the dry run, which takes many requests. With
    `read_only`, its power and outputs are not changed either, and the drive is asked which objects may be written.
    """
    await wait_for_drive(one.remote, one.drive.node, to_pre_operational=not read_only)
    dry_run = DryRun(one.remote, read_only=read_only)
    await _switch_off(dry_run if read_only else one.remote, one.drives.stop_timeout)
    if one.check is not None and not read_only:  # its outputs may still be on
        one.check(await _read_identity(one.remote), None)
        await make_outputs_safe(one.remote, one.io)
    made = await configure_drive(one, dry_run)
    await read_start(dry_run, one.io)
    return made


async def configure_drive(one: SetupTask, remote: Remote) -> SetUp:
    """Configure one drive, or its dry run, for the cycle."""
    drive, drives = one.drive, one.drives
    differences = Differences(remote)
    modes = await choose_modes(remote, homes=drive.homing is not None)
    await write_makers_objects(differences, drive.write)
    identity = await _read_identity(remote)
    if one.check is not None:
        one.check(identity, await read_scaling(remote))
    units = await read_units(differences, drive, one.scale)
    await configure_cycle_period(differences, one.period)
    watched = await configure_watchdogs(differences, drives, heartbeat_period_ms(drives), drive.node)
    await configure_reactions(differences, drives, units)
    mode, shown = await configure_mode(differences, modes)
    if drive.homing is not None:
        await configure_homing(differences, drive.homing, units)
    if one.travel is not None:
        await check_position_limits(differences, one.scale, one.travel)
    kept = await configure_outputs(differences, one.io)
    if one.io.inputs:
        await check_inputs(differences)
    pdos = Pdos(differences, drive.node)
    setpoints, controlword = await pdos.setpoints(mode, velocity_offset=one.velocity_offset)
    if setpoints.has_velocity:
        await check_polarity(remote)
    feedback, status, polled, inputs, inputs_polled = await pdos.feedback(inputs=bool(one.io.inputs))
    outputs = await pdos.outputs() if one.io.outputs else None
    unused_rpdos, unused_tpdos = await pdos.switch_off_others()
    for key in ((0x603F, 0), (0x1001, 0)):
        if not await remote.has(*key):
            differences.lack(key, "it has no such object")
    if FOLLOWING_BIT in drive.accept_without:
        differences.missing_protections[FOLLOWING_BIT] = "the configuration says so"
    exchange = Exchange(
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
        outputs,
        kept,
        inputs,
        inputs_polled,
        unused_rpdos,
        unused_tpdos,
    )
    refused = differences.refusal(drive.accept_without)
    return SetUp(
        remote.name,
        drive.node,
        identity,
        exchange,
        units,
        tuple(differences.changes),
        tuple(filter(None, (one.remote.skipped, *differences.notes))),
        tuple(differences.missing_protections),
        refused,
        await remote.peek(0x607C),
        await read_scaling(remote),
    )


async def _read_identity(remote: Remote) -> Identity:
    vendor, product, revision, serial = [await remote.peek(0x1018, subindex) for subindex in range(1, 5)]
    device_type = await remote.peek(0x1000) or 0
    return Identity(device_type, vendor, product, revision, serial, await remote.peek(0x6502))


async def wait_for_drive(remote: Remote, node: int, *, to_pre_operational: bool) -> None:
    """Wait until the node answers, at most for the longest boot time, and check that it is a CiA 402 drive.

    The request is repeated after each time-out and, for twice the longest boot time, after each boot-up message. With
    `to_pre_operational`, the node is switched to NMT pre-operational before each repetition.
    """
    client = remote.client
    begun, longest = client.clock(), BOOT_TIMEOUTS * client.timeout
    awaited = "answer for object 1000:00 (Device type)"
    while True:
        try:
            device_type = await remote.read(0x1000)
            break
        except DriveTimeout as error:
            waited = client.clock() - begun
            if waited >= longest and client.is_stopped:
                raise DriveError(
                    f"drive {remote.name}: is in NMT stopped, in which it answers no requests; send it NMT "
                    "pre-operational, or switch it off and on"
                ) from error
            if waited >= longest:
                raise DriveAbsentError(remote.name, awaited, waited) from error
            if remote.logs and not remote.boots:
                LOG.warning("waiting for drive %s to boot", remote.name)
            remote.boots = True
        except RestartedError as error:
            waited = client.clock() - begun
            if waited >= 2 * longest:  # the drive may finish booting just before the end of the longest boot time
                raise DriveAbsentError(remote.name, f"{awaited}, only boot-up messages,", waited) from error
        if to_pre_operational:
            send_in_setup(client.bus, canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, node))
    remote.boots = False
    if device_type & 0xFFFF != 402:
        raise DriveError(
            f"drive {remote.name}: object 1000:00 (device type) is {device_type:08X}, of CiA profile "
            f"{device_type & 0xFFFF}; expected a drive, profile 402"
        )


async def _switch_off(remote: Remote, seconds: float) -> None:
    """Remove a drive's power, and wait until its state shows that, since a brake needs time to close."""
    await remote.write(0x6040, 0, canopen_frames.DISABLE_VOLTAGE)
    statusword, waited = await remote.wait_until(
        (0x6041, 0), lambda statusword: canopen_frames.power_state(statusword) not in HAS_POWER, seconds
    )
    statusword = await remote.read(0x6041) if statusword is None else statusword
    if not remote.rehearsed and canopen_frames.power_state(statusword) in HAS_POWER:
        raise DriveError(f"drive {remote.name}: did not power off within {waited:.3g} s (statusword {statusword:04X})")


async def read_start(remote: Remote, io: DigitalIo) -> Start:
    """Read the present state of a drive."""
    statusword = await remote.read(0x6041)
    in_fault = canopen_frames.power_state(statusword) in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)
    register = await _read_error(remote, 0x1001)
    in_error = register != 0 and register not in _COMMUNICATION_ERROR
    error_code = await _read_error(remote, 0x603F) if in_fault or in_error else 0
    inputs = await remote.read(0x60FD) if io.inputs else 0
    return Start(await remote.read(0x6064), statusword, error_code, in_error, inputs)


async def _read_error(remote: Remote, index: int) -> int:
    """Return the present value of an object about errors, or 0 if the drive lacks the object or refuses to read it."""
    if not await remote.has(index):
        return 0
    try:
        return await remote.read(index)
    except SdoRefused:
        return 0
