"""What an ODrive must have been set to, and what is so where it is not: judged from its settings, read by RxSdo."""

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
SETTINGS: Final = (WATCHDOG, WATCHDOG_TIMEOUT, SCALE, HEARTBEAT, *CYCLIC)
NEEDED: Final = frozenset((WATCHDOG, WATCHDOG_TIMEOUT, HEARTBEAT))
"""Every firmware since 0.6 has these; older ones lack some of the others, which then are off, or the default."""
LEAST_PERIODS: Final = 3
"""A watchdog that is shorter than so many cycles ends motion where one is late."""
_ROUNDED: Final = 1e-6
"""Times are told as floats of 32 bits."""
Settings = Mapping[str, float]
"""Those that a drive has, by their paths; seconds, milliseconds, 1 for true."""


class Protection(NamedTuple):
    """What a setting protects."""

    purpose: str
    without: str


PROTECTIONS: Final = {
    "endpoints": Protection("the numbers of its settings", "none of them is looked at"),
    "enable_watchdog": Protection("its stop when it hears nobody", "it goes on as it was told last"),
    "input_vel_scale": Protection("the unit of the velocity feed-forward", "it is too much or too little"),
    "heartbeat_msg_rate_ms": Protection("this service's watch on it", "it is told late, or loads the bus"),
    "cyclic_messages": Protection("positions in answer to requests alone", "they come uncounted, of any age"),
}
"""What `accept_without` may name for an ODrive."""


def means(protection: str) -> str:
    """What a protection is for, and what is so without, for people."""
    used = PROTECTIONS[protection]
    return f"{used.purpose}; without: {used.without}"


def lacking(settings: Settings | None, drives: Drives) -> dict[str, str]:
    """Return the protections that a drive lacks with these settings, each with why; None where they are not known."""
    if settings is None:
        return {"endpoints": "its firmware is not known here; endpoints names its flat_endpoints.json"}
    found = {}
    longest = MISSED_HEARTBEATS * drives.heartbeat
    if not settings[WATCHDOG]:
        found["enable_watchdog"] = f"{WATCHDOG} is False"
    elif not settings[WATCHDOG_TIMEOUT] <= longest * (1.0 + _ROUNDED):
        found["enable_watchdog"] = f"{WATCHDOG_TIMEOUT} is {settings[WATCHDOG_TIMEOUT]:g} s, wanted {longest:g} at most"
    if (scale := settings.get(SCALE, VELOCITY_SCALE)) != VELOCITY_SCALE:
        found["input_vel_scale"] = f"{SCALE} is {scale:g}, wanted {VELOCITY_SCALE}"
    if settings[HEARTBEAT] != (wanted := round(1000 * drives.heartbeat)):
        found["heartbeat_msg_rate_ms"] = f"{HEARTBEAT} is {settings[HEARTBEAT]:g}, wanted {wanted}, drives.heartbeat"
    if on := [f"{path} is {settings[path]:g}" for path in CYCLIC if settings.get(path)]:
        found["cyclic_messages"] = f"{', '.join(on)}, wanted 0"
    return found


def check_watchdog(name: str, settings: Settings | None, period: float) -> None:
    """Refuse with DriveError a watchdog by which one late cycle of `period` [s] would end motion."""
    least = LEAST_PERIODS * period
    if settings is not None and settings[WATCHDOG] and not settings[WATCHDOG_TIMEOUT] >= least * (1.0 - _ROUNDED):
        raise DriveError(
            f"drive {name}: {WATCHDOG_TIMEOUT} is {settings[WATCHDOG_TIMEOUT]:g} s, less than {LEAST_PERIODS} cycles; "
            f"wanted {least:g} at least, with ODrive's own tools"
        )
