"""Bus load of a cycle, for any protocol; a load above 100 % is refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from trirail_drivers.errors import BusError
from trirail_drivers.timing import BusTiming

HIGH_LOAD: Final = 0.8
"""Worst-case fraction of the bus capacity above which a warning is emitted, since acyclic frames then have to wait."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """Bus traffic of three drives and the service, as data lengths of frames [bytes]."""

    cycle: tuple[int, ...]
    """Lengths of the frames in one cycle."""
    periodic: tuple[tuple[int, float], ...]
    """Lengths of the frames that are independent of the cycle, each with its period [s]."""
    heartbeats: tuple[int, ...]
    """Lengths of the frames that are sent once per heartbeat period."""
    most_sent: int
    """Maximum number of frames that the service sends in one cycle."""
    output: int = 0
    """Length of a frame with digital outputs."""

    def with_outputs(self, drives: int) -> Traffic:
        """Return the traffic with the digital outputs of this number of drives, which may change in every cycle."""
        return replace(self, cycle=self.cycle + drives * (self.output,), most_sent=self.most_sent + drives)

    def cycle_seconds(self, timing: BusTiming) -> float:
        """Return the worst-case duration of the frames in one cycle [s]."""
        return sum(map(timing.frame_ns, self.cycle)) * 1e-9

    def background(self, timing: BusTiming, heartbeat: float) -> float:
        """Return the worst-case fraction of the bus capacity that the other frames use.

        `heartbeat` is the heartbeat period [s].
        """
        periodic = sum(timing.frame_ns(length) / period for length, period in self.periodic)
        return (periodic + sum(map(timing.frame_ns, self.heartbeats)) / heartbeat) * 1e-9

    def bus_load(self, rate_hz: float, timing: BusTiming, heartbeat: float) -> float:
        """Return the worst-case fraction of the bus capacity that all frames use; 1.0 is a full bus."""
        return rate_hz * self.cycle_seconds(timing) + self.background(timing, heartbeat)

    def highest_rate(self, timing: BusTiming, heartbeat: float) -> float:
        """Return the cycle rate [Hz] at which the bus is full; 0 if the other frames alone fill it."""
        return max(0.0, (1.0 - self.background(timing, heartbeat)) / self.cycle_seconds(timing))

    def check_bus_load(self, rate_hz: float, timing: BusTiming, heartbeat: float) -> float:
        """Return the bus load of a cycle.

        Raises BusError, which states the highest possible rate, if the load exceeds 1.0.
        """
        load = self.bus_load(rate_hz, timing, heartbeat)
        if load > 1.0:
            raise BusError(
                f"{rate_hz:g} Hz takes {load:.0%} of the bus at {timing}; "
                f"the highest rate that fits is {self.highest_rate(timing, heartbeat):.0f} Hz"
            )
        return load


def warning(rate_hz: float, load: float) -> str:
    """Return a warning if the bus load exceeds HIGH_LOAD, otherwise ""."""
    return (
        f"CAN bus: {rate_hz:g} Hz takes up to {load:.0%} of the bus; keep the load below {HIGH_LOAD:.0%}"
        if load > HIGH_LOAD
        else ""
    )


class TrafficPlan(NamedTuple):
    """Traffic that follows from the configuration, before any drive has answered."""

    traffic: Traffic
    setpoint_bytes: int = 8
    """Data length of a setpoint [bytes]."""
    velocity_offset: bool = True
    """Whether a setpoint contains a velocity for feed-forward."""
    full_load: float | None = None
    """Bus load with the velocity offset, if the velocity offset is left out because of this load; otherwise None."""
    remedy: str = ""
    """Changes of the configuration with which the frames would fit, if the load is too high; otherwise ""."""

    @property
    def omission(self) -> str:
        """Statement that the velocity offset is left out because of the bus load, with the reason; otherwise ""."""
        if self.full_load is None:
            return ""
        return (
            f"setpoints without velocity offset ({self.setpoint_bytes} bytes), "
            f"because 8 bytes would use {percent(self.full_load)}"
        )


def percent(share: float) -> str:
    """Return a share in percent, rounded, for people."""
    return f"{100.0 * share:.0f} %"


def usage(rate_hz: float, load: float, bus: str) -> str:
    """Return the share of a named bus that a cycle uses in the worst case, for people."""
    rate = f"{rate_hz / 1000:g} kHz" if rate_hz >= 1000 else f"{rate_hz:g} Hz"
    return f"{rate} uses {percent(load)} of {bus}"
