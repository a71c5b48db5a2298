"""Ticks on a fake clock: absolute deadlines, missed ticks skipped and counted."""

from __future__ import annotations

import time

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from trirail.processes.clock import Ticker, busy_wait, sleep_until

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


@given(early=st.integers(-3 * PERIOD, 3 * PERIOD))
def test_a_tick_that_is_not_due_yet_is_waited_for(early: int) -> None:
    clock = Clock()
    ticker = Ticker(PERIOD, clock.now, clock.sleep)
    ticker.deadline_ns = clock.time + early
    tick = ticker.tick()
    assert clock.time == max(clock.time, tick.deadline_ns)
    assert tick.missed * PERIOD + tick.lateness_ns == max(0, -early)


@given(busy=st.sampled_from([0, 20_000, 50_000, 100_000]), ahead=st.integers(-1_000_000, 1_000_000))
def test_nobody_who_waits_wakes_up_early(busy: int, ahead: int) -> None:
    deadline = time.monotonic_ns() + ahead
    sleep_until(deadline, busy)
    assert time.monotonic_ns() >= deadline
    deadline += abs(ahead) // 4
    assert busy_wait(deadline, np.zeros(2, np.int64)) >= deadline
    assert time.monotonic_ns() >= deadline


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
