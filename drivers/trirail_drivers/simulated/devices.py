"""Interface of a simulated drive of any protocol, for the simulated bus and for injected faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from trirail_drivers.interface import PowerState
from trirail_drivers.simulated.digital import DigitalPins
from trirail_drivers.simulated.emergency import Emergencies
from trirail_drivers.simulated.servo import Servo


class SimulatedDevice(Protocol):
    """Simulated drive of any protocol on a bus."""

    node: int
    servo: Servo
    silent: bool
    """Whether the wire is cut: the drive receives and sends nothing."""

    @property
    def state(self) -> object:
        """State of the drive; `str` returns its description."""

    @property
    def power(self) -> PowerState:
        """State of CiA 402 that corresponds to the drive's state."""

    @property
    def emergencies(self) -> Emergencies | None:
        """Errors that the drive reports by EMCY; None if its protocol has no such message."""

    @property
    def pins(self) -> DigitalPins | None:
        """Digital outputs and inputs of the drive; None if its protocol has none."""

    def connect(self, transmit: Callable[[int, bytes], None], now: float) -> None:
        """Connect the drive to a bus and switch the drive on at time `now` [s].

        The drive sends each frame by calling `transmit(can_id, data)`.
        """

    def receive(self, can_id: int, data: bytes, now: float) -> None:
        """Receive a data frame."""

    def receive_remote(self, can_id: int, now: float) -> None:
        """Receive a remote frame."""

    def poll(self, now: float) -> None:
        """Do the work due at time `now` [s]."""

    def press(self, switches: int) -> None:
        """Press the given switches of the slider, bits of the digital inputs (CiA 402), and release the others."""

    def fail(self, code: int) -> None:
        """Enter the fault state with an error code of the drive's protocol."""

    def restart(self, now: float) -> None:
        """Cycle the power supply."""
