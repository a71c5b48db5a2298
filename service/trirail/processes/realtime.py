"""The loop's rights: real-time scheduling, locked memory, its own processor, no garbage collector in its way.

And for every process: release of memory that only its start needs.
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
    """Keep bursts of large blocks from fragmenting the heap; to be called before the first thread.

    malloc raises its threshold for mapping a block to the largest that was freed, and has an arena for each of
    Zenoh's threads, each of which keeps its greatest size: mallopt(3).
    """
    _libc.mallopt(_M_MMAP_THRESHOLD, 131_072)
    _libc.mallopt(_M_ARENA_MAX, 2)


def give_back() -> None:
    """Trim, and unmap the parts of libraries that their files have as well.

    Loading a library touches most of it, LLVM's 68 MB for instance; the parts needed later come from the page
    cache again.
    """
    trim()
    for start, end in _clean():
        _libc.madvise(start, end - start, _MADV_DONTNEED)


def _clean() -> Iterator[tuple[int, int]]:
    """Yield the addresses of each mapping of a library that is only read and has nothing of this process's own."""
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
"""Difference by which the planner's priority is lower than the loop's."""
DRIVES_BELOW = 5
"""The same for simulated drives: a plan takes longer than a drive has for an answer."""


def _call(name: str, *arguments: int) -> None:
    if getattr(_libc, name)(*arguments) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def die_with_parent(signal_number: int) -> None:
    """Have the kernel send this process `signal_number` when its parent ends, however that ends."""
    _call("prctl", _PR_SET_PDEATHSIG, signal_number)


def name_process(name: str) -> None:
    """Give this process a name of its own for `ps` and the like: a forked one has its parent's."""
    setproctitle(title(name))


def _fifo(loop: LoopTable) -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(loop.priority))


def _lock_memory(_: LoopTable) -> None:
    """Lock pages touched now or later: mlockall(2). All mapped pages would be five times as much."""
    _call("mlockall", _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)


def processor(loop: LoopTable) -> int:
    """Return the processor that the loop stays on."""
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
    """Keep off the loop's processor if there is another, and `below` its priority; return failures."""
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
    """Take every measure that the configuration asks for; return those that failed, each with its remedy.

    Raises ServiceError with `realtime = "enforce"` if one of them is missing.
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
