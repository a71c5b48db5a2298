"""How full the cycle makes the bus, whichever protocol the drives speak: refused above 100 %."""

from __future__ import annotations

from typing import Final

from trirail_drivers import config, frames
from trirail_drivers.errors import BusError
from trirail_drivers.odrive import frames as odrive_frames

HIGH: Final = 0.8
"""Worst-case share of the bus from which on people are warned: what is not cyclic has to wait."""

_LOAD: Final = {"cia402": frames.bus_load, "odrive": odrive_frames.bus_load}
_HIGHEST: Final = {"cia402": frames.highest_rate, "odrive": odrive_frames.highest_rate}


def bus_load(rate_hz: float, bitrate: int, drives: config.Drives) -> float:
    """Worst-case share of the bus that all frames take; 1.0 is full."""
    return _LOAD[drives.protocol](rate_hz, bitrate, drives.heartbeat)


def highest_rate(bitrate: int, drives: config.Drives) -> float:
    """The cycle rate [Hz] that fills the bus; 0 where the heartbeats alone do."""
    return max(0.0, _HIGHEST[drives.protocol](bitrate, drives.heartbeat))


def checked(rate_hz: float, bitrate: int, drives: config.Drives) -> float:
    """The bus load of a cycle; BusError with the highest rate that fits if this one does not."""
    load = bus_load(rate_hz, bitrate, drives)
    if load > 1.0:
        raise BusError(
            f"{rate_hz:g} Hz takes {load:.0%} of the bus at {bitrate} bit/s; "
            f"the highest rate that fits is {highest_rate(bitrate, drives):.0f} Hz"
        )
    return load


def warning(rate_hz: float, load: float) -> str:
    """What people should know of a bus load; "" where there is room enough."""
    return f"CAN bus: {rate_hz:g} Hz takes {load:.0%} of it at worst; keep below {HIGH:.0%}" if load > HIGH else ""
