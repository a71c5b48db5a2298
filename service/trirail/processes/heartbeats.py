"""Heartbeats, urgent requests and the loop's end, as numbers in memory that the processes share; detection of hangs.

Counting a beat and checking a counter each take 0.1 µs and never wait. Unlike packets, counters do not fill a buffer
while a process is frozen. Each process counts its beats in the thread that does its work, so that a hung process stops
beating.

A process can also be silent because the machine is too busy to run it. Killing such a process would only add load. The
measured silence therefore contains only time in which the process could have beaten: the processor time of its main
thread, and the intervals at whose end the thread was stopped or asleep. Time spent waiting for a processor or a disk is
not counted.
"""

from __future__ import annotations

import mmap
import os
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

PROCESSES = ("loop", "gateway", "planner", "recorder")
"""Processes with a heartbeat in shared memory. The simulated drives send heartbeats on their bus instead."""
URGENT_INDEX = len(PROCESSES)
"""Index of the counter of urgent requests."""
END_INDEX = URGENT_INDEX + 1
"""Index of the number of cycles after which the loop has ended normally; 0 if it has not."""
BEAT_EVERY = 0.05
"""Maximum interval between two beats of a process, also while the process is idle [s]."""


class Heartbeats:
    """Counters in shared memory, one per process. A counter is 0 while its process is not expected to beat."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        """Descriptor of the shared memory, which all processes inherit."""
        self._close: Callable[[], object] | None = None
        self._counts = memoryview(mmap.mmap(descriptor, mmap.PAGESIZE)).cast("Q")

    @property
    def counts(self) -> memoryview[int]:
        """All numbers: the processes' counters in the order of PROCESSES, then those at URGENT_INDEX and END_INDEX."""
        return self._counts

    @classmethod
    def create(cls) -> Heartbeats:
        """Create counters that are all 0. Their descriptor is closed when the object is garbage-collected."""
        descriptor = os.memfd_create("trirail-heartbeats")
        os.ftruncate(descriptor, mmap.PAGESIZE)
        created = cls(descriptor)
        created._close = weakref.finalize(created, os.close, descriptor)
        return created

    def close(self) -> None:
        """Close the descriptor if this process has created the counters. The counters can still be used."""
        if self._close is not None:
            self._close()

    def heart(self, process: str) -> Heart:
        """Return the heartbeat counter of a process in PROCESSES."""
        return Heart(self._counts, PROCESSES.index(process))

    def record_end(self, cycle: int) -> None:
        """Record that the loop ends normally after cycle `cycle`. A packet could find no space at a slow peer."""
        self._counts[END_INDEX] = cycle

    def last_cycle(self) -> int | None:
        """Return the last cycle of the loop if the loop has ended normally; otherwise None."""
        return self._counts[END_INDEX] or None

    @contextmanager
    def urgent_section(self) -> Iterator[None]:
        """Mark packets sent within this context as urgent. The loop handles them in the cycle in which they arrive."""
        # Count before and after the packet, so that the loop always finds a new count or the packet itself.
        self._counts[URGENT_INDEX] += 1
        yield
        self._counts[URGENT_INDEX] += 1


class Heart:
    """Heartbeat counter of one process."""

    def __init__(self, counts: memoryview[int], place: int) -> None:
        self._counts = counts
        self._place = place

    def beat(self) -> None:
        """Count a beat.

        The first beat sets the counter to the monotonic time in nanoseconds. A restarted process therefore never
        repeats a count of the process before it, which a watch would mistake for silence.
        """
        self._counts[self._place] = (self._counts[self._place] or time.monotonic_ns()) + 1

    def rest(self) -> None:
        """Reset the counter to 0, so that no heartbeat is expected until the next beat."""
        self._counts[self._place] = 0

    @property
    def count(self) -> int:
        """Count that every beat increases; 0 while the process is not expected to beat."""
        return self._counts[self._place]


class UrgentFlag:
    """Detector with which the loop notices urgent requests."""

    def __init__(self, heartbeats: Heartbeats) -> None:
        self._counts = heartbeats.counts
        self.seen = 0
        """Count of urgent requests at the last check."""

    @property
    def raised(self) -> bool:
        """True if there has been an urgent request since the last call of `was_raised`."""
        return self.seen != self._counts[URGENT_INDEX]

    def was_raised(self) -> bool:
        """Return True if there has been an urgent request since the last call."""
        before, self.seen = self.seen, self._counts[URGENT_INDEX]
        return self.seen != before


class Watch:
    """Time-out on the heartbeat of another process.

    The time-out is measured in checks by the watching process, not in wall-clock time. A stalled machine is therefore
    not mistaken for a frozen process. `patience` is the tolerated number of checks without a new beat.
    """

    def __init__(self, heart: Heart, patience: int) -> None:
        self._heart = heart
        self.patience = patience
        self.seen = 0
        """Count at the last check."""
        self.silent_turns = 0
        """Number of checks since the count last changed."""

    def silent(self) -> bool:
        """Check the heartbeat. Return True if it has been missing for more than `patience` checks."""
        count = self._heart.count
        if count == self.seen and count:
            self.silent_turns += 1
        else:
            self.seen, self.silent_turns = count, 0
        return self.silent_turns > self.patience

    @property
    def has_beat(self) -> bool:
        """True if the last check found a new beat."""
        return self.seen > 0 and self.silent_turns == 0


READY, ON_DISK = "R", "D"
"""Thread states of proc(5): R is running or runnable, D is uninterruptible sleep, usually for a disk."""
_STATE, _UTIME, _STIME = 0, 11, 12
"""Indices of fields of /proc/PID/stat, counted from the first field after the name.

The name is in parentheses, and may itself contain spaces and parentheses.
"""
_TICK: Final = 1.0 / os.sysconf("SC_CLK_TCK")


class Effort(NamedTuple):
    """State of a thread and processor time that it has used, as reported by the kernel."""

    state: str
    """Letter of the state, as in proc(5)."""
    used: float
    """Processor time that the thread has used since its start [s]."""

    @property
    def kept_waiting(self) -> bool:
        """True if the thread is running, is ready to run, or waits for a disk."""
        return self.state in (READY, ON_DISK)


def effort(pid: int) -> Effort | None:
    """Return the state and the processor time of a process's main thread; None if the thread does not exist."""
    try:
        stat_line = Path(f"/proc/{pid}/task/{pid}/stat").read_bytes()
    except OSError:  # the process has just ended, or /proc is not mounted
        return None
    fields = stat_line[stat_line.rindex(b")") + 1 :].split()
    return Effort(fields[_STATE].decode(), (int(fields[_UTIME]) + int(fields[_STIME])) * _TICK)


class HangWatch:
    """Detector of a hung process, based on the process's heartbeat and on its processor time.

    Parameters
    ----------
    heart
        Heartbeat of the process.
    patience
        Tolerated duration of silence [s].
    turn
        Interval between two checks [s].
    effort
        Function that returns the Effort of a process's main thread, given the process id.

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
        """Check the process. Return True if it has been silent for longer than the tolerated time."""
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
