"""What the platform is to do: the motion under way, what comes after it, and the state commanded now."""

from __future__ import annotations

from collections import deque

import numpy as np

from trirail.motion.runs import MotionState, Run


class Schedule:
    """Runs, one after the other. Each cycle is `advance`, or `begin_cycle` and `end_cycle` around the motion itself."""

    def __init__(self, commanded: MotionState, period: float) -> None:
        self.motion = np.zeros((2, 3, 3))
        """The motion commanded now, and in the cycle before: rows pose, velocity, acceleration."""
        self.commanded = commanded
        self.runs: deque[Run] = deque()
        """The motion under way, and those to follow at its end."""
        self.cycle = 0
        self._period = period
        self._later: deque[Run] = deque()
        self._turn: int | None = None

    @property
    def commanded(self) -> MotionState:
        """The motion commanded now."""
        return MotionState(*self.motion[0].tolist())

    @commanded.setter
    def commanded(self, motion: MotionState) -> None:
        self.motion[0] = motion

    @property
    def turning(self) -> bool:
        """Whether another motion is soon to take the place of the one under way."""
        return self._turn is not None

    @property
    def last(self) -> Run | None:
        """The run at whose end the robot stands, as far as is decided."""
        runs = self._later or self.runs
        return runs[-1] if runs else None

    @property
    def remaining(self) -> float:
        """Time until it stands [s]."""
        if self._turn is not None:
            waiting = (self._turn - self.cycle) * self._period
            return waiting + sum(run.ends for run in self._later)
        return sum(run.ends - run.time for run in self.runs)

    @property
    def single(self) -> bool:
        """Whether it is one motion to one goal at most: then its run alone tells how far it has come."""
        return len(self.runs) <= 1 and self._turn is None and not (self.runs and self.runs[0].seams)

    @property
    def progress(self) -> tuple[float, float]:
        """Share of the time of the goal under way that is over, and what remains of it [s]."""
        if not self.runs or self.turning:
            return 0.0, self.remaining
        *stops, run = self.runs
        return run.progress, run.remaining + sum(stop.ends - stop.time for stop in stops)

    def take(self, runs: deque[Run], turn: int | None = None) -> None:
        """Go on with other runs, at once or from the cycle `turn` on; they begin with the motion commanded then."""
        if turn is None or turn <= self.cycle or not self.runs:
            self.runs, self._later, self._turn = runs, deque(), None
        else:
            self._later, self._turn = runs, turn
            self.forget()

    def forget(self) -> None:
        """Let the goals on the way go: what is under way leads to none of them."""
        for run in self.runs:
            run.seams.clear()

    def keep(self) -> None:
        """Stay with the motion under way: none is to take its place."""
        self._later, self._turn = deque(), None

    def advance(self) -> int:
        """Move the commanded state on by one period; return how many goals have ended where the next one begins."""
        run = self.begin_cycle()
        if run is None:
            return 0
        self.commanded = run.state(0.0, self.commanded.pose)
        return self.end_cycle(run)

    def begin_cycle(self) -> Run | None:
        """Go on to the next cycle; return the run under way in it, whose time is one period on."""
        if self._turn == self.cycle:
            self.take(self._later)
        self.cycle += 1
        if not self.runs:
            return None
        run = self.runs[0]
        run.time += self._period
        return run

    def end_cycle(self, run: Run) -> int:
        """Let what has ended in this cycle go; return how many goals have where the next one begins."""
        passed = run.pass_seams()
        if run.stands and len(self.runs) > 1:
            self.runs.popleft()
        return passed

    def ahead(self, cycles: int) -> Schedule:
        """Return the schedule as it will be so many cycles later, if nothing happens in between."""
        other = Schedule(self.commanded, self._period)
        other.runs = deque(run.copy() for run in self.runs)
        other._later = deque(run.copy() for run in self._later)
        other.cycle, other._turn = self.cycle, self._turn
        for _ in range(cycles):
            other.advance()
        return other
