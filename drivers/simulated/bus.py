"""A CAN bus inside the process, with simulated drives on it and without threads."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

import can

from drivers import config
from drivers.axis import MISSED_HEARTBEATS
from drivers.simulated.drive import SimulatedDrive
from drivers.simulated.odrive import SimulatedOdrive
from drivers.simulated.servo import Servo

_STEP = 0.0005
"""How long a waiting receiver sleeps before it looks at the drives again [s]."""
FRICTION = 2.0
"""How an ODrive's slider slows down that coasts [m/s²]."""


class SimulatedDevice(Protocol):
    """A drive on the bus, of any protocol."""

    servo: Servo
    silent: bool
    """True cuts the wire: nothing is heard or sent any more."""

    @property
    def state(self) -> object:
        """Its state; `str` gives it in words."""

    def connect(self, transmit: Callable[[int, bytes], None], now: float) -> None:
        """Put it on a bus, that it sends to by `transmit(can_id, data)`, and switch it on."""

    def receive(self, can_id: int, data: bytes, now: float) -> None:
        """Take in a data frame."""

    def receive_remote(self, can_id: int, now: float) -> None:
        """Take in a remote frame."""

    def poll(self, now: float) -> None:
        """Do what is due."""

    def fail(self, code: int) -> None:
        """Break down with an error code of its protocol."""


class SimulatedBus(can.BusABC):
    """Carries frames between one python-can user and the drives, which live by its `send` and `recv`."""

    def __init__(self, drives: Sequence[SimulatedDevice], clock: Callable[[], float] = time.monotonic) -> None:
        self.drives = tuple(drives)
        self.channel_info = "simulated drives"
        self._clock = clock
        self._arrived: deque[can.Message] = deque()
        super().__init__(channel=self.channel_info)
        now = clock()
        for drive in self.drives:
            others = tuple(other for other in self.drives if other is not drive)
            drive.connect(partial(self._deliver, others), now)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - never waits
        """Bring a frame to every drive; their answers can be received at once."""
        if msg.is_extended_id or msg.is_error_frame:
            return
        now = self._clock()
        if msg.is_remote_frame:
            for drive in self.drives:
                drive.receive_remote(msg.arbitration_id, now)
            return
        can_id, data = msg.arbitration_id, bytes(msg.data)
        for drive in self.drives:
            drive.receive(can_id, data, now)

    def _deliver(self, others: Sequence[SimulatedDevice], can_id: int, data: bytes) -> None:
        """Bring a drive's frame to the user and the other drives."""
        self._arrived.append(can.Message(timestamp=time.time(), arbitration_id=can_id, is_extended_id=False, data=data))
        now = self._clock()
        for drive in others:
            drive.receive(can_id, data, now)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._arrived:
            now = self._clock()
            for drive in self.drives:
                drive.poll(now)
            if self._arrived:
                break
            remaining = _STEP if deadline is None else deadline - time.monotonic()
            if remaining <= 0.0:
                return None, False
            time.sleep(min(remaining, _STEP))
        return self._arrived.popleft(), False


def simulated_bus(can: config.Can, drives: config.Drives, clock: Callable[[], float] = time.monotonic) -> SimulatedBus:
    """The three drives of a configuration on a bus of their own, at rest where `can.simulated.start` says."""
    make = {"cia402": _servo_drive, "odrive": _odrive}[drives.protocol]
    starts = zip(drives.each, can.simulated.start, strict=True)
    return SimulatedBus([make(can.simulated, drives, drive, start) for drive, start in starts], clock)


def _servo_drive(
    simulated: config.Simulated,
    drives: config.Drives,  # noqa: ARG001  one signature for both
    drive: config.Drive,
    start: float,
) -> SimulatedDevice:
    return SimulatedDrive(drive.node, _servo(simulated, drive, round(_counts(drive, start))), simulated.missed_syncs)


def _odrive(simulated: config.Simulated, drives: config.Drives, drive: config.Drive, start: float) -> SimulatedDevice:
    return SimulatedOdrive(
        drive.node,
        _servo(simulated, drive, _counts(drive, start)),
        heartbeat=drives.heartbeat,
        friction=FRICTION * drive.counts_per_metre,
        # As long as a CiA 402 drive waits for its master: CANSimple has no way to tell a drive.
        watchdog=MISSED_HEARTBEATS * drives.heartbeat,
    )


def _counts(drive: config.Drive, position: float) -> float:
    return drive.direction * (position - drive.offset) * drive.counts_per_metre


def _servo(simulated: config.Simulated, drive: config.Drive, counts: float) -> Servo:
    return Servo(
        counts,
        time_constant=simulated.time_constant,
        feed_forward_gain=simulated.feed_forward_gain,
        max_velocity=simulated.max_velocity * drive.counts_per_metre,
        max_acceleration=simulated.max_acceleration * drive.counts_per_metre,
    )
