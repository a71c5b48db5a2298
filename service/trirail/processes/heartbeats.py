"""Heartbeats between the service's processes, and haste: counters in memory that they share.

To beat and to look cost 0.1 µs, and nothing can wait: no packet stands in a queue behind another one, and a process
that is frozen fills no buffer. A process beats in the thread that does its work, so that a hung one does not.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager

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
