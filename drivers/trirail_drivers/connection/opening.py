"""Opens the configured CAN bus, and the drives on it."""

from __future__ import annotations

import errno
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can

from trirail_drivers import config
from trirail_drivers.bus import adapters, canerrors
from trirail_drivers.bus.capture import Capture, CapturedBus
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.errors import BusError, DriveError
from trirail_drivers.interface import Clock, DriveGroup
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import SimulatedBus, SimulatedDevice
from trirail_drivers.simulated.carriages import Mounted
from trirail_drivers.simulated.faults import Faults

# What python-can would say of a failure is in the BusError; standard error is for that one line.
logging.getLogger("can").addHandler(logging.NullHandler())

NETWORK_INTERFACES = Path("/sys/class/net")
IFF_UP = 0x1
"""Flag of a network interface that is up (linux/if.h)."""


def open_bus(section: config.Can, drives: config.Drives, clock: Clock = time.monotonic) -> can.BusABC:
    """The bus that section [can] names; BusError with the remedy if there is none.

    `drives` and `clock` make the simulated drives, where the bus is "simulated".
    """
    if section.interface == "simulated":
        return simulated_bus(section, drives, clock)
    if section.interface == "unix":
        return UnixBus(section.channel)
    if section.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted({"simulated", "unix", *can.VALID_INTERFACES}))
        raise BusError(f'can.interface "{section.interface}" is unknown; known are {known}')
    options: dict[str, Any] = dict(section.options)
    try:
        # Our configuration alone decides: none of python-can's own files and environment variables.
        bus = can.Bus(
            interface=section.interface,
            channel=section.channel,
            bitrate=section.bitrate,
            ignore_config=True,
            **options,
        )
    except Exception as error:  # makers' libraries raise what they like: Kvaser's, where it is missing, NameError
        raise BusError(_explained(section, error)) from error
    if section.interface == "socketcan" and _is_down(section.channel):
        bus.shutdown()
        raise BusError(f'CAN interface "{section.channel}" is down; {_bring_up(section)}')
    return bus


def connect(
    section: config.Can,
    drives: config.Drives,
    clock: Clock = time.monotonic,
    capture: Capture | None = None,
) -> DriveGroup:
    """The three drives on their bus, not set up yet; DriveError if there is no bus. `capture` notes every frame."""
    bus = open_bus(section, drives, clock)
    if capture is not None:
        bus = CapturedBus(bus, capture)
    try:
        return PROTOCOLS[drives.protocol].driver(bus, section.bitrate, drives, clock)
    except DriveError:
        bus.shutdown()
        raise


def simulated_bus(section: config.Can, drives: config.Drives, clock: Clock = time.monotonic) -> SimulatedBus:
    """The three drives of a configuration on a bus of their own, at rest where `can.simulated.start` says."""
    devices, faults = simulated_drives(section, drives)
    return SimulatedBus(devices, clock, faults)


def simulated_drives(section: config.Can, drives: config.Drives) -> tuple[Sequence[SimulatedDevice], Faults]:
    """The three drives of a configuration, on no bus yet, and their faults."""
    protocol = PROTOCOLS[drives.protocol]
    starts = zip(drives.each, section.simulated.start, strict=True)
    devices = [protocol.simulated_drive(section.simulated, drives, drive, start) for drive, start in starts]
    scales = [drive.direction * drive.counts_per_metre for drive in drives.each]
    mounted = [_mounted(section.simulated.built, index, drive) for index, drive in enumerate(drives.each)]
    return devices, Faults(devices, scales, protocol.fault_frames, mounted=mounted)


def _mounted(built: Sequence[config.Built] | None, index: int, drive: config.Drive) -> Mounted:
    """What a simulated drive really moves: by its node id, or what is configured where nobody says."""
    for slider, each in enumerate(built or ()):
        if each.node == drive.node:
            return Mounted(slider, each.direction * each.counts_per_metre)
    return Mounted(index, drive.direction * drive.counts_per_metre)


def _explained(section: config.Can, error: Exception) -> str:
    """One line that says why the bus did not open and what to do about it."""
    number = canerrors.error_number(error)
    if number == errno.EAFNOSUPPORT:
        return "this kernel has no SocketCAN (address family AF_CAN); load it with: modprobe can_raw"
    if section.interface == "socketcan" and number == errno.ENODEV:
        return f'there is no CAN interface "{section.channel}"; {_bring_up(section)}'
    if lacking := adapters.lacking(section.interface):
        return f"CAN interface {section.interface} needs {lacking}"
    reason = " ".join(str(error).split())
    return f'cannot open CAN interface {section.interface}, channel "{section.channel}": {reason}'


def _bring_up(section: config.Can) -> str:
    if section.channel.startswith("vcan"):
        return f"make it with: ip link add {section.channel} type vcan && ip link set {section.channel} up"
    return f"bring it up with: ip link set {section.channel} up type can bitrate {section.bitrate}"


def _is_down(interface: str) -> bool:
    """Whether Linux knows the interface and has it down; frames could not be sent."""
    try:
        flags = int((NETWORK_INTERFACES / interface / "flags").read_text(), 16)
    except (OSError, ValueError):
        return False
    return not flags & IFF_UP
