"""How full the cycle makes the bus, whichever protocol the drives speak: refused above 100 %."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from trirail_drivers.errors import BusError

HIGH: Final = 0.8
"""Worst-case share of the bus from which on people are warned: what is not cyclic has to wait."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """What three drives of one protocol and the service put on the bus; bits are those of the worst stuffing."""

    cycle_bits: int
    """Bits of one cycle's frames."""
    background: Callable[[float], float]
    """Bits per second that do not depend on the cycle, of the heartbeats' period [s]."""
    most_sent: int
    """Frames that the service sends in one cycle at most."""

    def bus_load(self, rate_hz: float, bitrate: int, heartbeat: float) -> float:
        """Worst-case share of the bus that all frames take; 1.0 is full."""
        return (rate_hz * self.cycle_bits + self.background(heartbeat)) / bitrate

    def highest_rate(self, bitrate: int, heartbeat: float) -> float:
        """The cycle rate [Hz] that fills the bus; 0 where what does not depend on the cycle fills it alone."""
        return max(0.0, (bitrate - self.background(heartbeat)) / self.cycle_bits)

    def checked(self, rate_hz: float, bitrate: int, heartbeat: float) -> float:
        """The bus load of a cycle; BusError with the highest rate that fits if this one does not."""
        load = self.bus_load(rate_hz, bitrate, heartbeat)
        if load > 1.0:
            raise BusError(
                f"{rate_hz:g} Hz takes {load:.0%} of the bus at {bitrate} bit/s; "
                f"the highest rate that fits is {self.highest_rate(bitrate, heartbeat):.0f} Hz"
            )
        return load


def warning(rate_hz: float, load: float) -> str:
    """What people should know of a bus load; "" where there is room enough."""
    return f"CAN bus: {rate_hz:g} Hz takes {load:.0%} of it at worst; keep below {HIGH:.0%}" if load > HIGH else ""
