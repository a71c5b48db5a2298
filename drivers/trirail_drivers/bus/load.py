"""Bus load of a cycle, for any protocol; a load above 100 % is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from trirail_drivers.errors import BusError

HIGH_LOAD: Final = 0.8
"""Worst-case share of the bus above which people are warned, since acyclic frames have to wait."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """Frames of three drives and the service; bits include worst-case stuffing."""

    cycle_bits: int
    """Bits of one cycle's frames."""
    background: Callable[[float], float]
    """Bits per second that do not depend on the cycle, as a function of the heartbeat period [s]."""
    most_sent: int
    """Largest number of frames that the service sends in one cycle."""
    output_bits: int = 0
    """Bits of a frame of digital outputs."""

    def with_outputs(self, drives: int) -> Traffic:
        """Return the traffic if this number of drives has digital outputs, which may change in every cycle."""
        bits = drives * self.output_bits
        return replace(self, cycle_bits=self.cycle_bits + bits, most_sent=self.most_sent + drives)

    def bus_load(self, rate_hz: float, bitrate: int, heartbeat: float) -> float:
        """Return the worst-case share of the bus that all frames take; 1.0 is full."""
        return (rate_hz * self.cycle_bits + self.background(heartbeat)) / bitrate

    def highest_rate(self, bitrate: int, heartbeat: float) -> float:
        """Return the cycle rate [Hz] that fills the bus; 0 if the other frames fill it alone."""
        return max(0.0, (bitrate - self.background(heartbeat)) / self.cycle_bits)

    def check_bus_load(self, rate_hz: float, bitrate: int, heartbeat: float) -> float:
        """Return the bus load of a cycle; BusError, with the highest possible rate, if it exceeds 1.0."""
        load = self.bus_load(rate_hz, bitrate, heartbeat)
        if load > 1.0:
            raise BusError(
                f"{rate_hz:g} Hz takes {load:.0%} of the bus at {bitrate} bit/s; "
                f"the highest rate that fits is {self.highest_rate(bitrate, heartbeat):.0f} Hz"
            )
        return load


def warning(rate_hz: float, load: float) -> str:
    """Return a warning for a bus load above HIGH_LOAD, else ""."""
    return (
        f"CAN bus: {rate_hz:g} Hz takes {load:.0%} of it at worst; keep below {HIGH_LOAD:.0%}"
        if load > HIGH_LOAD
        else ""
    )
