"""What tests of drives turn by hand: one simulated drive, and a driver over three of them on a bus.

What differs between protocols is in the adapters, beside their tests. The robot above its driver is conftest.Rig.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Generic, Protocol, TypeVar

import can
from trirail_drivers import config
from trirail_drivers.interface import DriveFault, DriveGroup, Feedback, PowerState, Triple
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import Frames, Servo, SimulatedBus, SimulatedDevice
from trirail_drivers.simulated.faults import Faults
from trirail_drivers.timing import BusTiming

STEP: Final = 0.001
"""The period of a driver's cycle, and how time passes for who waits [s]."""
START: Final = (0.01, -0.02, 0.03)
"""Where the sliders are at power-on [m]."""
STANDSTILL: Final = (0.0, 0.0, 0.0)
SYNC: Final = 0x080
OFF: Final = (PowerState.SWITCH_ON_DISABLED,) * 3
ENABLED: Final = (PowerState.OPERATION_ENABLED,) * 3

AnyDevice = TypeVar("AnyDevice", bound=SimulatedDevice)
AnyDriver = TypeVar("AnyDriver", bound=DriveGroup)
AnyRig = TypeVar("AnyRig")


class Closing(Protocol):
    """Gives back a rig that it is given; its drives are closed at the end of the test."""

    def __call__(self, rig: AnyRig, /) -> AnyRig: ...


def alike(counts_per_metre: float = 1e6, **keys: Any) -> tuple[config.Drive, config.Drive, config.Drive]:
    """Drives A, B, C of the configuration: nodes 1, 2, 3, and the same keys."""
    a, b, c = (config.Drive(node=node, counts_per_metre=counts_per_metre, **keys) for node in (1, 2, 3))
    return a, b, c


def frame(can_id: int, data: bytes = b"", **flags: bool) -> can.Message:
    """A frame of python-can's, by default a data frame with 11 bits of identifier."""
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **flags})


# ---------------------------------------------------------------------- one drive


class DeviceRig(Generic[AnyDevice]):
    """One simulated drive, the frames it sends, and the time."""

    def __init__(self, drive: AnyDevice) -> None:
        self.drive = drive
        self.now = 100.0
        self.frames: list[tuple[int, bytes]] = []
        self.drive.connect(lambda can_id, data: self.frames.append((can_id, data)), self.now)

    def take(self) -> list[tuple[int, bytes]]:
        """What it has sent since the last time."""
        frames, self.frames = self.frames, []
        return frames

    def send(self, can_id: int, data: bytes = b"") -> list[tuple[int, bytes]]:
        """What it answers to a frame."""
        self.drive.receive(can_id, data, self.now)
        return self.take()

    def wait(self, seconds: float, step: float = 0.0005) -> list[tuple[int, bytes]]:
        """Let time pass with nothing on the bus, polling the drive."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(self.now + step, end)
            self.drive.poll(self.now)
        return self.take()


# ---------------------------------------------------------------------- a driver and its three drives


class Clock:
    """Time that passes when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Bus(SimulatedBus):
    """The simulated bus, with a record of what the master sends, ways to break it, and waits in no time."""

    def __init__(self, drives: Sequence[SimulatedDevice], clock: Clock, fault_frames: Mapping[str, Frames]) -> None:
        self.time = clock
        self.sent: list[tuple[int, bytes]] = []
        self.broken = False
        self.shutdowns = 0
        self.late: int | None = None
        """On a real bus, a cycle reads the answers to the SYNC before its own: how many of these are left."""
        super().__init__(drives, clock, Faults(drives, [1.0] * len(drives), fault_frames))

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.broken:
            raise can.CanOperationError("Transmit buffer full")
        self.sent.append((msg.arbitration_id, bytes(msg.data)))
        if msg.arbitration_id == SYNC and self.late is not None:
            self.late = len(self._arrived)
        super().send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.late is not None:
            if not self.late:
                return None
            self.late -= 1
        end = self.time.now + (timeout or 0.0)
        while (message := super().recv(0)) is None and self.time.now < end:
            self.time.now += STEP
        return message

    def inject(self, can_id: int, data: bytes, **flags: bool) -> None:
        self._arrived.append(frame(can_id, data, **flags))

    def shutdown(self) -> None:
        self.shutdowns += 1
        super().shutdown()


class Cycles(Generic[AnyDriver]):
    """A driver, and a loop that holds position or goes on with constant speed."""

    drives: AnyDriver
    clock: Clock
    period = STEP
    target: Triple = START

    def cycle(self, position: Triple | None = None, velocity: Triple = STANDSTILL) -> Feedback:
        self.clock.now += self.period
        self.drives.sync()
        feedback = self.drives.read()
        self.drives.write(feedback.position if position is None else position, velocity)
        return feedback

    def cycles(self, number: int, position: Triple | None = None) -> Feedback:
        for _ in range(number - 1):
            self.cycle(position)
        return self.cycle(position)

    def move(self, cycles: int, speed: Triple) -> Feedback:
        """Move on from where the sliders were sent last; stop looking when there is a fault."""
        for _ in range(cycles):
            a, b, c = (place + rate * self.period for place, rate in zip(self.target, speed, strict=True))
            self.target = a, b, c
            feedback = self.cycle(self.target, speed)
            if feedback.fault is not None:
                break
        return feedback

    def last_fault(self, cycles: int) -> str:
        """What is said to be the fault after so many cycles."""
        fault = self.cycles(cycles, self.target).fault
        assert fault is not None
        return fault.message

    def found(self, cause: str, within: int) -> DriveFault:
        """Cycle until there is a fault, and see that it has this cause."""
        for _ in range(within):
            feedback = self.cycle()
            if feedback.fault is not None:
                assert feedback.fault.cause == cause
                return feedback.fault
        raise AssertionError(f"no fault: {feedback}")


class DriverRig(Cycles[AnyDriver], ABC, Generic[AnyDevice, AnyDriver]):
    """Three simulated drives, the driver, and what each was told; what differs in their protocol has a name here."""

    enabled_within: int
    """Cycles in which drives get power."""
    off: Any
    """The command that takes power off."""
    positions: str
    """What fault lines call the frames with positions."""
    first_asked: str
    """What a drive is asked for first."""
    keeps_power: str
    """What is said of a drive that keeps its power, {} being after which word."""

    def __init__(
        self,
        drives: config.Drives,
        driver: Callable[[can.BusABC, BusTiming, config.Drives, Callable[[], float]], AnyDriver],
    ) -> None:
        self.config = drives
        self.clock = Clock()
        self.devices = [
            self.device(drive, drive.direction * (start - drive.offset) * drive.counts_per_metre)
            for drive, start in zip(drives.each, START, strict=True)
        ]
        self.bus = Bus(self.devices, self.clock, PROTOCOLS[drives.protocol].fault_frames)
        self.drives = driver(self.bus, BusTiming(1_000_000), drives, self.clock)

    @abstractmethod
    def device(self, drive: config.Drive, counts: float) -> AnyDevice:
        """Make a simulated drive that stands at a position in its own unit."""

    @abstractmethod
    def commands(self) -> list[list[Any]]:
        """What each drive was told since the bus's record was cleared, without setpoints and requests."""

    @abstractmethod
    def keep_power(self, index: int) -> None:
        """Let a drive not obey what would take its power."""

    @abstractmethod
    def get_power(self, index: int) -> None:
        """Give a drive power without a command."""

    @abstractmethod
    def keep_fault(self, index: int) -> Callable[[], None]:
        """Let a drive ignore resets, as while its cause persists; return what ends that."""

    def enable(self) -> Feedback:
        self.drives.enable()
        for _ in range(self.enabled_within):
            feedback = self.cycle()
            if feedback.state == ENABLED:
                return feedback
        raise AssertionError(f"not enabled: {feedback}")

    def ready(self) -> None:
        """Set the drives up, without power."""
        self.drives.configure(STEP)
        self.bus.sent.clear()


def ideal_servo(drive: config.Drive, counts: float) -> Servo:
    """A servo without lag, of 2 m/s and 1000 m/s² at most."""
    return Servo(
        counts,
        time_constant=0.0,
        max_velocity=2.0 * drive.counts_per_metre,
        max_acceleration=1000.0 * drive.counts_per_metre,
    )
