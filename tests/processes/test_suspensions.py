"""Suspensions of the computer, as its two clocks tell of them."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.processes import clock
from trirail.processes.clock import MIN_SUSPENSION_S, Suspensions

durations = st.floats(0.2, 0.9) | st.floats(0.2, 1e5)
steps = st.lists(st.tuples(st.sampled_from(("run", "sleep", "preempted", "look", "pop")), durations))


class Clocks:
    """The two clocks of a computer that has been up for a while, and was suspended before."""

    def __init__(self, patches: pytest.MonkeyPatch) -> None:
        self.monotonic, self.asleep = 1000.0, 50.0
        self.between = 0.0
        """Time that passes after the first clock has been read."""
        patches.setattr(time, "clock_gettime", self._boottime)
        patches.setattr(time, "monotonic", lambda: self.monotonic)

    def _boottime(self, which: int) -> float:
        assert which == time.CLOCK_BOOTTIME
        now = self.monotonic + self.asleep
        self.monotonic, self.between = self.monotonic + self.between, 0.0
        return now


@given(steps)
def test_what_was_slept_is_told_once_however_often_one_looks(steps: list[tuple[str, float]]) -> None:
    with pytest.MonkeyPatch.context() as patches:
        clocks = Clocks(patches)
        suspensions, slept = Suspensions(clock.asleep_s), 0.0
        for step, seconds in steps:
            match step:
                case "run":
                    clocks.monotonic += seconds
                case "sleep":
                    clocks.asleep += seconds
                    slept += seconds
                case "preempted":
                    clocks.between = seconds
                    assert suspensions.occurred() in (False, slept > 0.0)
                case "look":
                    assert suspensions.occurred() == (slept > 0.0)
                case "pop":
                    assert suspensions.pop_duration() == pytest.approx(slept, abs=1e-6)
                    slept = 0.0


@given(st.floats(0.0, 0.99 * MIN_SUSPENSION_S))
def test_a_difference_of_readings_is_no_suspension(seconds: float) -> None:
    with pytest.MonkeyPatch.context() as patches:
        clocks = Clocks(patches)
        suspensions = Suspensions(clock.asleep_s)
        clocks.asleep += seconds
        assert not suspensions.occurred()
        assert suspensions.pop_duration() == 0.0
