"""Real-time rights of the loop: real-time scheduling, locked memory, a separate processor and no garbage collection.

The module also contains functions with which every process releases the memory that it needs only at its start.
"""

from __future__ import annotations

import ctypes
import gc
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
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
    """Collect garbage, and return free memory to the operating system."""
    gc.collect()
    return_free_memory()


def return_free_memory() -> None:
    """Return the free memory of malloc to the operating system."""
    _libc.malloc_trim(0)


def bound_heap() -> None:
    """Prevent bursts of large blocks from fragmenting the heap. Call this function before the first thread starts."""
    # mallopt(3): by default, malloc maps only blocks that are larger than any block that was freed before, and each of
    # Zenoh's threads has an arena that never becomes smaller.
    _libc.mallopt(_M_MMAP_THRESHOLD, 131_072)
    _libc.mallopt(_M_ARENA_MAX, 2)


def release_startup_memory() -> None:
    """Trim the heap, and release those memory pages of libraries that can be read from their files again."""
    # Loading a library reads most of it into memory, for example 68 MB of LLVM. Pages that are needed later are read
    # again from the page cache.
    trim()
    for start, end in _clean():
        _libc.madvise(start, end - start, _MADV_DONTNEED)


def _clean() -> Iterator[tuple[int, int]]:
    """Yield the address range of each mapping of a library that is read-only and has no private pages."""
    path, rights, start, end = "", "", 0, 0
    try:
        mappings = Path("/proc/self/smaps").read_text(encoding="utf-8", errors="surrogateescape")
    except OSError:  # the kernel has no smaps, so that nothing can be released
        return
    for line in mappings.splitlines():
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
"""Difference between the priorities of the loop and the simulated drives.

It is smaller than that of the planner, because the drives must answer while the planner works.
"""


def _call(name: str, *arguments: int) -> None:
    if getattr(_libc, name)(*arguments) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def die_with_parent(signal_number: int) -> None:
    """Make the kernel send a signal to this process when the parent process ends."""
    _call("prctl", _PR_SET_PDEATHSIG, signal_number)


def offer_to_oom_killer() -> None:
    """Make the kernel end this process before the other processes of the service, if memory runs out.

    The score that all of them have inherited is not always 0: containers often begin with 900 or more of 1,000.
    """
    score = Path("/proc/self/oom_score_adj")
    with suppress(OSError):
        score.write_text(str(min(int(score.read_text(encoding="ascii")) + 500, 1000)), encoding="ascii")


def name_process(name: str) -> None:
    """Set the name of this process in `ps`. Otherwise, a forked process would have the name of its parent."""
    setproctitle(title(name))


def _fifo(loop: LoopTable) -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(loop.priority))


def _lock_memory(_: LoopTable) -> None:
    """Lock all current and future pages in memory."""
    # mlockall(2) with MCL_ONFAULT locks only pages in use. All mapped pages would need five times as much memory.
    _call("mlockall", _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)


def processor(loop: LoopTable) -> int:
    """Return the number of the processor on which the loop runs."""
    return max(os.sched_getaffinity(0)) if loop.cpu is None else loop.cpu


def _pin(loop: LoopTable) -> None:
    os.sched_setaffinity(0, {processor(loop)})


def _stay_awake(_: LoopTable) -> None:
    # Documentation/power/pm_qos_interface: the request is valid as long as the file stays open.
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
    """Move this process away from the loop's processor, if there is another processor, and set its priority.

    `below` is the difference between the priorities of the loop and of this process. Return a message for each failure.
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
    """Acquire the real-time rights that the configuration requests.

    Return a message with the remedy for each right that could not be acquired. Raises ServiceError if a right cannot be
    acquired and `realtime = "enforce"` is set.
    """
    _call("prctl", _PR_SET_TIMERSLACK, 1)  # the default is 50 µs for tasks without real-time scheduling
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
    with suppress(OSError):  # its absence is no lack: sleep states cost microseconds
        _stay_awake(loop)
    return tuple(lacking)
