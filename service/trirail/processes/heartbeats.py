"""Heartbeats between the service's processes, and haste: counters in memory that they share; and who hangs.

To beat and to look cost 0.1 µs, and nothing can wait: no packet stands in a queue behind another one, and a process
that is frozen fills no buffer. A process beats in the thread that does its work, so that a hung one does not.

A process that hangs is told from one that a busy machine keeps waiting: killing that one would help nobody. Without a
sign of life counts the time in which a process could have given one: what its main thread has used of a processor, and
the turns in which it wanted none, as when it is stopped or waits for what does not come. While it waits for a processor
or for a disk, nothing counts.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

PROCESSES = ("loop", "gateway", "planner", "recorder")
"""Those that beat; simulated drives do so on their bus, to the loop."""
HASTE = len(PROCESSES)
"""Where behind theirs the count of hastes stands."""
BEAT_EVERY = 0.05
"""How often a process beats at least, while it waits for work as well [s]."""


class Heartbeats:
    """The counters; 0 before the first beat of a process and after its last, when nobody may expect one."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        """To be inherited by the processes that beat and look."""
        self._counts = memoryview(mmap.mmap(descriptor, mmap.PAGESIZE)).cast("Q")

    @property
    def counts(self) -> memoryview[int]:
        """All counters, in the order of PROCESSES."""
        return self._counts

    @classmethod
    def create(cls) -> Heartbeats:
        """Return counters of which nobody has beaten yet."""
        descriptor = os.memfd_create("trirail-heartbeats")
        os.ftruncate(descriptor, mmap.PAGESIZE)
        return cls(descriptor)

    def of(self, process: str) -> Heart:
        """Return the counter of one of PROCESSES."""
        return Heart(self._counts, PROCESSES.index(process))

    @contextmanager
    def hurrying(self) -> Iterator[None]:
        """Have the loop take what is sent meanwhile in the cycle in which it comes: a stop must not wait for the next.

        It counts before and after: whenever the loop looks, it finds a haste that it has not seen, or the packet.
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
        """Say that no beat is to be expected until the next one."""
        self._counts[self._place] = 0

    @property
    def count(self) -> int:
        """How often it has beaten; 0 while no beat is to be expected."""
        return self._counts[self._place]


class Haste:
    """The loop's look at whether somebody hurries."""

    def __init__(self, heartbeats: Heartbeats) -> None:
        self._counts = heartbeats.counts
        self.seen = 0
        """The count when it was last looked at."""

    def hurried(self) -> bool:
        """Whether somebody has, since this was last asked."""
        before, self.seen = self.seen, self._counts[HASTE]
        return self.seen != before


class Watch:
    """Looks at the heart of another process, once in each turn of the one that watches.

    Silence is counted in these turns and not by the clock: while the whole machine stands still, nobody is silent.
    """

    def __init__(self, heart: Heart, patience: int) -> None:
        self._heart = heart
        self.patience = patience
        self.seen = 0
        """Its count when it was last looked at."""
        self.turns = 0
        """Turns for which that has stayed the same."""

    def silent(self) -> bool:
        """Look, in every turn; whether there has been no beat for more turns than there is patience."""
        count = self._heart.count
        if count == self.seen and count:
            self.turns += 1
        else:
            self.seen, self.turns = count, 0
        return self.turns > self.patience

    @property
    def heard(self) -> bool:
        """Whether the last look found a beat."""
        return self.seen > 0 and self.turns == 0


READY, ON_DISK = "R", "D"
"""States of proc(5): it runs or would, and it waits for a disk, where no signal reaches it."""
_STATE, _UTIME, _STIME = 0, 11, 12
"""Fields of /proc/PID/stat behind the name, which stands in parentheses and may hold some."""
_TICK: Final = 1.0 / os.sysconf("SC_CLK_TCK")


class Effort(NamedTuple):
    """What the kernel says of a thread."""

    state: str
    """A letter of proc(5)."""
    used: float
    """Processor time since it began [s]."""

    @property
    def kept_waiting(self) -> bool:
        """Whether it would go on if the machine had a processor or a disk for it; or it runs."""
        return self.state in (READY, ON_DISK)


def effort(pid: int) -> Effort | None:
    """Return what the kernel says of a process's main thread; None where it says nothing."""
    try:
        said = Path(f"/proc/{pid}/task/{pid}/stat").read_bytes()
    except OSError:  # it has just ended, or there is no such file system
        return None
    fields = said[said.rindex(b")") + 1 :].split()
    return Effort(fields[_STATE].decode(), (int(fields[_UTIME]) + int(fields[_STIME])) * _TICK)


class HangWatch:
    """Looks at the heart of another process, once in each turn of who watches."""

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
        """Look, in every turn; whether it could have given a sign of life for longer than there is patience [s]."""
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
