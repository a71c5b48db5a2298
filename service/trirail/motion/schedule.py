"""What the platform is to do: the motion under way, what comes after it, and the state commanded now."""

from __future__ import annotations

from collections import deque

import numpy as np

from trirail.motion.paths import Path
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
        self.version = 0
        """Of the motion under way: another one as soon as it is not to go on as it would have gone on by itself."""
        self._period = period

    @property
    def commanded(self) -> MotionState:
        """The motion commanded now."""
        return MotionState(*self.motion[0].tolist())

    @commanded.setter
    def commanded(self, motion: MotionState) -> None:
        self.motion[0] = motion

    @property
    def last(self) -> Run | None:
        """The run at whose end the robot stands, as far as is decided."""
        return self.runs[-1] if self.runs else None

    @property
    def remaining(self) -> float:
        """Time until it stands [s]."""
        return sum(run.ends - run.time for run in self.runs)

    @property
    def ended(self) -> bool:
        """Whether the end of the last path has been reached: nothing can follow it on the way."""
        return len(self.runs) == 1 and self.runs[0].arrived

    @property
    def progress(self) -> tuple[float, float]:
        """Share of the time of the goal under way that is over, and what remains of it [s]."""
        if not self.runs:
            return 0.0, 0.0
        *stops, run = self.runs
        return run.progress, run.remaining + sum(stop.ends - stop.time for stop in stops)

    def replace_runs(self, runs: deque[Run]) -> None:
        """Go on with other runs; they begin with the motion that is commanded now."""
        self.runs = runs
        self.version += 1

    def append(self, s: float, path: Path) -> None:
        """Go on from a time along the last path by another one: Run.append."""
        self.runs[-1].append(s, path)
        self.version += 1

    def drop(self, number: int) -> None:
        """Leave out the goals behind a seam of the last path: Run.drop."""
        self.runs[-1].drop(number)
        self.version += 1

    def change_law(self, run: Run, law: Path, target: float) -> None:
        """Let the time along a run's path go on by another law: Run.change_law."""
        run.change_law(law, target)
        self.version += 1

    def stop_on_path(self) -> None:
        """Let what was to follow the motion under way go, and the goals on its way: it leads to none of them."""
        while len(self.runs) > 1:
            self.runs.pop()
        for run in self.runs:
            run.seams.clear()
        self.version += 1

    def advance(self) -> int:
        """Move the commanded state on by one period; return how many goals have ended where the next one begins."""
        run = self.begin_cycle()
        if run is None:
            return 0
        self.commanded = run.state(0.0, self.commanded.pose)
        return self.end_cycle(run)

    def begin_cycle(self) -> Run | None:
        """Go on to the next cycle; return the run under way in it, whose time is one period on."""
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
        other.cycle = self.cycle
        for _ in range(cycles):
            other.advance()
        return other
