"""Simulated CAN bus within this process, with simulated drives and without threads."""

from __future__ import annotations

import errno
import time
from collections import deque
from collections.abc import Sequence

import can

from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.bus.frames import can_id, fd_packed, is_fd, unpacked
from trirail_drivers.interface import Clock
from trirail_drivers.simulated.devices import SimulatedDevice
from trirail_drivers.simulated.exchange import SimulatedExchange
from trirail_drivers.simulated.faults import Faults

_STEP = 0.0005
"""Interval at which a waiting receiver polls the drives [s]."""


class SimulatedBus(can.BusABC):
    """CAN bus between one python-can user and the drives, which run only inside its `send` and `recv`."""

    def __init__(
        self,
        drives: Sequence[SimulatedDevice],
        clock: Clock,
        faults: Faults,
        *,
        fd: bool = False,
    ) -> None:
        """Connect the drives to the bus; `faults` act on these drives. If `fd`, the drives send CAN FD frames."""
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self.drives = tuple(drives)
        self.faults = faults
        self.channel_info = "simulated drives"
        self._clock = clock
        self._arrived: deque[can.Message] = deque()
        super().__init__(channel=self.channel_info)
        self._exchange = SimulatedExchange(self.drives, clock, faults, self._emit)

    def press(self, index: int, switches: int) -> None:
        """Press the given switches of a slider, bits of the digital inputs 60FDh, and release the others."""
        self.drives[index].press(switches)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - never waits
        """Deliver a frame to every drive. The answers of the drives can be received immediately.

        While the controller is bus-off, raises the same can.CanOperationError as a socket with a full transmit queue.
        """
        if not self._exchange.receive(can_id(msg), bytes(msg.data), self._clock()):
            raise can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS)

    def _emit(self, identifier: int, data: bytes) -> None:
        frame = CAN_FRAME.pack(identifier, len(data), data)
        self._arrived.append(unpacked(fd_packed(frame) if is_fd(self) else frame, time.time()))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._arrived:
            self._exchange.poll(self._clock())
            if self._arrived:
                break
            remaining = _STEP if deadline is None else deadline - time.monotonic()
            if remaining <= 0.0:
                return None, False
            time.sleep(min(remaining, _STEP))
        return self._arrived.popleft(), False
