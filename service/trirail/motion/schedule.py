"""Schedule of the platform: the current motion, the motions that follow, and the commanded state."""

from __future__ import annotations

from collections import deque

import numpy as np

from trirail.motion.marks import GoalMarks
from trirail.motion.paths import Path
from trirail.motion.runs import MotionState, OwnBounds, Run, rest


class Schedule:
    """Sequence of runs, and the commanded state of the platform.

    In each cycle, the owner calls `advance`. If the owner computes the commanded state itself, it calls `begin_cycle`
    before and `end_cycle` after the computation instead.
    """

    def __init__(self, commanded: MotionState, period: float) -> None:
        self.motion = np.zeros((2, 3, 3))
        """Commanded motion now and in the previous cycle (2, 3, 3); rows are pose, velocity, acceleration."""
        self.commanded = commanded
        self.runs: deque[Run] = deque()
        """Current motion, followed by the motions that begin when it ends."""
        self.cycle = 0
        self.version = 0
        """Version number of the runs, which every change of the planned motion increases."""
        self._period = period

    @property
    def commanded(self) -> MotionState:
        """Commanded state of the platform's centre."""
        return MotionState(*self.motion[0].tolist())

    @commanded.setter
    def commanded(self, motion: MotionState) -> None:
        self.motion[0] = motion

    @property
    def last(self) -> Run | None:
        """Last run; None if there is no run. The robot is at rest at the end of the last run."""
        return self.runs[-1] if self.runs else None

    @property
    def remaining(self) -> float:
        """Time until the robot is at rest [s]."""
        return sum(run.end_time - run.time for run in self.runs)

    @property
    def ended(self) -> bool:
        """Whether the end of the last path has been reached. A following goal then begins at rest."""
        return len(self.runs) == 1 and self.runs[0].arrived

    @property
    def progress(self) -> tuple[float, float]:
        """Completed fraction of the current goal, 0 to 1, and the remaining time [s]."""
        if not self.runs:
            return 0.0, 0.0
        run, after_stop = self.runs[0], self.after_stop
        if after_stop is None:
            return run.progress, run.remaining
        progress, remaining = after_stop
        return progress, run.end_time - run.time + remaining

    @property
    def after_stop(self) -> tuple[float, float] | None:
        """Completed fraction of the current goal, and duration of all runs after the first [s]; None if there are none.

        The goal belongs to the last run. The runs before it only stop the previous motion.
        """
        if len(self.runs) < 2:
            return None
        _, *stops, run = self.runs
        return run.progress, run.remaining + sum(stop.end_time - stop.time for stop in stops)

    @property
    def has_not_begun(self) -> bool:
        """Whether the only motion stands at its start, because its rate is 0."""
        if len(self.runs) != 1 or self.runs[0].target != 0.0:
            return False
        at = self.runs[0].law_state
        return at.s == at.rate == at.change == 0.0

    def replace_runs(self, runs: deque[Run]) -> None:
        """Replace all runs. The first new run must begin in the commanded state; without runs, the platform rests."""
        self.runs = runs
        if not runs:  # the last setpoint of a path may have the velocity and the acceleration of its end
            self.commanded = rest(self.commanded.pose)
        self.version += 1

    def append(self, s: float, path: Path, marks: GoalMarks | None = None, own: OwnBounds | None = None) -> None:
        """Extend the last run by the path of another goal; see Run.append."""
        self.runs[-1].append(s, path, marks, own)
        self.version += 1

    def drop(self, number: int) -> None:
        """Remove the goals after a seam of the last run; see Run.drop."""
        self.runs[-1].drop(number)
        self.version += 1

    def change_law(self, run: Run, law: Path, target: float) -> None:
        """Continue a run under another law; see Run.change_law."""
        run.change_law(law, target)
        self.version += 1

    def stop_on_path(self) -> None:
        """Remove all motions after the current motion, and all following goals on the current path."""
        while len(self.runs) > 1:
            self.runs.pop()
        for run in self.runs:
            run.withdraw_following()
        self.version += 1

    def advance(self) -> int:
        """Advance the commanded state by one period. Return the number of seams that were passed."""
        run = self.begin_cycle()
        if run is None:
            return 0
        self.commanded = run.state(0.0, self.commanded.pose)
        return self.end_cycle(run)

    def begin_cycle(self) -> Run | None:
        """Begin the next cycle. Advance the current run by one period and return it; None if there is no run."""
        self.cycle += 1
        if not self.runs:
            return None
        run = self.runs[0]
        run.time += self._period
        return run

    def end_cycle(self, run: Run) -> int:
        """Remove the goals and runs that ended in this cycle. Return the number of seams that were passed."""
        passed = run.pass_seams()
        if run.at_rest and len(self.runs) > 1:
            self.runs.popleft()
        return passed

    def ahead(self, cycles: int) -> Schedule:
        """Return a copy of the schedule that is advanced by a number of cycles."""
        other = Schedule(self.commanded, self._period)
        other.runs = deque(run.copy() for run in self.runs)
        other.cycle = self.cycle
        for _ in range(cycles):
            other.advance()
        return other
