"""What is read of a machine: trirail.cli.probes reads it, trirail.cli.doctor judges it."""

from __future__ import annotations

from typing import Any

from msgspec import Struct

from trirail.cli.key_folder import IssuedCertificate
from trirail.diagnosis.bare_loop import Cycles
from trirail.processes.session_guard import Guard


class BusTraffic(Struct, frozen=True):
    """What the kernel counted on a network interface."""

    seconds: float
    """For how long [s]."""
    frames: int
    """Sent and received, whoever listens."""
    data: int
    """Bytes in them."""


class ReceiveCoalescing(Struct, frozen=True):
    """After how many frames, or how long, a network interface hands over what it has received: ethtool -c."""

    frames: int
    """1, or 0 where the driver counts none: each as it comes."""
    microseconds: int
    """0 for no waiting [µs]."""


class Machine(Struct, frozen=True):
    """What was read of the machine; None where it does not say."""

    release: str
    preempt_rt: bool
    af_can: bool
    lacking: tuple[str, ...]
    """Real-time rights that the loop would lack, each with its remedy: trirail.processes.realtime.acquire."""
    clock_source: str | None
    resolution: float
    """Of the monotonic clock [s]."""
    cpu: int
    """The processor that the loop would stay on."""
    governors: dict[int, str]
    """How each processor's frequency is governed, of those that have any scaling."""
    isolated: tuple[int, ...]
    link: dict[str, Any] | None
    """The CAN interface as `ip -details -json link` has it."""
    cycles: Cycles | str
    """What cycles took that only exchange the frames, or why none were measured; "" where nobody asked for it."""
    traffic: BusTraffic | None = None
    """What passed on the CAN interface meanwhile."""
    coalescing: ReceiveCoalescing | None = None
    """How the CAN interface hands frames over; None where its driver does not say."""
    adapter: str = ""
    """What python-can's interface would lack, with the remedy; "" for nothing."""
    guard: Guard | str | None = None
    """Who may do what over the network, or why its certificates cannot be used."""
    routers: tuple[tuple[str, str], ...] = ()
    """Each endpoint of zenoh.connect with why it cannot be reached, "" where it can."""
    issued: tuple[IssuedCertificate, ...] | None = None
    """The certificates of the authority whose folder is that of [zenoh.tls]; None where it is elsewhere."""
    limited_ports: tuple[int, ...] | None = None
    """Ports at which the firewall limits the connections of one address; None where it cannot be read."""
