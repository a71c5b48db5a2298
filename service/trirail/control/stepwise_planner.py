"""Thinks while the robot moves: plans goals and changes of rate in steps, at most one a cycle."""

from __future__ import annotations

import math
from typing import NamedTuple

from trirail.errors import RefusedError
from trirail.motion.goals import Extension, Goals, PlannedMotion
from trirail.motion.runs import Run
from trirail.motion.schedule import Schedule
from trirail.motion.steps import Steps
from trirail.motion.time_scaling import SHARES
from trirail.wire.messages import Goal, PoseGoal

MOST_STEPS = 500
"""A goal that is not planned within so many steps is refused: about twenty are needed, and twice that in a crowd."""
ROUND = len(SHARES)
"""Steps that a change of rate has for itself before a goal is planned all the same: one try of every share."""


class AcceptedPlan(NamedTuple):
    """A goal is the robot's now."""

    duration: float
    """Expected time from now to arrival [s]; infinite while the override is zero."""
    slowed: float
    stops_first: bool
    queued: bool
    """Whether it begins when the one before it is reached."""
    bound: str | None = None
    """The limit before which a jog comes to rest."""


class StepwisePlanner:
    """Decides how the schedule of motions goes on."""

    def __init__(self, goals: Goals, schedule: Schedule, period: float) -> None:
        self.override = 1.0
        """The rate at which motions are to run."""
        self._goals = goals
        self._schedule = schedule
        self._period = period
        self._goal: Goal | None = None
        self._blend: float | None = None
        self._steps: Steps[PlannedMotion] | Steps[tuple[Run, Extension]] | None = None
        self._spent = 0
        self._change: Steps[None] | None = None
        self._tried = 0

    @property
    def busy(self) -> bool:
        """Whether a goal is being planned."""
        return self._goal is not None

    def plan(self, goal: Goal, blend: float | None = None) -> None:
        """Begin to plan a goal: to preempt the motion under way, or to follow it from within `blend` [m] of its end."""
        self._goal, self._blend, self._steps, self._spent = goal, blend, None, 0

    def give_up(self) -> None:
        """Plan the goal no longer."""
        self._goal = self._steps = None
        self._tried = 0

    def run_at(self, rate: float) -> None:
        """Let the goal's motion run at another rate, as soon as the sliders allow."""
        self._change, self._tried = self._run_at(rate), 0
        self._steps = None  # what was planned from the old motion is out of date

    def stop_thinking(self) -> None:
        """The motion has ended: leave its rate alone."""
        self._change = None

    def think(self) -> AcceptedPlan | None:
        """Take one step; return how a goal is reached once that is decided. Raises RefusedError if it cannot be.

        A change of rate goes first; where the sliders do not allow it yet, a goal does not wait for it: it is planned
        from the motion as it is, and the change is tried again afterwards.
        """
        if self._change is not None and self._steps is None and (self._goal is None or self._tried < ROUND):
            self._tried += 1
            if _ended(self._change):
                self._change = None
            return None
        if self._goal is None or self._schedule.turning:  # what is yet to begin cannot be planned from
            return None
        self._spent += 1
        if self._spent > MOST_STEPS:
            self.give_up()
            raise RefusedError("no_plan", f"no motion to it was found in {MOST_STEPS} steps: send the goal again")
        try:
            if self._steps is None:
                self._steps = self._begin(self._goal)
            next(self._steps)
        except StopIteration as decided:
            return self._take(decided.value)
        except Exception:
            self.give_up()
            raise
        return None

    def _begin(self, goal: Goal) -> Steps[PlannedMotion] | Steps[tuple[Run, Extension]]:
        if self._blend is not None and isinstance(goal, PoseGoal) and self._schedule.runs:
            return self._append(goal, self._blend)
        return self._goals.plan(goal, self._schedule, self.override)

    def _append(self, goal: PoseGoal, blend: float) -> Steps[tuple[Run, Extension]]:
        run = self._schedule.runs[-1]
        return run, (yield from self._goals.append(goal, run, blend))

    def _take(self, decided: PlannedMotion | tuple[Run, Extension]) -> AcceptedPlan | None:
        """Carry out what has been decided."""
        schedule = self._schedule
        self._steps, self._tried = None, 0
        if isinstance(decided, PlannedMotion):
            self._goal = self._change = None
            waiting = max(0, decided.turn - schedule.cycle) * self._period if decided.turn is not None else 0.0
            schedule.take(decided.runs, decided.turn)
            if decided.runs[-1].target != self.override:
                self._change = self._run_at(self.override)
            duration = waiting + decided.duration
            return AcceptedPlan(duration, decided.slowed, decided.stops_first, queued=False, bound=decided.bound)
        run, extension = decided
        if not schedule.runs or schedule.runs[-1] is not run or run.at.s >= extension.s:
            return None  # the motion that it was to follow has ended: plan it anew
        self._goal = None
        run.append(extension.s, extension.path)
        duration = schedule.remaining if run.target else math.inf
        return AcceptedPlan(duration, extension.slowed, stops_first=False, queued=True)

    def _run_at(self, rate: float) -> Steps[None]:
        """Change the rate of the goal's motion; where that follows a stop on the old path, the stop stays as it is."""
        schedule = self._schedule
        while schedule.turning:
            yield
        if not schedule.runs:
            return
        run = schedule.runs[-1]
        if len(schedule.runs) == 1:
            yield from self._goals.time_scaling.change(run, rate, schedule.commanded.pose)
        else:
            start = run.state(0.0, schedule.commanded.pose).pose
            begun = yield from self._goals.time_scaling.begin(run.path, rate, start)
            run.change_law(begun.law, begun.target)


def _ended(steps: Steps[None]) -> bool:
    try:
        next(steps)
    except StopIteration:
        return True
    return False
