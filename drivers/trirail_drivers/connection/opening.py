"""Opening of the configured CAN bus and its drives."""

from __future__ import annotations

import difflib
import errno
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can
from can.interfaces.socketcan import SocketcanBus

from trirail_drivers import config
from trirail_drivers.bus import adapters, canerrors
from trirail_drivers.bus.can_frame import CANFD_FRAME
from trirail_drivers.bus.capture import Capture, CapturedBus
from trirail_drivers.bus.frames import fd_message
from trirail_drivers.bus.reopening import AbsentBus, Reopening
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.config import NO_IO, DigitalIo
from trirail_drivers.errors import BusAbsentError, BusError, DriveError
from trirail_drivers.interface import Clock, DriveGroup
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import SimulatedBus, SimulatedDevice
from trirail_drivers.simulated.carriages import DriveMounting
from trirail_drivers.simulated.faults import Faults

# python-can must not print its errors as well: the BusError contains the reason, and only its line is shown.
logging.getLogger("can").addHandler(logging.NullHandler())

NETWORK_INTERFACES = Path("/sys/class/net")
IFF_UP = 0x1
"""Flag of a network interface that is up (linux/if.h)."""


def open_bus(section: config.Can, drives: config.Drives, clock: Clock = time.monotonic) -> can.BusABC:
    """Open the bus that section [can] names. Raises BusError with the remedy if it cannot be opened.

    `drives` and `clock` are used for the simulated drives of a "simulated" bus.
    """
    if section.interface == "simulated":
        return simulated_bus(section, drives, clock)
    if section.interface == "unix":
        return UnixBus(section.channel, fd=section.fd)
    check_interface(section)
    if section.fd and section.interface != "socketcan":
        raise BusError(no_fd(section))
    options: dict[str, Any] = dict(section.options)
    try:
        if section.fd:
            bus: can.BusABC = FdSocketcanBus(section.channel, **options)
        else:
            # ignore_config: python-can's own files and environment variables must not change the configured bus.
            bus = can.Bus(
                interface=section.interface,
                channel=section.channel,
                bitrate=section.bitrate,
                ignore_config=True,
                **options,
            )
    except Exception as error:  # vendor libraries raise any exception: a missing Kvaser CANlib raises NameError
        kind = BusAbsentError if _may_appear(section, error) else BusError
        raise kind(_opening_error(section, error)) from error
    if section.interface == "socketcan" and (problem := _problem(section)):
        bus.shutdown()
        raise BusAbsentError(problem)
    return bus


def check_interface(section: config.Can) -> None:
    """Raise BusError if there is no interface of the configured name."""
    known = sorted({"simulated", "unix", *can.VALID_INTERFACES})
    if section.interface not in known:
        close = difflib.get_close_matches(section.interface, known, n=1)
        hint = f'did you mean "{close[0]}"? Use' if close else "use"
        raise BusError(f'can.interface "{section.interface}" is unknown; {hint} one of {", ".join(known)}')


def no_fd(section: config.Can) -> str:
    """Return the reason why an interface cannot be used as a CAN FD bus."""
    return (
        f'can.fd = true: interface "{section.interface}" is used for classical CAN only; CAN FD needs interface = '
        '"socketcan", for which Linux has drivers of most adapters; or set can.fd = false'
    )


class FdSocketcanBus(SocketcanBus):
    """CAN FD bus on SocketCAN. It sends every data frame as a CAN FD frame with bit rate switch."""

    def __init__(self, channel: str, **options: Any) -> None:
        super().__init__(channel, **options, fd=True)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame."""
        super().send(fd_message(msg), timeout)


def _may_appear(section: config.Can, error: Exception) -> bool:
    """Whether a bus that cannot be opened now might open later, with the same configuration and packages."""
    of_the_bus = isinstance(error, (can.CanError, OSError)) and not isinstance(
        error, can.CanInterfaceNotImplementedError
    )
    return of_the_bus and not adapters.missing_support(section.interface)


def connect(
    section: config.Can,
    drives: config.Drives,
    clock: Clock = time.monotonic,
    capture: Capture | None = None,
    *,
    awaits: bool = False,
    io: Sequence[DigitalIo] = NO_IO,
) -> DriveGroup:
    """Open the bus and return the three drives on it, which are not set up yet.

    `io` contains the digital outputs and inputs of each drive; `capture` records every frame. If `awaits` is True, a
    lost bus is reopened in the background of the cycle, and a missing bus is opened when it appears.

    Raises DriveError if there is no bus or, with `awaits`, only if no bus can appear later.
    """
    protocol = PROTOCOLS[drives.protocol]

    def opened() -> can.BusABC:
        bus = open_bus(section, drives, clock)
        return CapturedBus(bus, capture) if capture is not None else bus

    reopening = Reopening(section.channel or section.interface, opened) if awaits else None
    bus: can.BusABC
    try:
        bus = opened()
    except BusAbsentError as error:
        if reopening is None:
            raise
        bus = AbsentBus(reopening.name, str(error))
    try:
        return protocol.driver(bus, section.timing, drives, clock, reopening, io)
    except DriveError:
        bus.shutdown()
        raise


def simulated_bus(section: config.Can, drives: config.Drives, clock: Clock = time.monotonic) -> SimulatedBus:
    """Return the three simulated drives of a configuration on their own bus, at rest at `can.simulated.start`."""
    devices, faults = simulated_drives(section, drives)
    return SimulatedBus(devices, clock, faults, fd=section.fd)


def simulated_drives(section: config.Can, drives: config.Drives) -> tuple[Sequence[SimulatedDevice], Faults]:
    """Return the three simulated drives of a configuration without a bus, and their faults."""
    protocol = PROTOCOLS[drives.protocol]
    starts = zip(drives.each, section.simulated.start, strict=True)
    devices = [protocol.simulated_drive(section.simulated, drives, drive, start) for drive, start in starts]
    scales = [drive.direction * drive.counts_per_metre for drive in drives.each]
    mounted = [_mounted(section.simulated.built, index, drive) for index, drive in enumerate(drives.each)]
    return devices, Faults(devices, scales, protocol.fault_frames, mounted=mounted)


def _mounted(built: Sequence[config.SimulatedSlider] | None, index: int, drive: config.Drive) -> DriveMounting:
    """Return the slider that a simulated drive actually moves, and the slider's scale.

    `built` describes the simulated robot. If no entry of `built` has the drive's node id, the drive moves the slider
    that the configuration assigns to the drive.
    """
    for slider, each in enumerate(built or ()):
        if each.node == drive.node:
            return DriveMounting(slider, each.direction * each.counts_per_metre)
    return DriveMounting(index, drive.direction * drive.counts_per_metre)


def _opening_error(section: config.Can, error: Exception) -> str:
    """Return one line with the reason why the bus could not be opened, and the remedy."""
    number = canerrors.error_number(error)
    if number == errno.EAFNOSUPPORT:
        return "this kernel has no SocketCAN (address family AF_CAN); load it with: modprobe can_raw"
    if section.interface == "socketcan" and number == errno.ENODEV:
        return f'there is no CAN interface "{section.channel}"; {_interface_up_hint(section)}'
    if lacking := adapters.missing_support(section.interface):
        return f"CAN interface {section.interface} needs {lacking}"
    reason = " ".join(str(error).split())
    return f'cannot open CAN interface {section.interface}, channel "{section.channel}": {reason}'


def _interface_up_hint(section: config.Can) -> str:
    if section.channel.startswith("vcan"):
        mtu = f" mtu {CANFD_FRAME.size}" if section.fd else ""
        return f"make it with: ip link add {section.channel} type vcan && ip link set {section.channel}{mtu} up"
    return f"bring it up with: ip link set {section.channel} {section.timing.link_settings}"


def _problem(section: config.Can) -> str:
    """Return the reason why the Linux interface cannot send, with the remedy; "" if it can."""
    folder = NETWORK_INTERFACES / section.channel
    try:
        flags = int((folder / "flags").read_text(), 16)
        mtu = int((folder / "mtu").read_text()) if section.fd else 0
        carrier = int((folder / "carrier").read_text()) if flags & IFF_UP else 0
    except (OSError, ValueError):
        return ""
    if not flags & IFF_UP:
        return f'CAN interface "{section.channel}" is down; {_interface_up_hint(section)}'
    if section.fd and mtu < CANFD_FRAME.size:
        return (
            f'CAN interface "{section.channel}" is set up for classical CAN only (MTU {mtu}), but can.fd = true; set '
            f"the interface down, and {_interface_up_hint(section)}; or set can.fd = false"
        )
    if not carrier:  # a CAN controller lacks its carrier only in bus-off: drivers/net/can/dev/dev.c, can_bus_off
        return (
            f'CAN interface "{section.channel}" is in bus-off; check cable, termination and bitrate, then restart it: '
            f"ip link set {section.channel} down && ip link set {section.channel} up"
        )
    return ""
