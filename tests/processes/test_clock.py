"""Ticks on a fake clock: absolute deadlines, missed ticks skipped and counted."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from trirail.processes.clock import Ticker

PERIOD = 1_000_000


class Clock:
    """A clock that oversleeps by what it is told."""

    def __init__(self) -> None:
        self.time = 123
        self.late = 0

    def now(self) -> int:
        return self.time

    def sleep(self, deadline: int) -> None:
        self.time = max(self.time, deadline) + self.late


def test_deadlines_do_not_drift() -> None:
    clock = Clock()
    ticker = Ticker(PERIOD, clock.now, clock.sleep)
    clock.late = 70_000
    ticks = [ticker.wait() for _ in range(1000)]
    assert [tick.deadline_ns for tick in ticks] == [123 + (i + 1) * PERIOD for i in range(1000)]
    assert {tick.lateness_ns for tick in ticks} == {70_000}
    assert not any(tick.missed for tick in ticks)


@given(st.lists(st.integers(0, 20 * PERIOD), min_size=1, max_size=200))
def test_missed_ticks_are_skipped_and_counted(work: list[int]) -> None:
    clock = Clock()
    ticker = Ticker(PERIOD, clock.now, clock.sleep)
    start = clock.time
    for ran, duration in enumerate(work, 1):
        before = clock.time
        tick = ticker.wait()
        clock.time += duration
        assert (tick.deadline_ns - start) % PERIOD == 0
        assert 0 <= tick.lateness_ns < PERIOD
        assert tick.deadline_ns + PERIOD > before  # none that was over already is caught up
        if ran == 1:
            total = 0
        total += 1 + tick.missed
        assert start + total * PERIOD == tick.deadline_ns
