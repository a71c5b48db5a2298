"""Interface of a simulated drive, of any protocol, to the bus and its faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from trirail_drivers.interface import PowerState
from trirail_drivers.simulated.digital import DigitalPins
from trirail_drivers.simulated.emergency import Emergencies
from trirail_drivers.simulated.servo import Servo


class SimulatedDevice(Protocol):
    """Drive on the bus, of any protocol."""

    node: int
    servo: Servo
    silent: bool
    """Whether its wire is cut: it receives and sends nothing."""

    @property
    def state(self) -> object:
        """State of the drive; `str` gives it in words."""

    @property
    def power(self) -> PowerState:
        """State of the drive in terms of CiA 402."""

    @property
    def emergencies(self) -> Emergencies | None:
        """Errors that it reports by EMCY; None if its protocol has no such message."""

    @property
    def pins(self) -> DigitalPins | None:
        """Its digital outputs and inputs; None if its protocol has none."""

    def connect(self, transmit: Callable[[int, bytes], None], now: float) -> None:
        """Put it on a bus, to which it sends with `transmit(can_id, data)`, and switch it on."""

    def receive(self, can_id: int, data: bytes, now: float) -> None:
        """Receive a data frame."""

    def receive_remote(self, can_id: int, now: float) -> None:
        """Receive a remote frame."""

    def poll(self, now: float) -> None:
        """Do the work due at time `now` [s]."""

    def press(self, switches: int) -> None:
        """Press these switches of its slider: bits of the digital inputs (CiA 402)."""

    def fail(self, code: int) -> None:
        """Enter the fault state with an error code of its protocol."""

    def restart(self, now: float) -> None:
        """Cycle the power supply."""
