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
ABSOLUTE_SETPOINTS: Final = "axis0.controller.config.absolute_setpoints"
"""Setting that selects positions relative to the encoder; otherwise, positions count from the place at power-on."""
RELATIVE: Final = (
    f"{POSITION_STATUS} is {RELATIVE_MODE}, relative: its position is lost with its supply; use an absolute encoder, "
    "or home it by odrivetool before each start of the service"
)
"""Note about a drive in RELATIVE_MODE."""
FROM_POWER_ON: Final = (
    f"{ABSOLUTE_SETPOINTS} is False: its position counts from the place where it was switched on, and is lost with its "
    "supply; set it to True with odrivetool"
)
"""Note about a drive whose positions do not refer to its encoder."""
UNCHECKED: Final = (
    f"{ABSOLUTE_SETPOINTS} must be True, but has no known endpoint number; set endpoints to its flat_endpoints.json, "
    "or else it may count as not homed after a restart"
)
"""Note about a drive that may lose its position with its supply."""
SETTINGS: Final = (WATCHDOG, WATCHDOG_TIMEOUT, SCALE, HEARTBEAT, *CYCLIC, POSITION_STATUS, ABSOLUTE_SETPOINTS)
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


MAY_SEND_UNASKED: Final = frozenset({"cyclic_messages", "endpoints"})
"""Protections without which a drive may send positions that were not requested, or without which this is unknown."""


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


def relative_position(settings: Settings | None) -> str:
    """Return why a drive loses its position when it loses its supply, for people; "" if it does not report that."""
    if settings is None:
        return ""
    if settings.get(POSITION_STATUS) == RELATIVE_MODE:
        return RELATIVE
    return "" if settings.get(ABSOLUTE_SETPOINTS, True) else FROM_POWER_ON


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
