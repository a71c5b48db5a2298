"""Heartbeats between the service's processes, and urgent requests: counters in shared memory; and detection of hangs.

A beat and a check cost 0.1 µs, and nothing can wait: no packet queues behind another one, and a process that is frozen
fills no buffer. A process beats in the thread that does its work, so that a hung one does not.

A process that hangs is distinguished from one that a busy machine keeps waiting: killing that one would help nobody.
Silence is the time in which a process could have given a sign of life: the processor time of its main thread, and the
turns in which it wanted none, as when it is stopped or waits in vain. While it waits for a processor or for a disk,
nothing counts.
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
"""Processes that beat; simulated drives do so on their bus, to the loop."""
HASTE = len(PROCESSES)
"""Index of the counter of urgent requests."""
BEAT_EVERY = 0.05
"""Longest interval between two beats of a process, also while it waits for work [s]."""


class Heartbeats:
    """Shared counters; 0 before the first beat of a process and after its last, when none may be expected."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        """Memory file, inherited by the processes that beat and check."""
        self._close: Callable[[], object] | None = None
        self._counts = memoryview(mmap.mmap(descriptor, mmap.PAGESIZE)).cast("Q")

    @property
    def counts(self) -> memoryview[int]:
        """All counters, in the order of PROCESSES."""
        return self._counts

    @classmethod
    def create(cls) -> Heartbeats:
        """Return counters without a beat. The descriptor is closed with them."""
        descriptor = os.memfd_create("trirail-heartbeats")
        os.ftruncate(descriptor, mmap.PAGESIZE)
        created = cls(descriptor)
        created._close = weakref.finalize(created, os.close, descriptor)
        return created

    def close(self) -> None:
        """Close the descriptor of counters that were created here; the counters themselves stay."""
        if self._close is not None:
            self._close()

    def of(self, process: str) -> Heart:
        """Return the counter of one of PROCESSES."""
        return Heart(self._counts, PROCESSES.index(process))

    @contextmanager
    def hurrying(self) -> Iterator[None]:
        """Have the loop handle packets sent meanwhile in the cycle of their arrival: a stop must not wait for the next.

        It counts before and after: whenever the loop checks, it finds a count that it has not seen, or the packet.
        """
        self._counts[HASTE] += 1
        yield
        self._counts[HASTE] += 1


class Heart:
    """The counter of one process."""

    def __init__(self, counts: memoryview[int], place: int) -> None:
        self._counts = counts
        self._place = place

    def beat(self) -> None:
        """Give a sign of life."""
        self._counts[self._place] += 1

    def rest(self) -> None:
        """Report that no beat is expected until the next one."""
        self._counts[self._place] = 0

    @property
    def count(self) -> int:
        """Number of beats; 0 while none is expected."""
        return self._counts[self._place]


class Haste:
    """The loop's check for urgent requests."""

    def __init__(self, heartbeats: Heartbeats) -> None:
        self._counts = heartbeats.counts
        self.seen = 0
        """Count at the last check."""

    def hurried(self) -> bool:
        """Return whether there has been an urgent request since the last call."""
        before, self.seen = self.seen, self._counts[HASTE]
        return self.seen != before


class Watch:
    """Watch on the heart of another process, checked once in each turn of the one that watches.

    Silence is counted in these turns and not by the clock: while the whole machine is stopped, nobody is silent.
    """

    def __init__(self, heart: Heart, patience: int) -> None:
        self._heart = heart
        self.patience = patience
        self.seen = 0
        """Count at the last check."""
        self.turns = 0
        """Turns for which that has stayed the same."""

    def silent(self) -> bool:
        """Check, in every turn; return whether there has been no beat for more turns than `patience`."""
        count = self._heart.count
        if count == self.seen and count:
            self.turns += 1
        else:
            self.seen, self.turns = count, 0
        return self.turns > self.patience

    @property
    def heard(self) -> bool:
        """Whether the last check found a beat."""
        return self.seen > 0 and self.turns == 0


READY, ON_DISK = "R", "D"
"""States of proc(5): running or runnable, and waiting for a disk, where no signal reaches it."""
_STATE, _UTIME, _STIME = 0, 11, 12
"""Fields of /proc/PID/stat behind the name, which is in parentheses and may hold some."""
_TICK: Final = 1.0 / os.sysconf("SC_CLK_TCK")


class Effort(NamedTuple):
    """State of a thread in the kernel."""

    state: str
    """Letter of proc(5)."""
    used: float
    """Processor time since it began [s]."""

    @property
    def kept_waiting(self) -> bool:
        """Whether it runs, or would if the machine had a processor or a disk for it."""
        return self.state in (READY, ON_DISK)


def effort(pid: int) -> Effort | None:
    """Return the kernel's state of a process's main thread; None if there is none."""
    try:
        said = Path(f"/proc/{pid}/task/{pid}/stat").read_bytes()
    except OSError:  # it has just ended, or there is no such file system
        return None
    fields = said[said.rindex(b")") + 1 :].split()
    return Effort(fields[_STATE].decode(), (int(fields[_UTIME]) + int(fields[_STIME])) * _TICK)


class HangWatch:
    """Watch on the heart of another process, checked once in each of the watcher's turns."""

    def __init__(
        self, heart: Heart, patience: float, turn: float, effort: Callable[[int], Effort | None] = effort
    ) -> None:
        self._heart = heart
        self._patience = patience
        self._turn = turn
        self._effort = effort
        self._seen = 0
        self._could = 0.0
        self._used: float | None = None

    def hangs(self, pid: int) -> bool:
        """Check, in every turn; return whether it could have given a sign of life for longer than the patience [s]."""
        count = self._heart.count
        if count != self._seen or not count:
            self._seen, self._could, self._used = count, 0.0, None
            return False
        now = self._effort(pid)
        if now is None or not now.kept_waiting:
            self._could += self._turn
        elif self._used is not None:
            self._could += now.used - self._used
        self._used = now.used if now is not None else None
        return self._could > self._patience + self._turn / 2.0
