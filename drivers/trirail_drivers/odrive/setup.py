"""Set-up of ODrives before or during the cycle: find the drives, remove their power, and check their settings.

The set-up writes no settings. The following settings must have been made with ODrive's own tools, and saved:

- `axis0.config.can.node_id`; `heartbeat_msg_rate_ms` as in [drives]; `encoder_msg_rate_ms = 0` and the other cyclic
  messages off, since the driver requests every message that it needs, and other messages would only load the bus;
- `axis0.config.can.input_vel_scale = 1000`, the default;
- `axis0.controller.config.absolute_setpoints = True`. With False, the default, positions count from the place where the
  drive was switched on, although the encoder is absolute;
- `axis0.config.enable_watchdog = True`, with a `watchdog_timeout` of several cycles. Only the watchdog disarms a drive
  whose host has failed; every setpoint restarts the time-out;
- gains, velocity and current limits, and a calibrated encoder that keeps its position without power.

All settings except the last group are read by RxSdo and TxSdo, and count as protections; see odrive.protections.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import can

from trirail_drivers.config import Drive, Drives
from trirail_drivers.driver.axis import MISSED_HEARTBEATS
from trirail_drivers.driver.conversations import run_concurrently
from trirail_drivers.driver.duplicate_node import warning
from trirail_drivers.driver.refusals import raise_combined, review_protections
from trirail_drivers.errors import DriveAbsentError, DriveError, DriveTimeout
from trirail_drivers.interface import NAMES, Clock
from trirail_drivers.odrive import cansimple, settings
from trirail_drivers.odrive.cansimple import AxisState, Error
from trirail_drivers.odrive.client import OdriveClient
from trirail_drivers.odrive.flat_endpoints import Version
from trirail_drivers.odrive.protections import (
    ABSOLUTE_SETPOINTS,
    PROTECTIONS,
    UNCHECKED,
    check_watchdog,
    missing_protections,
    relative_position,
)

MIN_FIRMWARE: Final = (0, 6, 0)
"""First firmware version whose errors and heartbeats have the layout that this driver reads."""
BOOT_TIMEOUTS: Final = 10
"""Longest boot time of a drive, as a multiple of `sdo_timeout`."""


def check_nodes(drives: Drives) -> None:
    """Raise DriveError for node ids that are not valid in CANSimple, or that two drives share."""
    nodes = {f"drives.{name}.node": drive.node for name, drive in zip(NAMES, drives.each, strict=True)}
    for key, node in nodes.items():
        if node not in cansimple.NODES:
            raise DriveError(f"{key} = {node}: the node id of an ODrive is 0 to {cansimple.NODES[-1]}")
    if len(set(nodes.values())) < len(nodes):
        raise DriveError(f"node ids must differ, but are {', '.join(f'{key} = {node}' for key, node in nodes.items())}")


class OdriveSetupTask(NamedTuple):
    """Inputs of one drive's set-up."""

    client: OdriveClient
    drive: Drive
    drives: Drives
    period: float
    """Cycle period [s]."""


class OdriveIdentity(NamedTuple):
    """Identity of a drive, as reported in its own messages."""

    version: Version
    serial: int | None
    """Serial number; None if the drive does not report it."""


class OdriveSetup(NamedTuple):
    """Result of a drive's set-up."""

    name: str
    identity: OdriveIdentity
    relative: bool | None
    """Whether the drive loses its position when it loses its supply; None if this is not known."""
    missing_protections: tuple[str, ...]
    """Protections that the drive lacks, by their names in `accept_without`."""
    notes: tuple[str, ...]
    """Notes for people, one line each."""


class OdriveStart(NamedTuple):
    """State of a drive at the end of its set-up."""

    turns: float
    """Position estimate [turns]."""
    errors: int
    """Active errors and disarm reason."""
    state: int
    """Axis state."""


def setup_tasks(bus: can.BusABC, drives: Drives, period: float, clock: Clock) -> list[OdriveSetupTask]:
    """Return the set-up tasks of the three drives, given the cycle period [s]."""
    return [
        OdriveSetupTask(OdriveClient(bus, name, drive.node, drives.sdo_timeout, clock), drive, drives, period)
        for name, drive in zip(NAMES, drives.each, strict=True)
    ]


def configure(
    bus: can.BusABC, each: Sequence[OdriveSetupTask], clock: Clock, *, awaits: bool = False
) -> tuple[tuple[OdriveSetup, OdriveStart] | None, ...]:
    """Set up three drives concurrently. With `awaits`, the result for a drive that does not answer is None.

    Raises DriveError with the errors of all drives. If only one drive has an error, this error is raised unchanged,
    such as DriveTimeout if the drive does not answer.
    """

    def progress() -> str:
        answers = "; ".join(f"{one.client.name} {one.client.answered} answers" for one in each)
        return f"set-up of the drives: {answers}"

    ends = run_concurrently(bus, clock, [configure_one(one, lambda _: None) for one in each], progress)
    kept = [None if awaits and isinstance(end, DriveAbsentError) else end for end in ends]
    raise_combined([end for end in kept if isinstance(end, DriveError)])
    return tuple(None if isinstance(end, DriveError) else end for end in kept)


async def configure_one(
    one: OdriveSetupTask, check: Callable[[OdriveIdentity], None]
) -> tuple[OdriveSetup, OdriveStart]:
    """Remove power from a drive; check that it answers, has the required settings and knows its position.

    `check` raises an error for a wrong drive. Raises DriveError, DriveTimeout if the drive does not answer, or
    DriveAbsentError if it has not answered any request. Errors that the drive itself reports cause no exception.
    """
    client, name = one.client, one.client.name
    _command_idle(client)
    version = await _read_version(one)
    if version.firmware < MIN_FIRMWARE:
        raise DriveError(f"drive {name}: {version.description} is too old; update to 0.6.0 or newer")
    state = await _wait_until_idle(one)
    serial = await _read_serial(client) if version.firmware >= cansimple.ADDRESS_FIRMWARE else None
    check(OdriveIdentity(version, serial))
    read = await settings.read(client, version, one.drive.endpoints)
    lacks = missing_protections(read, one.drives)
    remedy = "set them with odrivetool" if read is not None else ""
    refused, notes = review_protections(name, lacks, one.drive.accept_without, PROTECTIONS, remedy)
    if refused:
        raise DriveError(refused)
    check_watchdog(name, read, one.period)
    errors = _unpacked(client, cansimple.ERRORS, await client.request(cansimple.GET_ERROR, "Get_Error"))
    estimates = await client.request(cansimple.GET_ENCODER_ESTIMATES, "Get_Encoder_Estimates")
    turns, _ = _unpacked(client, cansimple.ESTIMATES, estimates)
    if not math.isfinite(turns):
        raise DriveError(f"drive {name}: position estimate is {turns}; check that its encoder has been calibrated")
    reason = relative_position(read)
    known = read is not None and ABSOLUTE_SETPOINTS in read
    relative = True if reason else False if known else None
    notes += [note for note in (reason, "" if known or read is None else UNCHECKED) if note]
    made = OdriveSetup(name, OdriveIdentity(version, serial), relative, tuple(lacks), tuple(notes))
    return made, OdriveStart(turns, errors[0] | errors[1], state)


async def _read_version(one: OdriveSetupTask) -> Version:
    client = one.client
    deadline = client.clock() + MISSED_HEARTBEATS * one.drives.heartbeat
    answers = await client.request_all(cansimple.GET_VERSION)
    if not answers:
        has_heartbeat = await client.heartbeat(deadline) is not None
        # The drive may have been switched on after the first requests.
        answers = await client.request_all(cansimple.GET_VERSION) if has_heartbeat else []
        if has_heartbeat and not answers and await client.try_request(cansimple.GET_ENCODER_ESTIMATES) is not None:
            raise DriveError(
                f"drive {client.name}: has no Get_Version; its firmware is too old; update to 0.6.0 or newer"
            )
        if not answers:
            raise client.timeout_error("Get_Version")
    versions = [Version.from_fields(*_unpacked(client, cansimple.VERSION, answer)) for answer in answers]
    _check_single(client, [version.description for version in versions])
    return versions[0]


async def _read_serial(client: OdriveClient) -> int | None:
    """Return the serial number of a drive; None if the drive does not answer, or if its answer is too short."""
    answers = await client.request_all(cansimple.ADDRESS)
    serials = [serial for answer in answers if (serial := cansimple.serial_number(answer)) is not None]
    _check_single(client, [f"serial number {serial:012X}" for serial in serials])
    return serials[0] if serials else None


def _check_single(client: OdriveClient, answers: list[str]) -> None:
    """Raise DriveError if the different answers to one request show that two nodes have the drive's id."""
    first, *others = dict.fromkeys(answers) or ("",)
    if others:
        problem = warning(client.node, f"{first} and {others[0]} answer")
        raise DriveError(f"drive {client.name}: {problem}")


def _command_idle(client: OdriveClient) -> None:
    client.command(cansimple.SET_AXIS_STATE, cansimple.AXIS_STATE.pack(AxisState.IDLE))


async def _wait_until_idle(one: OdriveSetupTask) -> int:
    """Wait until a drive has booted and its heartbeat shows that it is idle, at most for the longest boot time.

    Return the axis state.
    """
    client = one.client
    begun, within = client.clock(), MISSED_HEARTBEATS * one.drives.heartbeat
    state: int | None = None
    while True:
        data = await client.heartbeat(begun + within)
        if data is None:
            raise _idle_error(client, state, within)
        errors, state, _, _ = _unpacked(client, cansimple.BEAT, data)
        if state == AxisState.IDLE and not (errors & Error.INITIALIZING and await _is_initializing(client)):
            return state
        if state in (AxisState.IDLE, AxisState.UNDEFINED):
            within = max(within, BOOT_TIMEOUTS * client.timeout)
        else:  # commanded again after each heartbeat, since a command may be lost
            _command_idle(client)


async def _is_initializing(client: OdriveClient) -> bool:
    """Whether INITIALIZING is an active error. In a heartbeat, it may be a disarm reason, which outlasts the boot."""
    active, _ = _unpacked(client, cansimple.ERRORS, await client.request(cansimple.GET_ERROR, "Get_Error"))
    return bool(active & Error.INITIALIZING)


def _idle_error(client: OdriveClient, state: int | None, within: float) -> DriveError:
    """Return the error for a drive that is not idle after `within` seconds, given its last axis state, if any."""
    if state is None:
        return DriveTimeout(client.name, "heartbeat (heartbeat_msg_rate_ms)", within)
    if state in (AxisState.IDLE, AxisState.UNDEFINED):
        return DriveError(f"drive {client.name}: still reports INITIALIZING after {within:g} s; restart the drive")
    name = cansimple.state_name(state)
    return DriveError(f"drive {client.name}: did not power off: its state is {name}, expected idle")


def _unpacked(client: OdriveClient, layout: struct.Struct, data: bytes) -> tuple[Any, ...]:
    try:
        return layout.unpack(data)
    except struct.error as error:
        raise DriveError(f"drive {client.name}: a message has wrong length {len(data)}") from error
