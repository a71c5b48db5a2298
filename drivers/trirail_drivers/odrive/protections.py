"""Settings that an ODrive must have, checked by RxSdo, and the consequences of lacking them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from trirail_drivers.config import Drives
from trirail_drivers.driver.axis import MISSED_HEARTBEATS
from trirail_drivers.errors import DriveError
from trirail_drivers.odrive.cansimple import VELOCITY_SCALE

WATCHDOG: Final = "axis0.config.enable_watchdog"
WATCHDOG_TIMEOUT: Final = "axis0.config.watchdog_timeout"
SCALE: Final = "axis0.config.can.input_vel_scale"
HEARTBEAT: Final = "axis0.config.can.heartbeat_msg_rate_ms"
CYCLIC: Final = tuple(
    f"axis0.config.can.{name}_msg_rate_ms"
    for name in ("version", "encoder", "iq", "error", "temperature", "bus_voltage", "torques", "powers")
)
POSITION_STATUS: Final = "axis0.pos_vel_mapper.status"
RELATIVE_MODE: Final = 9
"""Value of POSITION_STATUS if positions are relative to the place where the drive was switched on."""
RELATIVE: Final = (
    f"{POSITION_STATUS} is {RELATIVE_MODE}, relative: its position is lost with its supply; use an absolute encoder, "
    "or home it by odrivetool before each start of the service"
)
"""Note about a drive in RELATIVE_MODE."""
SETTINGS: Final = (WATCHDOG, WATCHDOG_TIMEOUT, SCALE, HEARTBEAT, *CYCLIC, POSITION_STATUS)
REQUIRED: Final = frozenset((WATCHDOG, WATCHDOG_TIMEOUT, HEARTBEAT))
"""Settings that exist in every firmware since 0.6.

Early versions lack some of the other settings. A missing setting is then off or has its default value.
"""
MIN_WATCHDOG_CYCLES: Final = 3
"""Minimum watchdog time-out [cycles]. A shorter time-out would disarm the drive if a single cycle is late."""
_FLOAT32_TOLERANCE: Final = 1e-6
"""Relative error of times, which are 32-bit floats."""
Settings = Mapping[str, float]
"""Settings of a drive by path, in drive units; 1 represents True."""


class Protection(NamedTuple):
    """Purpose of a required setting, and the consequence of lacking it, for people."""

    purpose: str
    without: str


PROTECTIONS: Final = {
    "endpoints": Protection("the endpoint numbers of its settings", "none of them is checked"),
    "enable_watchdog": Protection("its stop when the host is silent", "it continues with the last setpoint"),
    "input_vel_scale": Protection("the unit of the velocity feed-forward", "the feed-forward has the wrong size"),
    "heartbeat_msg_rate_ms": Protection("monitoring by this service", "its loss is seen late, or it loads the bus"),
    "cyclic_messages": Protection("positions only in answer to requests", "positions of unknown age arrive"),
}
"""Protections that `accept_without` may name for an ODrive."""


def describe_protection(protection: str) -> str:
    """Return a protection's purpose and the consequence of lacking it, for people."""
    used = PROTECTIONS[protection]
    return f"{used.purpose}; without: {used.without}"


def missing_protections(settings: Settings | None, drives: Drives) -> dict[str, str]:
    """Return the reason for each protection that a drive lacks. `settings` is None if its firmware is unknown."""
    if settings is None:
        return {"endpoints": "its firmware is unknown; set endpoints to its flat_endpoints.json"}
    reasons = {}
    longest = MISSED_HEARTBEATS * drives.heartbeat
    if not settings[WATCHDOG]:
        reasons["enable_watchdog"] = f"{WATCHDOG} is False"
    elif not settings[WATCHDOG_TIMEOUT] <= longest * (1.0 + _FLOAT32_TOLERANCE):
        reasons["enable_watchdog"] = (
            f"{WATCHDOG_TIMEOUT} is {settings[WATCHDOG_TIMEOUT]:g} s, expected at most {longest:g} s"
        )
    if (scale := settings.get(SCALE, VELOCITY_SCALE)) != VELOCITY_SCALE:
        reasons["input_vel_scale"] = f"{SCALE} is {scale:g}, expected {VELOCITY_SCALE}"
    if settings[HEARTBEAT] != (wanted := round(1000 * drives.heartbeat)):
        reasons["heartbeat_msg_rate_ms"] = (
            f"{HEARTBEAT} is {settings[HEARTBEAT]:g}, expected {wanted}, drives.heartbeat"
        )
    if on := [f"{path} is {settings[path]:g}" for path in CYCLIC if settings.get(path)]:
        reasons["cyclic_messages"] = f"{', '.join(on)}, expected 0"
    return reasons


def is_relative(settings: Settings | None) -> bool:
    """Whether a drive reports that it loses its position when it loses its supply.

    A drive that reports nothing is assumed to keep its position.
    """
    return settings is not None and settings.get(POSITION_STATUS) == RELATIVE_MODE


def check_watchdog(name: str, settings: Settings | None, period: float) -> None:
    """Raise DriveError if the watchdog is so short that a single late cycle of `period` [s] would trigger it."""
    least = MIN_WATCHDOG_CYCLES * period
    if settings is None or not settings[WATCHDOG]:
        return
    if not settings[WATCHDOG_TIMEOUT] >= least * (1.0 - _FLOAT32_TOLERANCE):
        raise DriveError(
            f"drive {name}: {WATCHDOG_TIMEOUT} is {settings[WATCHDOG_TIMEOUT]:g} s, less than {MIN_WATCHDOG_CYCLES} "
            f"cycles; set at least {least:g} s with odrivetool"
        )
