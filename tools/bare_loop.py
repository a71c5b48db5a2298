"""Bare loop that only exchanges the frames of a cycle, to measure the best timing that this machine allows.

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
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from trirail.config import LoopTable
from trirail.diagnosis.bus_timing import BareBus
from trirail.processes import realtime
from trirail.processes.operating_system import python
from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.bus.frames import Frame
from trirail_drivers.interface import NAMES

_SYNC, _SETPOINT, _POSITION = 0x080, 0x201, 0x181
"""CAN identifiers of SYNC and of the first node's setpoint and position (CiA 301, predefined connection set)."""
_DATA = bytes(8)
_BUSY = """
import os, sys
os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
os.sched_setaffinity(0, {int(sys.argv[1])})
while os.getppid() == int(sys.argv[2]):
    pass
"""
"""Program that keeps a processor busy until its parent has ended. It gives up inherited real-time rights first."""


class BareCycles(NamedTuple):
    """Measured times of n cycles of the bare loop."""

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


def _frames_of_drives(descriptor: int) -> BareBus:
    return BareBus(descriptor, Frame(_SYNC), [Frame(_SETPOINT + i, _DATA) for i in range(len(NAMES))])


def prepare() -> None:
    """Compile the loop, so that the first cycle is not delayed."""
    _frames_of_drives(0)


def measure(loop: LoopTable, rate_hz: int, seconds: float, *, busy: bool = False) -> BareCycles:
    """Acquire the real-time rights of the service's loop, and run the bare loop for `seconds` [s].

    The process has these rights until it ends. With `busy`, an ordinary program keeps every other processor busy, as
    the other processes of a service may: it takes longer then to wake the drives.
    """
    prepare()
    realtime.acquire(loop)
    period, cycles = 1_000_000_000 // rate_hz, max(1, round(seconds * rate_hz))
    lateness, work = np.zeros(cycles, np.int64), np.zeros(cycles, np.int64)
    with _drives(loop) as carrier, _busy_processors(loop) if busy else contextlib.nullcontext():
        answers = _frames_of_drives(carrier.fileno()).exchange(period, lateness, work)
    return BareCycles(lateness, work, period, answers)


@contextlib.contextmanager
def _busy_processors(loop: LoopTable) -> Iterator[None]:
    """Keep every processor busy except that of the loop, without real-time rights, until the context ends."""
    with contextlib.ExitStack() as stack:
        for processor in set(range(os.cpu_count() or 1)) - {realtime.processor(loop)}:
            command = [sys.executable, "-c", _BUSY, str(processor), str(os.getpid())]
            spinning = stack.enter_context(subprocess.Popen(command, start_new_session=True))
            stack.callback(spinning.kill)
        yield


@contextlib.contextmanager
def _drives(loop: LoopTable) -> Iterator[socket.socket]:
    """Start the process that replaces the three drives, and yield the socket to it.

    The process ends when the context ends.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    processor, priority = realtime.processor(loop), max(1, loop.priority - realtime.DRIVES_BELOW)
    command = python(__file__, *(str(each) for each in (theirs.fileno(), processor, priority)))
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


if __name__ == "__main__":
    _answer(socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2]), int(sys.argv[3]))
