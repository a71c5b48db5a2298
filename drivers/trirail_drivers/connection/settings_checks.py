"""Checks of the bus and drive settings, made before any drive is contacted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial

from trirail_drivers.config import Can, Drives
from trirail_drivers.connection.opening import check_interface, no_fd
from trirail_drivers.driver.requirements import Requirements, Rule
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES
from trirail_drivers.protocols import PROTOCOLS

_OWN_INTERFACES = ("simulated", "unix")
"""Interfaces that do not belong to python-can."""
_RESERVED_OPTIONS = ("interface", "channel", "bitrate", "fd", "data_bitrate", "ignore_config", "config_context")
"""Arguments of `can.Bus` that are set from other keys or must not be set."""
MAX_CLASSICAL_BITRATE = 1_000_000
"""Highest bit rate of classical CAN, and of the arbitration of CAN FD (ISO 11898-2) [bit/s]."""


def bus_rules(section: Can, protocol: str) -> Iterator[Rule]:
    """Yield checks for an unknown interface, for a bit rate above that of classical CAN, for CAN FD where it is not
    possible, and for options that python-can does not accept.
    """
    yield Rule("can.interface", (), partial(check_interface, section))
    yield Rule("can.bitrate", ("can.interface",), partial(_check_bitrate, section))
    yield Rule("can.fd", ("can.interface", "drives.protocol"), partial(_check_fd, section, protocol))
    yield Rule("can.data_bitrate", ("can.fd", "can.bitrate"), partial(_check_data_bitrate, section))
    for name in section.options:
        yield Rule(f"can.options.{name}", ("can.interface",), partial(_check_option, section, name))


def rules(drives: Drives, required: Requirements) -> Iterator[Rule]:
    """Yield checks for settings that a drive does not have, and for values that it cannot accept or resolve."""
    yield Rule("drives.heartbeat", ("loop.rate_hz",), partial(_check_heartbeat, drives, required))
    for name, drive in zip(NAMES, drives.each, strict=True):
        for protection in drive.accept_without:
            key = f"drives.{name}.accept_without"
            yield Rule(key, ("drives.protocol",), partial(_check_protection, key, protection, drives.protocol))
    for rule in PROTOCOLS[drives.protocol].rules(drives, required):
        yield rule._replace(reads=("drives.protocol", *rule.reads))


def io_rules(protocol: str, keys: Iterable[str]) -> Iterator[Rule]:
    """Yield checks that reject digital outputs and inputs, at these keys, if the protocol of the drives has none."""
    for key in keys:
        yield Rule(key, ("drives.protocol",), partial(_check_io, key, protocol))


def files(drives: Drives) -> Iterator[Rule]:
    """Yield checks that read the files named in the settings."""
    return PROTOCOLS[drives.protocol].files(drives)


def _check_bitrate(section: Can) -> None:
    if section.bitrate > MAX_CLASSICAL_BITRATE and section.interface not in _OWN_INTERFACES:
        raise DriveError(
            f"can.bitrate = {section.bitrate}: the maximum of classical CAN is {MAX_CLASSICAL_BITRATE} bit/s; "
            f"only {' and '.join(_OWN_INTERFACES)}, which have no wire, may exceed it"
        )


def _check_fd(section: Can, protocol: str) -> None:
    if not section.fd:
        return
    if section.interface not in (*_OWN_INTERFACES, "socketcan"):
        raise DriveError(no_fd(section))
    if reason := PROTOCOLS[protocol].without_fd:
        raise DriveError(f'can.fd = true: not with drives.protocol = "{protocol}": {reason}; set can.fd = false')


def _check_data_bitrate(section: Can) -> None:
    if section.data_bitrate is None:
        return
    if not section.fd:
        raise DriveError(
            f"can.data_bitrate = {section.data_bitrate}: only CAN FD frames have a data bit rate; set can.fd = true, "
            "or omit can.data_bitrate"
        )
    if section.data_bitrate < section.bitrate:
        raise DriveError(
            f"can.data_bitrate = {section.data_bitrate}: expected at least can.bitrate, {section.bitrate} bit/s"
        )


def _check_option(section: Can, name: str) -> None:
    if section.interface in _OWN_INTERFACES:
        raise DriveError(
            f'can.options.{name}: "{section.interface}" has no options; only interfaces of python-can have options'
        )
    if name in _RESERVED_OPTIONS:
        raise DriveError(f"can.options.{name}: not allowed here; set interface, channel, bitrates and fd in [can]")


def _check_io(key: str, protocol: str) -> None:
    if reason := PROTOCOLS[protocol].without_io:
        raise DriveError(f'{key}: not with drives.protocol = "{protocol}": {reason}; omit the section')


def _check_heartbeat(drives: Drives, required: Requirements) -> None:
    if drives.heartbeat < required.period:
        raise DriveError(
            f"drives.heartbeat = {drives.heartbeat:g}: heartbeats are sent with the cycle; "
            f"expected at least the period, {required.period:g} s"
        )


def _check_protection(key: str, protection: str, protocol: str) -> None:
    protections = PROTOCOLS[protocol].protections
    if protection not in protections:
        known = ", ".join(protections) or "none"
        raise DriveError(f'{key}: "{protection}" is not a known protection; choose from {known}')
