"""Refuses settings of drives that no drive could carry out, before one is asked: which, and what would be right."""

from __future__ import annotations

from trirail_drivers.config import Drives
from trirail_drivers.errors import DriveError
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.requirements import Requirements


def check(drives: Drives, required: Requirements) -> None:
    """Refuse what a drive cannot be told, take or resolve. Raises DriveError with the key."""
    if drives.heartbeat < required.period:
        raise DriveError(
            f"drives.heartbeat = {drives.heartbeat:g}: heartbeats go out with the cycle; "
            f"wanted at least its period, {required.period:g} s"
        )
    PROTOCOLS[drives.protocol].check(drives, required)
