"""What a CiA 402 drive is told before the cycle runs: objects and values, in order."""

from __future__ import annotations

import math
from typing import Final

from trirail_drivers.cia402 import frames
from trirail_drivers.cia402.homing import CYCLIC_SYNCHRONOUS_POSITION
from trirail_drivers.config import Drive, Drives, Homing
from trirail_drivers.errors import DriveError
from trirail_drivers.scaling import Scale, unsigned

INVALID: Final = 1 << 31
"""Bit of a PDO's COB-ID: the PDO is not used."""
NO_REMOTE_REQUEST: Final = 1 << 30
"""Bit of a TPDO's COB-ID; some drives report it always, some never."""

Setting = tuple[int, int, int]
"""Index, subindex and value of an object."""


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


def check_nodes(drives: Drives) -> None:
    """Refuse node ids that CANopen does not have, or that two nodes share, with DriveError."""
    nodes = [drive.node for drive in drives.each] + [drives.master_node]
    if len(set(nodes)) < len(nodes):
        raise DriveError(f"node ids of drives A, B, C and the master must differ, but are {', '.join(map(str, nodes))}")
    if 0 in nodes:
        raise DriveError("node id 0 is all nodes' on CANopen; wanted 1 to 127")


def settings_of(name: str, drive: Drive, drives: Drives, scale: Scale, period: float) -> list[Setting]:
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
