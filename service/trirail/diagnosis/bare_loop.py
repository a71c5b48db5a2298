"""Measurement of the best timing that this machine allows, with a bare loop that only exchanges the frames of a cycle.

Each cycle waits for an absolute deadline, sends SYNC, reads the frames that have arrived, and sends three setpoints.
The loop consists of the same compiled functions as the service's cycle. A separate process replaces the drives, on
another processor if the machine has one. This process answers each SYNC with three positions over a pair of AF_UNIX
sockets, so that each SYNC wakes a process.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames, packed_frames
from trirail_drivers.driver.cyclic import MOST_FRAMES, TIMES
from trirail_drivers.interface import NAMES

from trirail.config import LoopTable
from trirail.processes import realtime
from trirail.processes.operating_system import python
from trirail.wire.state import Percentiles

BATCH_S: Final = 0.25
"""Duration of one call of the compiled loop [s]. Between the calls, Python handles signals and reports progress."""
_MODULE: Final = "trirail.diagnosis.bare_loop"
_SYNC, _SETPOINT, _POSITION = 0x080, 0x201, 0x181
"""CAN identifiers of SYNC and of the first node's setpoint and position (CiA 301, predefined connection set)."""
_DATA: Final = bytes(8)


class Cycles(NamedTuple):
    """Measured times of n cycles."""

    lateness: NDArray[np.int64]
    """Delay of the start of each cycle, including the ticks missed before the cycle, (n,) [ns]."""
    work: NDArray[np.int64]
    """Time from the start of each cycle until its setpoints were sent, (n,) [ns]."""
    period: int
    """Period of the cycle [ns]."""
    answers: int
    """Number of positions received, which is three for each cycle if no position is lost."""

    @property
    def missed(self) -> NDArray[np.int64]:
        """Number of ticks missed before each cycle, (n,)."""
        return self.lateness // self.period


class BareBus:
    """Buffers and socket with which trirail.processes.cycle_frames exchanges the frames of a cycle."""

    def __init__(self, descriptor: int, sync: Frame, setpoints: Sequence[Frame]) -> None:
        """`sync` is sent at the start of each cycle, `setpoints` at its end."""
        self._bus = np.array(BusAccess(descriptor), np.int64)
        self._sync, self._setpoints = packed_frames([sync]), packed_frames(setpoints)
        self._arrived = PackedFrames(MOST_FRAMES)
        self._times, self._moment = np.zeros(1, TIMES), np.zeros(2, np.int64)

    def exchange(self, period_ns: int, lateness: NDArray[np.int64], work: NDArray[np.int64]) -> int:
        """Run n cycles, and write their times to `lateness` and `work`, (n,) each [ns].

        Return the number of frames received.
        """
        # Imported here, because compiled code takes seconds to load and only a measurement needs it.
        from trirail.processes.cycle_frames import exchange_frames

        sync, setpoints, arrived = self._sync, self._setpoints, self._arrived
        sent = sync.headers, sync.frames, setpoints.headers, setpoints.frames
        memory = arrived.headers, arrived.frames, self._times, self._moment
        return exchange_frames(self._bus, period_ns, *sent, *memory, lateness, work)


def _frames_of_drives(descriptor: int) -> BareBus:
    return BareBus(descriptor, Frame(_SYNC), [Frame(_SETPOINT + i, _DATA) for i in range(len(NAMES))])


def prepare() -> None:
    """Compile the loop, so that the first cycle is not delayed."""
    none = np.zeros(0, np.int64)
    _frames_of_drives(0).exchange(1, none, none)


def measure(loop: LoopTable, rate_hz: int, seconds: float, progress: Callable[[float], None] | None = None) -> Cycles:
    """Run the bare loop for `seconds` [s] with the present rights of this process.

    `progress` is called with the fraction of the cycles that has been completed.
    """
    period = 1_000_000_000 // rate_hz
    cycles = max(1, round(seconds * rate_hz))
    lateness, work = np.zeros(cycles, np.int64), np.zeros(cycles, np.int64)
    answers, each = 0, max(1, round(BATCH_S * rate_hz))
    prepare()
    with _drives(loop) as carrier:
        bus = _frames_of_drives(carrier.fileno())
        for first in range(0, cycles, each):
            part = slice(first, min(cycles, first + each))
            answers += bus.exchange(period, lateness[part], work[part])
            if progress is not None:
                progress(part.stop / cycles)
    return Cycles(lateness, work, period, answers)


def measure_alone(loop: LoopTable, rate_hz: int, seconds: float) -> Cycles:
    """Acquire the real-time rights of the service's loop, and run the bare loop for `seconds` [s].

    The process has these rights until it ends.
    """
    prepare()
    realtime.acquire(loop)
    return measure(loop, rate_hz, seconds)


@contextlib.contextmanager
def _drives(loop: LoopTable) -> Iterator[socket.socket]:
    """Start the process that replaces the three drives, and yield the socket to it.

    The process ends when the context ends.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    processor, priority = realtime.processor(loop), max(1, loop.priority - realtime.DRIVES_BELOW)
    command = python("-m", _MODULE, *(str(each) for each in (theirs.fileno(), processor, priority)))
    with ours, subprocess.Popen(command, pass_fds=[theirs.fileno()], start_new_session=True) as process:
        theirs.close()
        try:
            if ours.recv(1) != b"\n":
                raise OSError("bare loop: the process of its drives did not start")
            yield ours
        finally:
            ours.close()
            process.wait()


def _answer(carrier: socket.socket, processor: int, priority: int) -> None:
    """Answer every SYNC with three positions until the loop closes its socket; main function of the drives' process."""
    with contextlib.suppress(OSError):
        others = set(range(os.cpu_count() or 1)) - {processor}
        if others:
            os.sched_setaffinity(0, others)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    positions = [CAN_FRAME.pack(_POSITION + i, 8, _DATA) for i in range(len(NAMES))]
    sync = CAN_FRAME.pack(_SYNC, 0, _DATA)
    carrier.send(b"\n")
    with contextlib.suppress(ConnectionError):  # the loop has closed its socket
        while frame := carrier.recv(CAN_FRAME.size):
            if frame == sync:
                for position in positions:
                    carrier.send(position)


def compute_percentiles(values: NDArray[Any]) -> Percentiles:
    """Return the percentiles [µs] of times [ns]."""
    return Percentiles(*(float(each) / 1e3 for each in np.percentile(values, (50.0, 99.0, 99.9, 100.0))))


if __name__ == "__main__":
    _answer(socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2]), int(sys.argv[3]))
