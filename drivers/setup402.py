"""Sets CiA 402 drives up over SDO, and reads every value back, before the cycle runs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import can

from drivers import eds, frames
from drivers.config import Drive, Drives, Homing
from drivers.errors import BusError, DriveError
from drivers.homing402 import CYCLIC_SYNCHRONOUS_POSITION, HOMING
from drivers.interface import NAMES, PowerState
from drivers.scaling import Scale, unsigned
from drivers.sdo import INVALID, NO_REMOTE_REQUEST, Client, Clock, Remote

POWERED = (PowerState.SWITCHED_ON, PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)
"""States in which a drive may have current in its motor."""

Setting = tuple[int, int, int]
"""Index, subindex and value of an object."""
_USED = ((0x1000, 0), (0x603F, 0), (0x6040, 0), (0x6041, 0), (0x6061, 0), (0x6064, 0), (0x607A, 0), (0x60B1, 0))
"""Objects that are read or mapped, beside those that are set."""


class Start(NamedTuple):
    """What a drive says of itself once it is set up."""

    counts: int
    """Actual position 6064h."""
    statusword: int
    """6041h."""
    error_code: int
    """603Fh if the drive is in fault, else 0."""


def configure(
    bus: can.BusABC, drives: Drives, scales: tuple[Scale, ...], period: float, clock: Clock
) -> tuple[Start, ...]:
    """Set the three drives up for a cycle of `period` seconds; without power, and NMT operational at the end.

    Raises DriveError; of its kinds, ConfigurationRefused for a value that reads back differently and
    DriveTimeout for a drive that does not answer.
    """
    _check_nodes(drives)
    settings = [
        _settings(name, drive, drives, scale, period)
        for name, drive, scale in zip(NAMES, drives.each, scales, strict=True)
    ]
    remotes = []
    for name, drive, wanted in zip(NAMES, drives.each, settings, strict=True):
        needed = (*_USED, *(setting[:2] for setting in wanted), *([(0x6502, 0)] if drive.homing else []))
        objects = eds.load(name, Path(drive.eds) if drive.eds else eds.SERVO, drive.node, needed)
        remotes.append(Remote(name, Client(bus, drive.node, objects, drives.sdo_timeout, clock)))
    for drive in drives.each:
        _send(bus, frames.nmt(frames.NMT_PRE_OPERATIONAL, drive.node))
    for remote, drive in zip(remotes, drives.each, strict=True):
        _check_is_idle_servo(remote)
        if drive.homing is not None:
            _check_homes(remote)
    for remote, wanted in zip(remotes, settings, strict=True):
        _apply(remote, wanted)
    for drive in drives.each:
        _send(bus, frames.nmt(frames.NMT_START, drive.node))
    return tuple(_start(remote) for remote in remotes)


def interpolation_period(period: float) -> tuple[int, int]:
    """Value and power of ten [s] for object 60C2h; DriveError if none from 1 to 255 says `period` exactly."""
    for exponent in range(0, -7, -1):
        value = round(period * 10**-exponent)
        if 1 <= value <= 255 and math.isclose(value * 10.0**exponent, period, rel_tol=1e-9):
            return value, exponent
    finest = max(-6, math.ceil(math.log10(period / 255)))
    nearest = max(1, round(period * 10**-finest)) * 10.0**finest
    raise DriveError(
        f"a cycle of {period:g} s ({1 / period:g} Hz) cannot be told to the drives: object 60C2h takes "
        f"1 to 255 times a power of ten from 1 us; the nearest is {nearest:g} s ({1 / nearest:g} Hz)"
    )


def _send(bus: can.BusABC, message: can.Message) -> None:
    try:
        bus.send(message)
    except (can.CanError, OSError) as error:
        raise BusError(f"cannot send on {bus.channel_info}: {error}; is the interface up?") from error


def _check_nodes(drives: Drives) -> None:
    nodes = [drive.node for drive in drives.each] + [drives.master_node]
    if len(set(nodes)) < len(nodes):
        raise DriveError(f"node ids of drives A, B, C and the master must differ, but are {', '.join(map(str, nodes))}")
    if 0 in nodes:
        raise DriveError("node id 0 is all nodes' on CANopen; wanted 1 to 127")


def _check_is_idle_servo(remote: Remote) -> None:
    """The node is there, is a CiA 402 drive, and has no power on its motor."""
    device_type = remote.read(0x1000)
    if device_type & 0xFFFF != 402:
        raise DriveError(
            f"drive {remote.name}: object 1000:00 (device type) is {device_type:08X}, of CiA profile "
            f"{device_type & 0xFFFF}; wanted a drive, profile 402"
        )
    remote.write(0x6040, 0, frames.DISABLE_VOLTAGE)
    statusword = remote.read(0x6041)
    if frames.power_state(statusword) in POWERED:
        raise DriveError(f"drive {remote.name}: keeps its power on when told off (statusword {statusword:04X})")


def _check_homes(remote: Remote) -> None:
    """CiA 402-2, 6502h: bit n - 1 stands for mode n."""
    modes = remote.read(0x6502)
    if not modes >> (HOMING - 1) & 1:
        raise DriveError(
            f"drive {remote.name}: object 6502:00 (supported drive modes) is {modes:08X}, without homing mode; "
            f"leave [drives.{remote.name}.homing] out if its encoder is absolute"
        )


def _settings(name: str, drive: Drive, drives: Drives, scale: Scale, period: float) -> list[Setting]:
    """Everything a drive must be told, in order."""
    heartbeat = round(1000 * drives.heartbeat)
    if not 1 <= 3 * heartbeat <= 0xFFFF or heartbeat < 1:
        raise DriveError(f"heartbeat {drives.heartbeat:g} s: a drive takes 0.001 to 21.845 s")
    value, exponent = interpolation_period(period)
    window = unsigned(name, scale, "following_error", drives.following_error)
    deceleration = unsigned(name, scale, "quick_stop_deceleration", drives.quick_stop_deceleration)
    return [
        (0x1006, 0, round(1e6 * period)),
        (0x1017, 0, heartbeat),
        (0x1016, 1, drives.master_node << 16 | 3 * heartbeat),
        (0x1029, 1, 0),  # a drive that lost its master turns pre-operational: deaf to setpoints
        (0x6007, 0, 3),  # ... and quick-stops
        (0x605A, 0, 2),  # quick stop: down the ramp 6085h, then without power
        (0x605E, 0, 2),  # its own fault: down the same ramp
        (0x6085, 0, deceleration),
        (0x6065, 0, window),
        (0x6060, 0, CYCLIC_SYNCHRONOUS_POSITION),
        (0x60C2, 1, value),
        (0x60C2, 2, exponent),
        *(_homing(name, drive.homing, scale) if drive.homing is not None else ()),
        *_pdo(0x1400, frames.RPDO1 + drive.node, ((0x1400, 2, 255),), (0x6040_00_10,)),
        *_pdo(0x1401, frames.RPDO2 + drive.node, ((0x1401, 2, 1),), (0x607A_00_20, 0x60B1_00_20)),
        *_pdo(
            0x1800,
            frames.TPDO1 + drive.node | NO_REMOTE_REQUEST,
            ((0x1800, 2, 255), (0x1800, 5, round(1000 * frames.STATUS_PERIOD))),
            (0x6041_00_10,),
        ),
        *_pdo(
            0x1801,
            frames.TPDO2 + drive.node | NO_REMOTE_REQUEST,
            ((0x1801, 2, 1),),
            (0x6064_00_20,),
        ),
    ]


def _homing(name: str, homing: Homing, scale: Scale) -> list[Setting]:
    def speed(key: str, value: float) -> int:
        return unsigned(name, scale, f"homing.{key}", value)

    return [
        (0x6098, 0, homing.method),
        (0x6099, 1, speed("speed_switch", homing.speed_switch)),
        (0x6099, 2, speed("speed_zero", homing.speed_zero)),
        (0x609A, 0, speed("acceleration", homing.acceleration)),
        (0x607C, 0, 0),  # makers differ in its sign; where home is, the drive's `offset` says
    ]


def _pdo(index: int, identifier: int, parameters: tuple[Setting, ...], objects: tuple[int, ...]) -> list[Setting]:
    """The order CiA 301 wants for a mapping: invalid, cleared, mapped, counted, valid again."""
    mapping = index + 0x200
    return [
        (index, 1, identifier | INVALID),
        *parameters,
        (mapping, 0, 0),
        *((mapping, position, entry) for position, entry in enumerate(objects, start=1)),
        (mapping, 0, len(objects)),
        (index, 1, identifier),
    ]


def _apply(remote: Remote, settings: list[Setting]) -> None:
    """Write the settings in order, then read back what each object was given last."""
    for index in (0x1402, 0x1403, 0x1802, 0x1803):  # other PDOs would take a share of the bus nobody counted
        remote.invalidate(index)
    for setting in settings:
        remote.write(*setting)
    for (index, subindex), value in {setting[:2]: setting[2] for setting in settings}.items():
        remote.check(index, subindex, value)
    remote.check(0x6061, 0, CYCLIC_SYNCHRONOUS_POSITION)


def _start(remote: Remote) -> Start:
    statusword = remote.read(0x6041)
    in_fault = frames.power_state(statusword) in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)
    return Start(remote.read(0x6064), statusword, remote.read(0x603F) if in_fault else 0)
