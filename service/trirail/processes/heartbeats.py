"""Heartbeats and urgent requests between the service's processes, as counters in shared memory, and detection of hangs.

A beat and a check cost 0.1 µs and never wait. Unlike packets, counters do not queue, so a frozen process fills no
buffer. A process beats in the thread that does its work, so that a hung process stops beating.

A process can also be silent because a busy machine keeps it waiting, and killing it would only add load. Silence
therefore counts only the time in which a process could have beaten: the processor time of its main thread, and the
checks that found it stopped or asleep. Time spent waiting for a processor or a disk does not count.
"""

from __future__ import annotations

import mmap
import os
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

PROCESSES = ("loop", "gateway", "planner", "recorder")
"""Processes that beat in shared memory; the simulated drives send heartbeats on their bus instead."""
URGENT_INDEX = len(PROCESSES)
"""Index of the counter of urgent requests."""
BEAT_EVERY = 0.05
"""Longest interval between two beats of a process, even while it is idle [s]."""


class Heartbeats:
    """Shared counters, one per process; a counter is 0 while its process is not expected to beat."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        """Descriptor of the shared memory, inherited by all processes."""
        self._close: Callable[[], object] | None = None
        self._counts = memoryview(mmap.mmap(descriptor, mmap.PAGESIZE)).cast("Q")

    @property
    def counts(self) -> memoryview[int]:
        """All counters, in the order of PROCESSES, then that of urgent requests."""
        return self._counts

    @classmethod
    def create(cls) -> Heartbeats:
        """Create counters, all 0; their descriptor is closed when the object is collected."""
        descriptor = os.memfd_create("trirail-heartbeats")
        os.ftruncate(descriptor, mmap.PAGESIZE)
        created = cls(descriptor)
        created._close = weakref.finalize(created, os.close, descriptor)
        return created

    def close(self) -> None:
        """Close the descriptor if this process has created the counters; the counters stay usable."""
        if self._close is not None:
            self._close()

    def heart(self, process: str) -> Heart:
        """Return the counter of a process of PROCESSES."""
        return Heart(self._counts, PROCESSES.index(process))

    @contextmanager
    def urgent_section(self) -> Iterator[None]:
        """Mark packets sent inside the context as urgent: the loop handles them in the cycle of their arrival."""
        # Count before and after the packet: whenever the loop checks, it finds a new count or the packet itself.
        self._counts[URGENT_INDEX] += 1
        yield
        self._counts[URGENT_INDEX] += 1


class Heart:
    """Heartbeat counter of one process."""

    def __init__(self, counts: memoryview[int], place: int) -> None:
        self._counts = counts
        self._place = place

    def beat(self) -> None:
        """Count a beat."""
        self._counts[self._place] += 1

    def rest(self) -> None:
        """Reset the counter; the process is not expected to beat until its next beat."""
        self._counts[self._place] = 0

    @property
    def count(self) -> int:
        """Number of beats; 0 while the process is not expected to beat."""
        return self._counts[self._place]


class UrgentFlag:
    """Detector of urgent requests, for the loop."""

    def __init__(self, heartbeats: Heartbeats) -> None:
        self._counts = heartbeats.counts
        self.seen = 0
        """Count at the last check."""

    def was_raised(self) -> bool:
        """Return whether there has been an urgent request since the last call."""
        before, self.seen = self.seen, self._counts[URGENT_INDEX]
        return self.seen != before


class Watch:
    """Time-out on the heartbeat of another process.

    The time-out counts the watcher's own checks, not wall time, so that a stalled machine does not look like a frozen
    process. `patience` is the number of checks without a beat that are tolerated.
    """

    def __init__(self, heart: Heart, patience: int) -> None:
        self._heart = heart
        self.patience = patience
        self.seen = 0
        """Count at the last check."""
        self.silent_turns = 0
        """Number of checks since the count last changed."""

    def silent(self) -> bool:
        """Check the heartbeat; return whether it has been missing for more than `patience` checks."""
        count = self._heart.count
        if count == self.seen and count:
            self.silent_turns += 1
        else:
            self.seen, self.silent_turns = count, 0
        return self.silent_turns > self.patience

    @property
    def has_beat(self) -> bool:
        """Whether the last check found a beat."""
        return self.seen > 0 and self.silent_turns == 0


READY, ON_DISK = "R", "D"
"""Thread states of proc(5): running or runnable, and uninterruptible sleep."""
_STATE, _UTIME, _STIME = 0, 11, 12
"""Fields of /proc/PID/stat, counted after the name in parentheses, which may contain spaces and parentheses."""
_TICK: Final = 1.0 / os.sysconf("SC_CLK_TCK")


class Effort(NamedTuple):
    """State of a thread in the kernel."""

    state: str
    """State letter of proc(5)."""
    used: float
    """Processor time since the thread began [s]."""

    @property
    def kept_waiting(self) -> bool:
        """Whether the thread is running or is ready to run but waits for a processor or a disk."""
        return self.state in (READY, ON_DISK)


def effort(pid: int) -> Effort | None:
    """Return the kernel's state of a process's main thread; None if there is none."""
    try:
        stat_line = Path(f"/proc/{pid}/task/{pid}/stat").read_bytes()
    except OSError:  # it has just ended, or there is no such file system
        return None
    fields = stat_line[stat_line.rindex(b")") + 1 :].split()
    return Effort(fields[_STATE].decode(), (int(fields[_UTIME]) + int(fields[_STIME])) * _TICK)


class HangWatch:
    """Detector of a hung process, by its heartbeat and its processor time.

    Parameters
    ----------
    heart
        Heartbeat of the process.
    patience
        Longest silence [s].
    turn
        Interval between two checks [s].
    effort
        Function that returns the kernel's state of a process, by process id.

    """

    def __init__(
        self, heart: Heart, patience: float, turn: float, effort: Callable[[int], Effort | None] = effort
    ) -> None:
        self._heart = heart
        self._patience = patience
        self._turn = turn
        self._effort = effort
        self._seen = 0
        self._silent_s = 0.0
        self._used: float | None = None

    def hangs(self, pid: int) -> bool:
        """Check the process; return whether it has been silent for longer than the allowed time."""
        count = self._heart.count
        if count != self._seen or not count:
            self._seen, self._silent_s, self._used = count, 0.0, None
            return False
        now = self._effort(pid)
        if now is None or not now.kept_waiting:
            self._silent_s += self._turn
        elif self._used is not None:
            self._silent_s += now.used - self._used
        self._used = now.used if now is not None else None
        return self._silent_s > self._patience + self._turn / 2.0
