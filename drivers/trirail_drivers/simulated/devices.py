"""What a simulated bus and its faults need of a drive, whatever it speaks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from trirail_drivers.interface import PowerState
from trirail_drivers.simulated.emergency import Emergencies
from trirail_drivers.simulated.servo import Servo


class SimulatedDevice(Protocol):
    """A drive on the bus, of any protocol."""

    node: int
    servo: Servo
    silent: bool
    """True cuts the wire: nothing is heard or sent any more."""

    @property
    def state(self) -> object:
        """Its state; `str` gives it in words."""

    @property
    def power(self) -> PowerState:
        """Its state as CiA 402 has it."""

    @property
    def emergencies(self) -> Emergencies | None:
        """The errors that it tells by EMCY; None where its protocol has no such message."""

    def connect(self, transmit: Callable[[int, bytes], None], now: float) -> None:
        """Put it on a bus, that it sends to by `transmit(can_id, data)`, and switch it on."""

    def receive(self, can_id: int, data: bytes, now: float) -> None:
        """Take in a data frame."""

    def receive_remote(self, can_id: int, now: float) -> None:
        """Take in a remote frame."""

    def poll(self, now: float) -> None:
        """Do what is due."""

    def press(self, switches: int) -> None:
        """Have these switches of its slider pressed: bits of CiA 402's digital inputs."""

    def fail(self, code: int) -> None:
        """Break down with an error code of its protocol."""

    def restart(self, now: float) -> None:
        """Lose power for a moment."""
