"""Real-time rights of the loop: scheduling, locked memory, a processor of its own, no garbage collection.

Functions for all processes release memory that is needed only at their start.
"""

from __future__ import annotations

import ctypes
import gc
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from setproctitle import setproctitle

from trirail.config import LoopTable
from trirail.errors import ServiceError
from trirail.processes.operating_system import title

_MADV_DONTNEED = 4
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8

_libc = ctypes.CDLL(None, use_errno=True)
_libc.madvise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int


def trim() -> None:
    """Collect garbage, and return free memory to the system."""
    gc.collect()
    return_free_memory()


def return_free_memory() -> None:
    """Return malloc's free memory to the system."""
    _libc.malloc_trim(0)


def bound_heap() -> None:
    """Keep bursts of large blocks from fragmenting the heap; call before the first thread starts."""
    # mallopt(3): by default malloc raises its threshold for mapping a block to the largest block that was freed, and
    # each of Zenoh's threads gets an arena that keeps its greatest size.
    _libc.mallopt(_M_MMAP_THRESHOLD, 131_072)
    _libc.mallopt(_M_ARENA_MAX, 2)


def release_startup_memory() -> None:
    """Trim the heap, and drop the pages of libraries that can be read from their files again."""
    # Loading a library touches most of it, LLVM's 68 MB for instance; pages needed later come from the page cache.
    trim()
    for start, end in _clean():
        _libc.madvise(start, end - start, _MADV_DONTNEED)


def _clean() -> Iterator[tuple[int, int]]:
    """Yield the address range of each library mapping that is read-only and has no private pages."""
    path, rights, start, end = "", "", 0, 0
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines():
        first, *rest = line.split()
        if not first.endswith(":"):
            start, end = (int(address, 16) for address in first.split("-"))
            rights, path = rest[0], rest[-1]
        elif first == "Anonymous:" and rest[0] == "0" and rights[1] == "-" and ".so" in path:
            yield start, end


_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_PR_SET_PDEATHSIG, _PR_SET_TIMERSLACK = 1, 29

PLANNER_BELOW = 10
"""Difference between the priorities of the loop and the planner."""
DRIVES_BELOW = 5
"""Difference between the priorities of loop and simulated drives; drives must answer while the planner works."""


def _call(name: str, *arguments: int) -> None:
    if getattr(_libc, name)(*arguments) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def die_with_parent(signal_number: int) -> None:
    """Make the kernel send this process a signal when its parent ends."""
    _call("prctl", _PR_SET_PDEATHSIG, signal_number)


def name_process(name: str) -> None:
    """Set the name of this process in `ps`; a forked process would keep its parent's."""
    setproctitle(title(name))


def _fifo(loop: LoopTable) -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(loop.priority))


def _lock_memory(_: LoopTable) -> None:
    """Lock all current and future pages in memory."""
    # mlockall(2) with MCL_ONFAULT: all mapped pages would be five times as much memory as those in use.
    _call("mlockall", _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)


def processor(loop: LoopTable) -> int:
    """Return the number of the loop's processor."""
    return max(os.sched_getaffinity(0)) if loop.cpu is None else loop.cpu


def _pin(loop: LoopTable) -> None:
    os.sched_setaffinity(0, {processor(loop)})


def _stay_awake(_: LoopTable) -> None:
    # Documentation/power/pm_qos_interface: the request holds for as long as the file stays open.
    handle = os.open("/dev/cpu_dma_latency", os.O_WRONLY | os.O_CLOEXEC)
    os.write(handle, struct.pack("i", 0))


_MEASURES: tuple[tuple[str, Callable[[LoopTable], None], str], ...] = (
    ("SCHED_FIFO", _fifo, "run as root, or allow it: systemd LimitRTPRIO=99, or rtprio in limits.conf"),
    (
        "locked memory",
        _lock_memory,
        "run as root, or allow it: systemd LimitMEMLOCK=infinity, or memlock in limits.conf",
    ),
    ("pinned processor", _pin, "name a processor that this process may use in loop.cpu"),
)


def stay_beside(loop: LoopTable, below: int) -> tuple[str, ...]:
    """Move this process off the loop's processor, if there is another, and set its priority; return failures.

    `below` is the difference between the priorities of the loop and of this process.
    """
    trim()
    gc.freeze()
    if loop.realtime == "off":
        return ()
    lacking = []
    others = os.sched_getaffinity(0) - {processor(loop)}
    try:
        if others:
            os.sched_setaffinity(0, others)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(max(1, loop.priority - below)))
    except OSError as error:
        lacking.append(f"SCHED_FIFO: {error.strerror}")
    return tuple(lacking)


def acquire(loop: LoopTable) -> tuple[str, ...]:
    """Acquire the real-time rights that the configuration requests; return those that failed, each with its remedy.

    Raises ServiceError if one fails with `realtime = "enforce"`.
    """
    _call("prctl", _PR_SET_TIMERSLACK, 1)  # 50 µs by default for tasks that are not real-time
    trim()
    gc.freeze()
    gc.disable()
    if loop.realtime == "off":
        return ('real-time scheduling: switched off by loop.realtime = "off"',)
    lacking = []
    for name, measure, remedy in _MEASURES:
        try:
            measure(loop)
        except OSError as error:
            lacking.append(f"{name}: {error.strerror}; {remedy}")
    if lacking and loop.realtime == "enforce":
        raise ServiceError('loop.realtime = "enforce", but this process lacks ' + "; ".join(lacking))
    if os.path.exists("/dev/cpu_dma_latency") and os.access("/dev/cpu_dma_latency", os.W_OK):
        _stay_awake(loop)
    return tuple(lacking)
