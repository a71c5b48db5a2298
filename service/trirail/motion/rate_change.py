"""A change of the rate at which a motion runs: pause, stop, resume, override; a look of bounded length a cycle.

It needs nobody: braking is the loop's own, whatever else is silent.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trirail.motion.feasibility import SUBJECTS, Sampled, parts
from trirail.motion.paths import Path, constant
from trirail.motion.runs import Run, arrival
from trirail.motion.schedule import Schedule
from trirail.motion.time_scaling import SHARES, TimeScaling, greatest

FEWEST_KNOTS = 8
"""Knots of a path that are looked at in one cycle at least."""
KNOTS_A_SECOND = 24_000.0
"""And so many in a cycle of one second: what a cycle has time for grows with its period."""
LATER = 3
"""How often the beginning of a law is put off until it can be looked at before."""


class _Candidate(NamedTuple):
    """A law that may follow, and what is left to be looked at of it."""

    law: Path
    begins: int
    """The cycle of the schedule in which it does."""
    ahead: list[tuple[float, float]]
    """Parts to be looked at, the last one first."""


class RateChange:
    """Lets the last motion of a schedule run at another rate: as soon as the limits allow, as fast as they do.

    Until then the old law goes on. A stop, and a rise, become quicker as they go on: the slower the motion, the more is
    left of the limits. A motion that has not begun yet begins at the new rate.
    """

    def __init__(self, scaling: TimeScaling, schedule: Schedule, rate: float, period: float) -> None:
        self.rate = rate
        self.tried = 0
        """Cycles that it has taken."""
        self.made = False
        """Whether the motion has been told of the rate: what is left is to make the change quicker."""
        self._scaling = scaling
        self._schedule = schedule
        self._period = period
        self._knots = max(FEWEST_KNOTS, int(KNOTS_A_SECOND * period))
        self._begin_anew()

    @property
    def lowers(self) -> bool:
        """Whether the motion is to be slower than it has been told: that waits for nothing."""
        runs = self._schedule.runs
        return not self.made and bool(runs) and self.rate < max(runs[-1].target, runs[-1].at.rate)

    def step(self) -> bool:
        """Take one look at most; whether the change is over."""
        self.tried += 1
        schedule = self._schedule
        if not schedule.runs:
            return True
        if self._seen != (schedule.version, len(schedule.runs)):  # it is not the same motion any more
            self._begin_anew()
        run = schedule.runs[-1]
        if self._unbounded is not None:
            self._look_for_greatest(run)
            return False
        if len(schedule.runs) > 1:
            self._change_law(run, constant(self._possible))
            return True
        if run.arrived or self._is_over(run):
            return True
        if not self.made and self._possible == run.target == 0.0:
            self.made = True
            return False
        self._try(run)
        return self._is_over(run)

    # ------------------------------------------------------------------ inside

    def _is_over(self, run: Run) -> bool:
        """Whether a motion that has been told of the rate has come to it, or is slowing down to another than zero."""
        return self.made and (run.stands if self.rate == 0.0 else run.at.rate >= self._possible)

    def _begin_anew(self) -> None:
        """Begin with the motion as it is now."""
        schedule = self._schedule
        self._seen = schedule.version, len(schedule.runs)
        self._possible = self.rate
        self._share = 0
        self._candidate: _Candidate | None = None
        self._unbounded: list[tuple[float, float]] | None = None
        self._from = 0.0
        if self.rate > 1.0 and schedule.runs:
            run = schedule.runs[-1]
            self._from = run.at.s if len(schedule.runs) == 1 else 0.0
            self._worst, self._leaves_at = np.zeros((len(SUBJECTS), 3)), math.nan
            law = constant(1.0, self._from)
            self._unbounded = parts(run.path, law, 0.0, run.path.duration - self._from, self._knots)[::-1]

    def _look_for_greatest(self, run: Run) -> None:
        """Look at one part of the rest of the path, for the greatest rate at which it can be taken."""
        if self._unbounded:
            first, until = self._unbounded.pop()
            found = self._scaling.sample(
                run.path, constant(1.0, self._from), first, until, self._schedule.commanded.pose
            )
            np.maximum(found.worst, self._worst, out=self._worst)
            if not math.isnan(found.leaves_at):
                self._leaves_at = found.leaves_at
        if not self._unbounded:
            self._possible = greatest(self.rate, Sampled(self._worst, False, self._leaves_at))
            self._unbounded = None

    def _try(self, run: Run) -> None:
        """Look at one part of the law that is tried, and take it once all of it has been found to fit."""
        cycle = self._schedule.cycle
        if self._candidate is not None and self._candidate.begins < cycle:  # it was not looked at in time
            self._candidate = None
        if self._candidate is None:
            self._candidate = self._propose(run)
        candidate = self._candidate
        if candidate is None:
            self._go_on_trying()
            return
        if candidate.ahead:
            first, until = candidate.ahead.pop()
            found = self._scaling.sample(run.path, candidate.law, first, until, self._schedule.commanded.pose)
            if not found.within_limits:
                self._go_on_trying()
                return
        if not candidate.ahead and candidate.begins == cycle:
            self._change_law(run, candidate.law)

    def _go_on_trying(self) -> None:
        self._candidate, self._share = None, (self._share + 1) % len(SHARES)

    def _propose(self, run: Run) -> _Candidate | None:
        """Return the law at the present share, to begin once all of it can have been looked at; None without one."""
        cycles = 1
        for _ in range(LATER):
            at = run.at if cycles == 1 else run.at_time(run.time + (cycles - 1) * self._period)
            law = self._scaling.ramp(at, self._possible, SHARES[self._share])
            if law is None or (self.made and not self._sooner(run, law, cycles)):
                return None
            ahead = parts(run.path, law, 0.0, self._scaling.until(run, law, self._possible), self._knots)
            if len(ahead) <= cycles:
                return _Candidate(law, self._schedule.cycle + cycles - 1, ahead[::-1])
            cycles = len(ahead)
        return None

    def _sooner(self, run: Run, law: Path, cycles: int) -> bool:
        """Whether the run stands sooner by a law than by the one that it has: where that stops, or at its end."""
        ends = run.path.duration
        stands = arrival(law, self._possible, ends) if self._possible else float(law.knots[-2])
        if (cycles - 1) * self._period + stands <= run.ends - run.time - self._period:
            return True
        self._share = -1  # slower changes would be no sooner: begin with the quickest again
        return False

    def _change_law(self, run: Run, law: Path) -> None:
        self._schedule.change_law(run, law, self._possible)
        self.made = True
        seen = self._schedule.version, len(self._schedule.runs)
        self._seen, self._candidate, self._share = seen, None, 0
