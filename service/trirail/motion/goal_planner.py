"""From a goal of any kind to the motion that leads there from the present one."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from trirail.config import Limits
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.geometry import Geometry
from trirail.motion import kinds
from trirail.motion.feasibility import Checker
from trirail.motion.goal_motion import GoalMotion, Place
from trirail.motion.limits import Bounds
from trirail.motion.path_planner import TOO_FAST_IN_MOTION, PathPlanner, Plan
from trirail.motion.paths import HALVINGS, Path, constant
from trirail.motion.runs import MotionState, Run, nominal, rest, stretched
from trirail.motion.schedule import Schedule
from trirail.motion.time_scaling import TimeScaling
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.goal_kind import import_all
from trirail.wire.goals import Goal

SLOWEST = 0.05
"""Where the time along a path runs slower than this, a new goal is planned from a standstill."""
STOPS = tuple(0.5**k for k in range(5))
"""Shares of the quickest stop that are tried when a goal needs one first."""
SLOWER = 1.3
"""How much slower a path is made that an override makes too fast."""
SLOWED = 12
"""How often: 1.3 to the power of 12 is 23 times."""

import_all(kinds)
MOTIONS: dict[type[Goal], type[GoalMotion[Any]]] = {made.kind: made for made in GoalMotion.__subclasses__()}
"""How goals are planned, by kind."""


def meant(goal: Goal, frames: NamedFrames, place: Place) -> Goal:
    """Return the goal that the planner is to be asked for. Raises RefusedError for a name that there is not."""
    return MOTIONS[type(goal)].meant(goal, frames, place)


class PlannedMotion(NamedTuple):
    """How a goal is to be reached."""

    run: Run
    duration: float
    """From when it begins to arrival [s]."""
    slowed: float = 1.0
    """How many times slower than was asked for, for the limits' sake."""
    stops_first: bool = False
    """Whether the robot stops on its old path before."""
    stop: Path | None = None
    """The law of that stop; None where the law that the motion under way has is the one to stand by."""
    first: int | None = None
    """In which cycle of the schedule it begins; None where the robot stands, and it may begin at any time."""
    bound: str | None = None
    """The limit before which a jog comes to rest, or beyond which a track's target is."""
    lag: float | None = None
    """How far a point of the platform is at most from where a track's target has it, when it begins [m]."""


class Extension(NamedTuple):
    """How a goal is to be reached when the ones before it are."""

    s: float
    """From which time along their path [s]."""
    path: Path
    slowed: float


class GoalPlanner:
    """Plans the goals of one robot."""

    def __init__(
        self, geometry: Geometry, limits: Limits, period: float, beat: Callable[[], None] = lambda: None
    ) -> None:
        bounds = Bounds(limits, period, labels=geometry.labels)
        checker = Checker(geometry, limits, bounds, period, beat)
        self._checker = checker
        self._period = period
        self._planner = PathPlanner(geometry, limits.platform, limits.slider, bounds, checker, period)
        self._motions = {kind: made(self._planner) for kind, made in MOTIONS.items()}
        self.time_scaling = TimeScaling(geometry, checker, period)

    def plan(self, goal: Goal, schedule: Schedule, rate: float, lead: int) -> PlannedMotion:
        """Return the motion to a goal, its time to run at `rate`, from the commanded state of the motion under way.

        Where the robot moves, it begins so many cycles later: as asked for, or with a lower speed or after a stop on
        the old path, whichever arrives sooner. Raises RefusedError.
        """
        self._motions[type(goal)].check(goal)
        moves = bool(schedule.runs) and not (schedule.commanded.at_rest and schedule.runs[0].stands)
        later = schedule.ahead(lead) if moves else schedule
        first = later.cycle if moves else None
        sooner: PlannedMotion | None = None
        try:
            sooner = self._set_out(goal, later, rate)
        except RefusedError as error:
            if later.commanded.at_rest or error.code is RefusalCode.WRONG_START:
                raise
        if sooner is not None and (later.commanded.at_rest or sooner.slowed <= 1.0):
            return sooner._replace(first=first)
        try:
            stopping = self._stop_first(goal, later, rate)
        except RefusedError:
            if sooner is None:
                raise
            stopping = None
        best = min((motion for motion in (sooner, stopping) if motion), key=lambda motion: motion.duration)
        return best._replace(first=first)

    def append(self, goal: Goal, run: Run, blend: float, lead: int) -> Extension:
        """Return the way to a goal from within `blend` [m] of where a run's path ends.

        It begins in motion where the sliders can do that, else at rest at the end. Raises RefusedError.
        """
        self._motions[type(goal)].check(goal)
        at, end = self._seam(run, blend, lead), run.path.duration
        if at < end:
            try:
                plan = self._plan(goal, nominal(run.path, at), 1.0, 0.0)
                if self._fits(run, at, plan.path):
                    return Extension(at, plan.path, plan.slowed)
            except RefusedError:
                pass
        plan = self._plan(goal, rest(nominal(run.path, end).pose), 1.0, 0.0)
        for _ in range(SLOWED):
            if self._fits(run, end, plan.path):
                return Extension(end, plan.path, plan.slowed)
            # It is faster than at full speed, by an override.
            plan = Plan(stretched(plan.path, SLOWER), SLOWER * plan.slowed)
        raise RefusedError(
            RefusalCode.NO_PLAN, "no motion follows at this override: send the goal again when it is lower"
        )

    def _set_out(self, goal: Goal, schedule: Schedule, rate: float) -> PlannedMotion:
        """Plan from the commanded motion."""
        start, begins = schedule.commanded, schedule.cycle * self._period
        if start.at_rest:
            plan = self._plan(goal, start, rate, begins)
            run = self.time_scaling.begin(plan.path, rate, start.pose)
            return PlannedMotion(run, run.ends if rate else math.inf, plan.slowed, bound=plan.bound, lag=plan.lag)
        if schedule.runs[0].at.rate < SLOWEST:
            raise TOO_FAST_IN_MOTION
        for now in (schedule.runs[0].at.rate, 1.0):  # an override that the old path could take the new one may not
            # The new path's time goes on at the rate of the old one's: in it, the motion is that much slower.
            velocity = [value / now for value in start.velocity]
            acceleration = [value / now**2 for value in start.acceleration]
            plan = self._plan(goal, MotionState(start.pose, velocity, acceleration), now, begins)
            run = self.time_scaling.begin(plan.path, now, start.pose)
            if run.target >= now:
                final = self.time_scaling.possible(plan.path, rate, start.pose)
                duration = plan.path.duration / final if final else math.inf
                return PlannedMotion(run, duration, plan.slowed, bound=plan.bound, lag=plan.lag)
        raise TOO_FAST_IN_MOTION

    def _stop_first(self, goal: Goal, schedule: Schedule, rate: float) -> PlannedMotion:
        """Plan from where the motion under way can be stopped."""
        stop, law = schedule.runs[0].copy(), None
        if stop.target != 0.0:
            law = self.time_scaling.stop(stop, schedule.commanded.pose, STOPS)
            if law is not None:  # else it goes on to the end of its path
                stop.change_law(law, 0.0)
        left = stop.ends - stop.time
        end = stop.state(left, schedule.commanded.pose).pose
        plan = self._plan(goal, rest(end), rate, schedule.cycle * self._period + left)
        run = self.time_scaling.begin(plan.path, rate, end)
        duration = left + run.ends if rate else math.inf
        return PlannedMotion(run, duration, plan.slowed, stops_first=True, stop=law, bound=plan.bound, lag=plan.lag)

    def _plan(self, goal: Goal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan from a state of motion, in which a path begins that is run at a rate, at a time of the loop's [s]."""
        return self._motions[type(goal)].plan(goal, start, rate, begins)

    def _seam(self, run: Run, blend: float, lead: int) -> float:
        """Return the time along a run's path from which on it is within `blend` of its end [s], and not yet passed."""
        end = run.path.duration
        target = nominal(run.path, end).pose
        # Strictly ahead, also where time along the path stands still: at override 0 it may be told to run at any time.
        soonest = run.at.s + lead * self._period * max(run.at.rate, run.target, 1.0)
        low, high = max(soonest, run.seams[-1].s if run.seams else 0.0), end
        if low >= end or self._planner.nearness(nominal(run.path, low).pose, target) <= blend:
            return min(low, end)
        for _ in range(HALVINGS // 2):
            middle = (low + high) / 2.0
            if self._planner.nearness(nominal(run.path, middle).pose, target) > blend:
                low = middle
            else:
                high = middle
        return high

    def _fits(self, run: Run, s: float, path: Path) -> bool:
        """Whether sliders and platform can take a path behind a run's, by the run's law."""
        longer = run.copy()
        longer.append(s, path)
        law, first = longer.law, longer.reaches(s)
        last = longer.reaches(longer.path.duration)
        if not math.isfinite(last):  # it is to stop before: it will go on at full speed at most, or be looked at anew
            law, first, last = constant(1.0), s, longer.path.duration
        return self._checker.sample(longer.path, law, first, last, nominal(run.path, s).pose).within_limits
