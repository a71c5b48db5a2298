"""Properties of the machine for `trirail doctor`: read by trirail.cli.probes, judged by trirail.cli.doctor."""

from __future__ import annotations

from typing import Any

from msgspec import Struct

from trirail.cli.key_folder import IssuedCertificate
from trirail.diagnosis.bus_timing import MeasuredTiming
from trirail.diagnosis.cycle_timing import Cycles
from trirail.processes.session_guard import Guard


class BusTraffic(Struct, frozen=True):
    """Counters of a network interface over an interval."""

    seconds: float
    """Length of the interval [s]."""
    frames: int
    """Frames sent and received by all programs."""
    data: int
    """Payload of those frames [bytes]."""


class ReceiveCoalescing(Struct, frozen=True):
    """Receive coalescing of a network interface: `ethtool -c`."""

    frames: int
    """Number of frames after which an interrupt is raised. It is raised immediately if the number is 1, or if it is 0
    because the driver does not count frames."""
    microseconds: int
    """Time after which an interrupt is raised [µs]; 0 raises it immediately."""


class Machine(Struct, frozen=True):
    """Properties of the machine; a property is None if it is unknown."""

    release: str
    preempt_rt: bool
    af_can: bool
    lacking: tuple[str, ...]
    """Real-time rights that the loop would lack, each with its remedy, from trirail.processes.realtime.acquire."""
    clock_source: str | None
    resolution: float
    """Resolution of the monotonic clock [s]."""
    cpu: int
    """Number of the processor to which the loop would be pinned."""
    governors: dict[int, str]
    """Frequency governor of each processor that has frequency scaling."""
    isolated: tuple[int, ...]
    link: dict[str, Any] | None
    """Properties of the CAN interface, from `ip -details -json link`."""
    cycles: Cycles | str
    """Timing of the service's cycle, or the reason why it was not measured, and the remedy; "" if not requested."""
    traffic: BusTraffic | None = None
    """Traffic on the CAN interface during the measurement."""
    bus_timing: MeasuredTiming | str = ""
    """Timing of cycles on the SocketCAN interface, or the reason why it was not measured; "" if not requested."""
    coalescing: ReceiveCoalescing | None = None
    """Receive coalescing of the CAN interface; None if its driver does not report it."""
    adapter: str = ""
    """Package that python-can's interface needs and that is missing, with the remedy; "" if nothing is missing."""
    unwritable: str = ""
    """Reason why recordings cannot be written to their folder; "" if there is none."""
    guard: Guard | str | None = None
    """Access rules over the network, or the reason why the certificates cannot be used."""
    routers: tuple[tuple[str, str], ...] = ()
    """Endpoints of zenoh.connect, each with the reason why it cannot be reached, or ""."""
    issued: tuple[IssuedCertificate, ...] | None = None
    """Certificates issued by the authority in the folder of [zenoh.tls]; None if the authority is elsewhere."""
    limited_ports: tuple[int, ...] | None = None
    """Ports at which the firewall limits connections per address; None if its rules cannot be read."""
