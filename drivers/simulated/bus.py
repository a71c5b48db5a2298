"""A CAN bus inside the process, with simulated drives on it and without threads."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

import can

from drivers import config
from drivers.simulated.drive import SimulatedDrive
from drivers.simulated.servo import Servo

_STEP = 0.0005
"""How long a waiting receiver sleeps before it looks at the drives again [s]."""


class SimulatedBus(can.BusABC):
    """Carries frames between one python-can user and the drives, which live by its `send` and `recv`."""

    def __init__(self, drives: Sequence[SimulatedDrive], clock: Callable[[], float] = time.monotonic) -> None:
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

    def _deliver(self, others: Sequence[SimulatedDrive], can_id: int, data: bytes) -> None:
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
    """The three drives of a configuration on a bus of their own, at rest where `can.simulated.start` says.

    A drive that is to be homed does not know where that is: it counts from 0 at power-on, and has its home switch
    at the position that the configuration gives for zero counts.
    """
    simulated = can.simulated
    devices = []
    for drive, start in zip(drives.each, simulated.start, strict=True):
        counts = round(drive.direction * (start - drive.offset) * drive.counts_per_metre)
        switch = None if drive.homing is None else -counts
        servo = Servo(
            counts if switch is None else 0,
            time_constant=simulated.time_constant,
            feed_forward_gain=simulated.feed_forward_gain,
            max_velocity=simulated.max_velocity * drive.counts_per_metre,
            max_acceleration=simulated.max_acceleration * drive.counts_per_metre,
        )
        devices.append(SimulatedDrive(drive.node, servo, simulated.missed_syncs, switch))
    return SimulatedBus(devices, clock)
