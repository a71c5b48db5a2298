"""A CAN bus inside the process, with simulated drives on it and without threads."""

from __future__ import annotations

import errno
import time
from collections import deque
from collections.abc import Sequence
from functools import partial

import can

from trirail_drivers.interface import Clock
from trirail_drivers.simulated.devices import SimulatedDevice
from trirail_drivers.simulated.faults import Faults

_STEP = 0.0005
"""How long a waiting receiver sleeps before it looks at the drives again [s]."""


class SimulatedBus(can.BusABC):
    """Carries frames between one python-can user and the drives, which live by its `send` and `recv`."""

    def __init__(
        self,
        drives: Sequence[SimulatedDevice],
        clock: Clock,
        faults: Faults,
    ) -> None:
        """`faults` are those of the same drives."""
        self.drives = tuple(drives)
        self.faults = faults
        self.channel_info = "simulated drives"
        self._clock = clock
        self._arrived: deque[can.Message] = deque()
        super().__init__(channel=self.channel_info)
        now = clock()
        self.faults.connect(self._arrived.append, clock)
        everyone = range(len(self.drives))
        self._everyone = tuple(everyone)
        for index, drive in enumerate(self.drives):
            others = tuple(other for other in everyone if other != index)
            drive.connect(partial(self._from_drive, index, others), now)

    def press(self, index: int, switches: int) -> None:
        """Press switches of a slider by hand, and let go of the others: bits of its drive's digital inputs (60FDh)."""
        self.drives[index].press(switches)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - never waits
        """Bring a frame to every drive; their answers can be received at once.

        Raises can.CanOperationError while the controller is bus-off, as the system would of its full queue.
        """
        if msg.is_extended_id or msg.is_error_frame:
            return
        now = self._clock()
        if not self.faults.idle:
            self.faults.poll(now)
            if self.faults.bus_off:
                raise can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS)
        if msg.is_remote_frame:
            self._request(msg.arbitration_id, now)
        else:
            self._to_drives(self._everyone, msg.arbitration_id, bytes(msg.data))

    def _request(self, can_id: int, now: float) -> None:
        """Bring a remote frame to every drive, unless faults have it otherwise."""
        for index in self._everyone:
            if self.faults.idle:
                self.drives[index].receive_remote(can_id, now)
            else:
                self.faults.carry(index, True, can_id, b"", partial(self._hand_request_in, index, can_id))

    def _to_drives(self, indices: Sequence[int], can_id: int, data: bytes) -> None:
        """Bring a frame to some drives, unless faults have it otherwise."""
        if self.faults.idle:
            now = self._clock()
            for index in indices:
                self.drives[index].receive(can_id, data, now)
        else:
            for index in indices:
                self.faults.carry(index, True, can_id, data, partial(self._hand_in, index, can_id))

    def _hand_request_in(self, index: int, can_id: int, _data: bytes) -> None:
        self.drives[index].receive_remote(can_id, self._clock())

    def _hand_in(self, index: int, can_id: int, data: bytes) -> None:
        self.drives[index].receive(can_id, data, self._clock())

    def _from_drive(self, index: int, others: Sequence[int], can_id: int, data: bytes) -> None:
        """Bring a drive's frame to the user and the other drives, unless faults have it otherwise."""
        if self.faults.idle:
            self._hand_out(others, can_id, data)
        else:
            self.faults.carry(index, False, can_id, data, partial(self._hand_out, others, can_id))

    def _hand_out(self, others: Sequence[int], can_id: int, data: bytes) -> None:
        self._arrived.append(can.Message(timestamp=time.time(), arbitration_id=can_id, is_extended_id=False, data=data))
        self._to_drives(others, can_id, data)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._arrived:
            now = self._clock()
            if not self.faults.idle:
                self.faults.poll(now)
            for drive in self.drives:
                drive.poll(now)
            if self._arrived:
                break
            remaining = _STEP if deadline is None else deadline - time.monotonic()
            if remaining <= 0.0:
                return None, False
            time.sleep(min(remaining, _STEP))
        return self._arrived.popleft(), False
