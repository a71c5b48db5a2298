"""Changes of the rate at which time runs along a path, for pause, stop, resume and override.

The loop process computes the change, and takes a limited number of samples per cycle. Braking therefore does not depend
on any other process.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.motion.feasibility import SUBJECTS, SampleResult, parts
from trirail.motion.paths import Path, constant_law
from trirail.motion.runs import Run, arrival_time
from trirail.motion.schedule import Schedule
from trirail.motion.time_scaling import CHANGE_SHARES, Change, TimeScaling, greatest_rate

MIN_SAMPLES_PER_CYCLE = 40
"""Least number of samples in and next to pieces of a path that are taken in one cycle."""
SAMPLES_PER_SECOND = 120_000.0
"""Number of samples in and next to pieces of a path that are taken in one cycle, per second of the cycle's period. A
longer cycle has more time."""
OWN_EXCESSES = (1.0, 3.0, math.inf)
"""Factors by which a change to a lower rate may exceed a goal's own limits, tried in turn. The last one is for a faster
motion that passes into the goal. The robot's limits always apply."""
PROMPTNESS = 3.0
"""Greatest duration of a change to a lower rate within a goal's own limits, in durations of a stop within them."""
MIN_STOP_S = 0.1
"""Duration that such a change may always have [s]."""
MAX_POSTPONEMENTS = 3
"""Greatest number of times that the start of a law is postponed, to leave enough cycles for sampling the whole law."""


class _Part(NamedTuple):
    """Part of a path under a law, between two times of the law [s]."""

    path: Path
    first: float
    until: float
    own: Array | None
    """Limits of the goal to which this part belongs, as in OwnBounds."""


class _Candidate(NamedTuple):
    """Law that has been proposed but not completely sampled."""

    law: Path
    begins: int
    """Cycle of the schedule in which the law begins."""
    ahead: list[_Part]
    """Parts of the law that have not been sampled yet, in reverse order."""


class RateChange:
    """Change of the rate of a schedule's last motion, as early and as quickly as the limits allow.

    The old law remains in use until a new law has been checked completely. While the rate is changing, the search for a
    quicker change continues, because a slower motion leaves a larger part of the limits free. A motion that has not
    begun yet begins at the new rate.

    The goals' own limits also apply, unless the change is a stop. A path that uses them completely leaves nothing for a
    change, so a change to a lower rate may exceed them if it would otherwise take too long; see OWN_EXCESSES.
    """

    def __init__(
        self, scaling: TimeScaling, schedule: Schedule, rate: float, period: float, *, stops: bool = False
    ) -> None:
        self.rate = rate
        self.cycles = 0
        """Number of cycles since the change was requested."""
        self.applied = False
        """Whether the motion has a law that leads to the new rate. Further cycles can only make the change quicker."""
        self._stops = stops
        self._scaling = scaling
        self._schedule = schedule
        self._period = period
        self._tries: Iterator[Change] = iter(())
        self._try: Change | None = None
        """Change that is tried now; None if the next one is due."""
        self._samples = max(MIN_SAMPLES_PER_CYCLE, int(SAMPLES_PER_SECOND * period))
        self._restart()

    @property
    def lowers_rate(self) -> bool:
        """Whether this is a change to a lower rate that has not been applied yet, and must not wait for the planner."""
        runs = self._schedule.runs
        return not self.applied and bool(runs) and self.rate < max(runs[-1].target, runs[-1].law_state.rate)

    def step(self) -> bool:
        """Continue the change, with at most one call of the sampler per cycle. Return True if it is complete."""
        self.cycles += 1
        schedule = self._schedule
        if not schedule.runs:
            return True
        if self._motion_key != (schedule.version, len(schedule.runs)):  # the motion has changed
            self._restart()
        run = schedule.runs[-1]
        if self._unsampled is not None:
            self._search_greatest_rate()
            return False
        if len(schedule.runs) > 1:
            self._change_law(run, constant_law(self._possible))
            return True
        if run.arrived or self._is_over(run):
            return True
        if not self.applied and self._possible == run.target == 0.0:
            self.applied = True
            return False
        self._check_candidate(run)
        return self._is_over(run)

    # ------------------------------------------------------------------ inside

    def _is_over(self, run: Run) -> bool:
        """Return True if the applied law is complete and needs no improvement.

        A change to rate 0 is complete at rest. Any other change is complete when the law has reached its target.
        """
        return self.applied and (run.at_rest if self.rate == 0.0 else run.time >= run.law.knots[-2])

    def _restart(self) -> None:
        """Restart the change from the current state of the motion."""
        schedule = self._schedule
        self._motion_key = schedule.version, len(schedule.runs)
        self._possible = self.rate
        self._begin_search()
        self._excesses = iter((math.inf,) if self._stops else OWN_EXCESSES)
        self._excess = next(self._excesses)
        self._searched = False
        """Whether all changes have been tried with the present excess."""
        self._candidate: _Candidate | None = None
        self._unsampled: list[_Part] | None = None
        self._first_s = 0.0
        if self.rate > 1.0 and schedule.runs:
            run = schedule.runs[-1]
            self._first_s = run.law_state.s if len(schedule.runs) == 1 else 0.0
            self._worst, self._leaves_at = np.zeros((len(SUBJECTS), 3)), math.nan
            self._unsampled = self._parts(run, constant_law(1.0, self._first_s), 1.0, math.inf)[::-1]

    def _search_greatest_rate(self) -> None:
        """Sample one part of the remaining path. After the last part, compute the greatest possible rate."""
        if self._unsampled:
            path, first, until, _ = self._unsampled.pop()
            result = self._scaling.sample(
                path, constant_law(1.0, self._first_s), first, until, self._schedule.commanded.pose
            )
            np.maximum(result.worst, self._worst, out=self._worst)
            if not math.isnan(result.leaves_at):
                self._leaves_at = result.leaves_at
        if not self._unsampled:
            self._possible = greatest_rate(self.rate, SampleResult(self._worst, False, self._leaves_at))
            self._unsampled = None

    def _check_candidate(self, run: Run) -> None:
        """Sample one part of the proposed law. In the cycle in which the law begins, apply it if all parts fit."""
        cycle = self._schedule.cycle
        if self._candidate is not None and self._candidate.begins < cycle:  # too late: the sampling took too long
            self._candidate = None
        if self._candidate is None:
            self._candidate = self._propose(run)
        candidate = self._candidate
        if candidate is None:
            self._try = None
            return
        if candidate.ahead:
            path, first, until, own = candidate.ahead.pop()
            pose = self._schedule.commanded.pose
            allowed = own * self._excess if own is not None else None
            result = self._scaling.sample(path, candidate.law, first, until, pose, allowed)
            if not result.within_limits:
                self._candidate = self._try = None
                return
        if not candidate.ahead and candidate.begins == cycle:
            self._change_law(run, candidate.law)

    def _parts(self, run: Run, law: Path, rate: float, last: float) -> list[_Part]:
        """Return the parts of a law until the time `last` [s], on the path and on the paths that it may become.

        If a following goal is dropped, the run continues under the same law on the path before this goal.
        """
        begins, own = 0.0, run.own.limits
        whole: list[_Part] = []
        shorter: list[_Part] = []
        for seam in run.seams:
            passes = arrival_time(law, rate, seam.s)
            shorter.append(_Part(seam.before, passes, last, own))
            if seam.own.limits is not own:
                whole.append(_Part(run.path, begins, min(passes, last), own))
                begins, own = passes, seam.own.limits
        whole.append(_Part(run.path, begins, last, own))
        sampled: list[_Part] = []
        for path, first, end, limits in whole + shorter:
            until = min(arrival_time(law, rate, path.duration), end)
            if first <= until:
                sampled += [_Part(path, *each, limits) for each in parts(path, law, first, until, self._samples)]
        return sampled

    def _begin_search(self) -> None:
        """Try the quickest change next."""
        self._tries, self._try = iter(()), None

    def _next_try(self, run: Run) -> Change:
        """Return the change to try next. After the last, begin again with the quickest."""
        change = next(self._tries, None)
        if change is None:
            if self._searched and self.lowers_rate:
                self._excess = next(self._excesses, math.inf)
            if self.applied:
                pose = self._schedule.commanded.pose
                self._tries = self._scaling.tries(run, self._possible, pose, CHANGE_SHARES)
            else:
                self._tries = self._scaling.first_tries(self._possible)
            self._searched, change = True, next(self._tries)
        return change

    def _is_prompt(self, law: Path) -> bool:
        """Return whether a change to a lower rate takes at most PROMPTNESS times as long as a stop within own limits.

        The stop is one from the present velocity, within the acceleration and jerk of the current goal.
        """
        own = self._schedule.runs[-1].own.limits
        if own is None or not self.lowers_rate or self._excess == math.inf:
            return True
        _, acceleration, jerk = own.T
        stop = np.abs(self._schedule.commanded.velocity) / acceleration
        stop += np.where(np.isfinite(acceleration), acceleration, 0.0) / jerk
        return float(law.knots[-2]) <= PROMPTNESS * float(stop.max()) + MIN_STOP_S

    def _propose(self, run: Run) -> _Candidate | None:
        """Return the law to try next; None if it is not suitable.

        The law begins late enough for all of its parts to be sampled before.
        """
        cycles = 1
        change = self._try = self._try or self._next_try(run)
        pose = self._schedule.commanded.pose
        for _ in range(MAX_POSTPONEMENTS):
            law = self._scaling.law(run, run.time + (cycles - 1) * self._period, self._possible, change, pose)
            if law is None or (self.applied and not self._ends_sooner(run, law, cycles)):
                return None
            if not self._is_prompt(law):
                return None
            ahead = self._parts(run, law, self._possible, float(law.knots[-2]) + self._period)
            if len(ahead) <= cycles:
                return _Candidate(law, self._schedule.cycle + cycles - 1, ahead[::-1])
            cycles = len(ahead)
        return None

    def _ends_sooner(self, run: Run, law: Path, cycles: int) -> bool:
        """Return whether a law completes the change at least one cycle earlier than the present law or the path."""
        present = min(run.end_time, float(run.law.knots[-2])) - run.time
        if (cycles - 1) * self._period + float(law.knots[-2]) <= present - self._period:
            return True
        self._begin_search()  # slower changes would not end earlier either: try the quickest change next
        return False

    def _change_law(self, run: Run, law: Path) -> None:
        self._schedule.change_law(run, law, self._possible)
        self.applied = True
        self._motion_key, self._candidate = (self._schedule.version, len(self._schedule.runs)), None
        self._begin_search()
