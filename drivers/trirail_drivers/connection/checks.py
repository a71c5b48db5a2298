"""Refuses settings of drives that no drive could carry out, before one is asked: which, and what would be right."""

from __future__ import annotations

from trirail_drivers.config import Can, Drives
from trirail_drivers.driver.requirements import Requirements
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES
from trirail_drivers.protocols import PROTOCOLS

_OWN = ("simulated", "unix")
"""Interfaces that are not python-can's."""
_ELSEWHERE = ("interface", "channel", "bitrate", "ignore_config", "config_context")
"""What `can.Bus` is given from elsewhere, or not at all."""
_CLASSICAL = 1_000_000
"""The highest bitrate of classical CAN (ISO 11898-2) [bit/s]."""


def check_bus(section: Can) -> None:
    """Refuse a bitrate that no wire has, and options that python-can cannot take. Raises DriveError with the key."""
    if section.bitrate > _CLASSICAL and section.interface not in _OWN:
        raise DriveError(
            f"can.bitrate = {section.bitrate}: classical CAN ends at {_CLASSICAL} bit/s; "
            f"only {' and '.join(_OWN)}, which have no wire, go beyond"
        )
    for name in section.options:
        if section.interface in _OWN:
            raise DriveError(f'can.options.{name}: "{section.interface}" has no options, python-can\'s interfaces have')
        if name in _ELSEWHERE:
            raise DriveError(f"can.options.{name}: interface, channel and bitrate stand in [can]; the rest is fixed")


def check(drives: Drives, required: Requirements) -> None:
    """Refuse what a drive cannot be told, take or resolve. Raises DriveError with the key."""
    if drives.heartbeat < required.period:
        raise DriveError(
            f"drives.heartbeat = {drives.heartbeat:g}: heartbeats go out with the cycle; "
            f"wanted at least its period, {required.period:g} s"
        )
    protocol = PROTOCOLS[drives.protocol]
    known = ", ".join(protocol.protections) or "none"
    for name, drive in zip(NAMES, drives.each, strict=True):
        for protection in drive.accept_without:
            if protection not in protocol.protections:
                raise DriveError(f'drives.{name}.accept_without: "{protection}" is no protection; there are {known}')
    protocol.check(drives, required)
