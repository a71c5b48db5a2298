"""Sets CiA 402 drives up over SDO, and reads every value back, before the cycle runs."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import can

from trirail_drivers.cia402 import eds, frames
from trirail_drivers.cia402.homing import CYCLIC_SYNCHRONOUS_POSITION, HOMING
from trirail_drivers.cia402.sdo import Client, Clock, Remote
from trirail_drivers.cia402.settings import Setting, check_nodes, settings_of
from trirail_drivers.config import Drives
from trirail_drivers.errors import BusError, DriveError
from trirail_drivers.frames import Frame
from trirail_drivers.interface import NAMES, PowerState
from trirail_drivers.scaling import Scale

HAS_POWER = (PowerState.SWITCHED_ON, PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)
"""States in which a drive may have current in its motor."""

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
    check_nodes(drives)
    settings = [
        settings_of(name, drive, drives, scale, period)
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


def _send(bus: can.BusABC, frame: Frame) -> None:
    try:
        bus.send(frame.message())
    except (can.CanError, OSError) as error:
        raise BusError(f"cannot send on {bus.channel_info}: {error}; is the interface up?") from error


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
    if frames.power_state(statusword) in HAS_POWER:
        raise DriveError(f"drive {remote.name}: keeps its power on when told off (statusword {statusword:04X})")


def _check_homes(remote: Remote) -> None:
    """CiA 402-2, 6502h: bit n - 1 stands for mode n."""
    modes = remote.read(0x6502)
    if not modes >> (HOMING - 1) & 1:
        raise DriveError(
            f"drive {remote.name}: object 6502:00 (supported drive modes) is {modes:08X}, without homing mode; "
            f"leave [drives.{remote.name}.homing] out if its encoder is absolute"
        )


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
