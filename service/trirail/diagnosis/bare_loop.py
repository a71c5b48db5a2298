"""The bare loop: a cycle's frames and nothing else, in one compiled call; what the machine leaves to any loop on it.

Each cycle waits for an absolute deadline, sends SYNC, takes what has arrived by recvmmsg(2), and sends three setpoints
by sendmmsg(2). The drives are a process of their own, off the loop's processor where there is another; they answer each
SYNC with three positions over a pair of AF_UNIX sockets, so that each SYNC wakes somebody.
"""

from __future__ import annotations

import contextlib
import functools
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.interface import NAMES

from trirail.config import LoopTable
from trirail.processes import realtime
from trirail.processes.operating_system import python

TURN: Final = 0.25
"""For so long the compiled call goes on, and then Python looks at signals and progress [s]."""
_MODULE: Final = "trirail.diagnosis.bare_loop"
_SYNC, _SETPOINT, _POSITION = 0x080, 0x201, 0x181
"""Identifiers of CiA 301's predefined connections, of the first node."""
_DATA: Final = bytes(8)
_ROOM: Final = 8
"""Frames that are taken in one cycle at most."""
_MONOTONIC, _ABSOLUTE = 1, 1
"""CLOCK_MONOTONIC and TIMER_ABSTIME of linux/time.h."""


class Cycles(NamedTuple):
    """What so many cycles took."""

    lateness: NDArray[np.int64]
    """How late each began, ticks missed before it included, (n,) [ns]."""
    work: NDArray[np.int64]
    """From there until its setpoints were sent, (n,) [ns]."""
    period: int
    """[ns]."""
    answers: int
    """Positions that came, of three a cycle."""

    @property
    def missed(self) -> NDArray[np.int64]:
        """Ticks skipped before each cycle, (n,)."""
        return self.lateness // self.period


class _Frames(NamedTuple):
    """Frames in memory, and `struct mmsghdr` of sendmmsg(2) for each: linux/socket.h, 64 bits."""

    headers: NDArray[np.uint64]
    """(n, 8): name, its length, vectors, their number, control, its length, flags, length of the packet."""
    vectors: NDArray[np.uint64]
    """(n, 2) `struct iovec`: address and length."""
    content: NDArray[np.uint8]
    """(n, 16) `struct can_frame`."""


def _frames(packed: bytes) -> _Frames:
    content = np.frombuffer(packed, np.uint8).reshape(-1, CAN_FRAME.size).copy()
    vectors, headers = np.zeros((len(content), 2), np.uint64), np.zeros((len(content), 8), np.uint64)
    vectors[:, 0] = [row.ctypes.data for row in content]
    vectors[:, 1] = CAN_FRAME.size
    headers[:, 2] = [row.ctypes.data for row in vectors]
    headers[:, 3] = 1
    return _Frames(headers, vectors, content)


@functools.cache
def _compiled() -> Callable[..., int]:
    """Compile the loop, which takes seconds: here, for only a measurement needs it."""
    from numba import njit
    from numba.core import types as numba_types

    types: Any = numba_types
    i32, u32, i64, u64, address = types.int32, types.uint32, types.int64, types.uint64, types.intp
    clock_gettime = types.ExternalFunction("clock_gettime", i32(i32, address))
    clock_nanosleep = types.ExternalFunction("clock_nanosleep", i32(i32, i32, address, address))
    send = types.ExternalFunction("send", i64(i32, address, u64, i32))
    sendmmsg = types.ExternalFunction("sendmmsg", i32(i32, address, u32, i32))
    recvmmsg = types.ExternalFunction("recvmmsg", i32(i32, address, u32, i32, address))
    wait_for_none, size = int(socket.MSG_DONTWAIT), CAN_FRAME.size

    def monotonic(time):  # type: ignore[no-untyped-def]
        clock_gettime(_MONOTONIC, time.ctypes.data)
        return time[0] * 1_000_000_000 + time[1]

    now: Any = njit(monotonic)

    def run(carrier, period, sync, setpoints, inbox, time, lateness, work):  # type: ignore[no-untyped-def]
        answers = 0
        deadline = now(time)
        for k in range(len(lateness)):
            deadline += period
            time[0], time[1] = deadline // 1_000_000_000, deadline % 1_000_000_000
            while clock_nanosleep(_MONOTONIC, _ABSOLUTE, time.ctypes.data, 0) != 0:  # a signal came
                pass
            began = now(time)
            send(carrier, sync.ctypes.data, size, wait_for_none)
            answers += max(0, recvmmsg(carrier, inbox.ctypes.data, len(inbox), wait_for_none, 0))
            sendmmsg(carrier, setpoints.ctypes.data, len(setpoints), wait_for_none)
            work[k] = now(time) - began
            lateness[k] = began - deadline
            deadline += (began - deadline) // period * period
        return answers

    integers, headers = types.Array(types.int64, 1, "C"), types.Array(types.uint64, 2, "C")
    frame = types.Array(types.uint8, 2, "C")
    signature = i64(i64, i64, frame, headers, headers, integers, integers, integers)
    return njit(signature)(run)  # type: ignore[no-any-return]


def prepare() -> None:
    """Compile the loop ahead of its first call."""
    _compiled()


def measure(loop: LoopTable, rate_hz: int, seconds: float, progress: Callable[[float], None] | None = None) -> Cycles:
    """Run the bare loop for so long, with the rights that this process has; `progress` is told of the share done."""
    run, period = _compiled(), 1_000_000_000 // rate_hz
    cycles = max(1, round(seconds * rate_hz))
    lateness, work, time = np.zeros(cycles, np.int64), np.zeros(cycles, np.int64), np.zeros(2, np.int64)
    sync = _frames(CAN_FRAME.pack(_SYNC, 0, _DATA))
    setpoints = _frames(b"".join(CAN_FRAME.pack(_SETPOINT + i, 8, _DATA) for i in range(len(NAMES))))
    inbox = _frames(bytes(_ROOM * CAN_FRAME.size))
    answers, each, empty = 0, max(1, round(TURN * rate_hz)), inbox.headers
    with _drives(loop) as carrier:
        for first in range(0, cycles, each):
            part = slice(first, min(cycles, first + each))
            answers += run(
                carrier.fileno(), period, sync.content, setpoints.headers, empty, time, lateness[part], work[part]
            )  # fmt: skip
            if progress is not None:
                progress(part.stop / cycles)
    return Cycles(lateness, work, period, answers)


def measure_alone(loop: LoopTable, rate_hz: int, seconds: float) -> Cycles:
    """The same in a process that takes the loop's rights for it, and ends with them."""
    prepare()
    realtime.acquire(loop)
    return measure(loop, rate_hz, seconds)


@contextlib.contextmanager
def _drives(loop: LoopTable) -> Iterator[socket.socket]:
    """What stands for three drives, in a process of its own; it ends when the other end of its socket does."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    processor, priority = realtime.processor(loop), max(1, loop.priority - realtime.DRIVES_BELOW)
    command = python("-m", _MODULE, *(str(each) for each in (theirs.fileno(), processor, priority)))
    with ours, subprocess.Popen(command, pass_fds=[theirs.fileno()], start_new_session=True) as process:
        theirs.close()
        try:
            if ours.recv(1) != b"\n":
                raise OSError("the drives of the bare loop could not start")
            yield ours
        finally:
            ours.close()
            process.wait()


def _answer(carrier: socket.socket, processor: int, priority: int) -> None:
    """Answer every SYNC with three positions, until the loop has gone."""
    with contextlib.suppress(OSError):
        others = set(range(os.cpu_count() or 1)) - {processor}
        if others:
            os.sched_setaffinity(0, others)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    positions = [CAN_FRAME.pack(_POSITION + i, 8, _DATA) for i in range(len(NAMES))]
    sync = CAN_FRAME.pack(_SYNC, 0, _DATA)
    carrier.send(b"\n")
    with contextlib.suppress(ConnectionError):  # the loop has gone
        while frame := carrier.recv(CAN_FRAME.size):
            if frame == sync:
                for position in positions:
                    carrier.send(position)


class Spread(Struct, frozen=True):
    """Percentiles of a time [µs]."""

    p50: float
    p99: float
    p999: float
    max: float


def spread(values: NDArray[Any]) -> Spread:
    """Percentiles of times in nanoseconds."""
    return Spread(*(float(each) / 1e3 for each in np.percentile(values, (50.0, 99.0, 99.9, 100.0))))


if __name__ == "__main__":
    _answer(socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2]), int(sys.argv[3]))
