"""Exchange of frames between a master and simulated drives, and among the drives, with the effects of faults."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from trirail_drivers.bus.can_frame import ERROR, EXTENDED, REMOTE, STANDARD_BITS
from trirail_drivers.interface import Clock
from trirail_drivers.simulated.devices import SimulatedDevice
from trirail_drivers.simulated.faults import Faults

_FLAGS: Final = EXTENDED | REMOTE | ERROR


class SimulatedExchange:
    """Simulated drives without a bus.

    The owner passes the master's frames and the time to this object, and receives the frames of the drives. Identifiers
    include the flags of `struct can_frame`.
    """

    def __init__(
        self, drives: Sequence[SimulatedDevice], clock: Clock, faults: Faults, emit: Callable[[int, bytes], None]
    ) -> None:
        """Switch the drives on; `faults` act on these drives, and `emit` receives the frames for the master."""
        self._drives = tuple(drives)
        self._faults = faults
        self._clock = clock
        self._emit = emit
        now = clock()
        faults.connect(emit, clock)
        everyone = range(len(self._drives))
        self._everyone = tuple(everyone)
        for index, drive in enumerate(self._drives):
            others = tuple(other for other in everyone if other != index)
            drive.connect(partial(self._from_drive, index, others), now)

    def receive(self, identifier: int, data: bytes, now: float) -> bool:
        """Deliver a frame from the master to every drive at time `now` [s].

        Return False, without delivery, if the controller is bus-off, otherwise True.
        """
        if not self._faults.idle:
            self._faults.poll(now)
            if self._faults.bus_off:
                return False
        if not identifier & _FLAGS:
            self._to_drives(self._everyone, identifier, data)
        elif identifier & _FLAGS == REMOTE:
            self._request(identifier & STANDARD_BITS, now)
        return True

    def poll(self, now: float) -> None:
        """Do the work due at time `now` [s]."""
        if not self._faults.idle:
            self._faults.poll(now)
        for drive in self._drives:
            drive.poll(now)

    def _request(self, can_id: int, now: float) -> None:
        """Deliver a remote frame to every drive, subject to the active simulated faults."""
        for index in self._everyone:
            if self._faults.idle:
                self._drives[index].receive_remote(can_id, now)
            else:
                self._faults.carry(index, True, can_id, b"", partial(self._deliver_request, index, can_id))

    def _to_drives(self, indices: Sequence[int], can_id: int, data: bytes) -> None:
        """Deliver a frame to the drives with these indices, subject to the active simulated faults."""
        if self._faults.idle:
            now = self._clock()
            for index in indices:
                self._drives[index].receive(can_id, data, now)
        else:
            for index in indices:
                self._faults.carry(index, True, can_id, data, partial(self._deliver_to_drive, index, can_id))

    def _deliver_request(self, index: int, can_id: int, _data: bytes) -> None:
        self._drives[index].receive_remote(can_id, self._clock())

    def _deliver_to_drive(self, index: int, can_id: int, data: bytes) -> None:
        self._drives[index].receive(can_id, data, self._clock())

    def _from_drive(self, index: int, others: Sequence[int], can_id: int, data: bytes) -> None:
        """Deliver a drive's frame to the master and the other drives, subject to the active simulated faults."""
        if self._faults.idle:
            self._deliver_from_drive(others, can_id, data)
        else:
            self._faults.carry(index, False, can_id, data, partial(self._deliver_from_drive, others, can_id))

    def _deliver_from_drive(self, others: Sequence[int], can_id: int, data: bytes) -> None:
        self._emit(can_id, data)
        self._to_drives(others, can_id, data)
