"""Fixed-rate ticks on absolute deadlines of the monotonic clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

from trirail.processes.waiting import Doors


class Tick(NamedTuple):
    """One tick, as it came."""

    deadline_ns: int
    """When it was due."""
    lateness_ns: int
    """How much later it came."""
    missed: int
    """Ticks skipped since the one before."""


class Overruns:
    """Ticks that were missed, of which so many are `allowed` in a row."""

    def __init__(self, allowed: int) -> None:
        self.allowed = allowed
        self.all = 0
        """Since the start."""
        self.in_a_row = 0
        """Before the newest tick and, where ticks were missed before that as well, before those."""

    def too_many(self, missed: int) -> int:
        """Count those that were missed before a tick; return how many that are in a row, if more than are allowed."""
        self.all += missed
        in_a_row = self.in_a_row + missed if missed else 0
        self.in_a_row = in_a_row if in_a_row <= self.allowed else 0
        return in_a_row if in_a_row > self.allowed else 0


def sleep_until(deadline_ns: int) -> None:
    """Sleep to an absolute time of the monotonic clock."""
    remaining = deadline_ns - time.monotonic_ns()
    if remaining > 0:
        time.sleep(remaining * 1e-9)  # CPython sleeps to an absolute deadline: clock_nanosleep, TIMER_ABSTIME


class Ticker:
    """Ticks every `period_ns`; a tick that is missed is skipped and counted, never caught up in a burst."""

    def __init__(
        self,
        period_ns: int,
        now: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[int], None] = sleep_until,
    ) -> None:
        self._period_ns = period_ns
        self._now = now
        self._sleep = sleep
        self.deadline_ns = now()
        """When the newest tick was due."""

    def come(self) -> int:
        """Sleep to the next deadline by a clock that is not the machine's, and return the time by it [ns].

        By the machine's -1, at once: who asks can wait for that one by himself.
        """
        if self._now is time.monotonic_ns:
            return -1
        self._sleep_on()
        return self._now()

    def listen(self, doors: Doors) -> bool:
        """Wait for the next deadline or, with time left before it, for somebody at a door; whether somebody is."""
        if self._now is time.monotonic_ns:
            return doors.wait(self.deadline_ns + self._period_ns)
        self._sleep_on()
        return doors.called()

    def wait(self) -> Tick:
        """Sleep until the next deadline that is not over yet by a whole period."""
        self._sleep_on()
        self.deadline_ns += self._period_ns
        return self.tick()

    def _sleep_on(self) -> None:
        """Sleep to the next deadline, if it is not over."""
        if self._now() < self.deadline_ns + self._period_ns:
            self._sleep(self.deadline_ns + self._period_ns)

    def tick(self) -> Tick:
        """Return the tick whose deadline has come; somebody else has waited for it."""
        lateness_ns = self._now() - self.deadline_ns
        missed = max(0, lateness_ns // self._period_ns)
        self.deadline_ns += missed * self._period_ns
        return Tick(self.deadline_ns, lateness_ns - missed * self._period_ns, missed)
