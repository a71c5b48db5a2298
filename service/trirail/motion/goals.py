"""From a goal of any kind to the motion that leads there from the present one."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from trirail.config import Limits
from trirail.errors import RefusedError
from trirail.kinematics.geometry import Geometry
from trirail.motion.feasibility import Checker
from trirail.motion.limits import Bounds
from trirail.motion.paths import HALVINGS, Path, constant, value
from trirail.motion.planner import TOO_FAST_IN_MOTION, Kinodynamic, Plan, Planner
from trirail.motion.quintic import Point
from trirail.motion.runs import MotionState, Run, rest, stretched
from trirail.motion.schedule import Schedule
from trirail.motion.steps import Steps, T
from trirail.motion.time_scaling import TimeScaling
from trirail.wire.messages import Goal, PoseGoal, SlidersGoal, TrajectoryGoal, VelocityGoal

SLOWEST = 0.05
"""Where the time along a path runs slower than this, a new goal is planned from a standstill."""
LEAD = 24
"""Cycles from now until a motion begins that takes more than one step to plan; no plan takes more."""
STOPS = tuple(0.5**k for k in range(5))
"""Shares of the quickest stop that are tried when a goal needs one first."""
SLOWER = 1.3
"""How much slower a path is made that an override makes too fast."""
SLOWED = 12
"""How often: 1.3 to the power of 12 is 23 times."""


class PlannedMotion(NamedTuple):
    """How a goal is to be reached."""

    runs: deque[Run]
    turn: int | None
    """From which cycle of the schedule on; None for at once."""
    duration: float
    """From when it begins to arrival [s]."""
    slowed: float = 1.0
    """How many times slower than was asked for, for the limits' sake."""
    stops_first: bool = False
    """Whether the robot stops on its old path before."""
    bound: str | None = None
    """The limit before which a jog comes to rest."""


class Extension(NamedTuple):
    """How a goal is to be reached when the ones before it are."""

    s: float
    """From which time along their path [s]."""
    path: Path
    slowed: float


class Goals:
    """Plans the goals of one robot."""

    def __init__(self, geometry: Geometry, limits: Limits, period: float) -> None:
        bounds = Bounds(limits, period)
        checker = Checker(geometry, limits, bounds, period)
        self._checker = checker
        self._period = period
        self._planner = Planner(geometry, limits.platform, limits.slider, bounds, checker, period)
        self.time_scaling = TimeScaling(geometry, limits.platform, checker, period)

    def plan(self, goal: Goal, schedule: Schedule, rate: float) -> Steps[PlannedMotion]:
        """Return the motion to a goal, its time to run at `rate`, from the commanded state of the motion under way.

        It begins at once where one step is enough to plan it. Else it begins from where the robot will be when it
        is planned: at once with a lower speed, or after a stop on the old path, whichever arrives sooner.
        Raises RefusedError.
        """
        self._check(goal)
        try:
            found = _one_step(self._set_out(goal, schedule, rate))
        except RefusedError as error:
            if schedule.commanded.at_rest or error.code == "wrong_start":
                raise
            found = None
        if found is not None:
            return found
        yield
        still = not schedule.runs
        later = schedule if still else schedule.ahead(LEAD)
        yield
        sooner: PlannedMotion | None = None
        try:
            sooner = yield from self._set_out(goal, later, rate)
        except RefusedError:
            if later.commanded.at_rest:
                raise
        if sooner is not None and later.commanded.at_rest:
            return sooner if still else sooner._replace(turn=later.cycle)
        yield
        try:
            stopping = yield from self._stop_first(goal, later, rate)
        except RefusedError:
            if sooner is None:
                raise
            stopping = None
        best = min((motion for motion in (sooner, stopping) if motion), key=lambda motion: motion.duration)
        return best._replace(turn=later.cycle)

    def append(self, goal: PoseGoal, run: Run, blend: float) -> Steps[Extension]:
        """Return the way to a pose from within `blend` [m] of where a run's path ends.

        It begins in motion where the sliders can do that, else at rest at the end. Raises RefusedError.
        """
        self._check(goal)
        at, end = self._seam(run, blend), run.path.duration
        if at < end:
            try:
                plan = yield from self._to_pose(goal, _state(run.path, at))
                yield
                if self._fits(run, at, plan.path):
                    return Extension(at, plan.path, plan.slowed)
            except RefusedError:
                pass
            yield
        plan = yield from self._to_pose(goal, rest(_state(run.path, end).pose))
        for _ in range(SLOWED):
            if self._fits(run, end, plan.path):
                return Extension(end, plan.path, plan.slowed)
            yield  # it is faster than at full speed, by an override
            plan = Plan(stretched(plan.path, SLOWER), SLOWER * plan.slowed)
        raise RefusedError("no_plan", "no motion follows at this override: send the goal again when it is lower")

    def _check(self, goal: Goal) -> None:
        """Refuse what can be reached from nowhere."""
        if isinstance(goal, PoseGoal):
            self._planner.check_pose((goal.x, goal.y, goal.phi))
            self._limits(goal)
        elif isinstance(goal, SlidersGoal):
            self._planner.check_sliders(goal.position)

    def _set_out(self, goal: Goal, schedule: Schedule, rate: float) -> Steps[PlannedMotion]:
        """Plan from the commanded motion."""
        start = schedule.commanded
        if start.at_rest:
            plan = yield from self._plan(goal, start)
            run = yield from self.time_scaling.begin(plan.path, rate, start.pose)
            return PlannedMotion(deque([run]), None, run.ends if rate else math.inf, plan.slowed, bound=plan.bound)
        if schedule.runs[0].at.rate < SLOWEST:
            raise TOO_FAST_IN_MOTION
        for now in (schedule.runs[0].at.rate, 1.0):  # an override that the old path could take the new one may not
            # The new path's time goes on at the rate of the old one's: in it, the motion is that much slower.
            velocity = [value / now for value in start.velocity]
            acceleration = [value / now**2 for value in start.acceleration]
            plan = yield from self._plan(goal, MotionState(start.pose, velocity, acceleration))
            run = yield from self.time_scaling.begin(plan.path, now, start.pose)
            if run.target >= now:
                final = yield from self.time_scaling.possible(plan.path, 0.0, rate, start.pose)
                duration = plan.path.duration / final if final else math.inf
                return PlannedMotion(deque([run]), None, duration, plan.slowed, bound=plan.bound)
        raise TOO_FAST_IN_MOTION

    def _stop_first(self, goal: Goal, schedule: Schedule, rate: float) -> Steps[PlannedMotion]:
        """Plan from where the motion under way can be stopped."""
        stop = schedule.runs[0].copy()
        stop.seams.clear()
        if stop.target != 0.0:
            yield from self.time_scaling.try_change(stop, 0.0, schedule.commanded.pose, STOPS)
        end = stop.state(stop.ends - stop.time, schedule.commanded.pose).pose
        plan = yield from self._plan(goal, rest(end))
        run = yield from self.time_scaling.begin(plan.path, rate, end)
        duration = stop.ends - stop.time + run.ends if rate else math.inf
        return PlannedMotion(deque([stop, run]), None, duration, plan.slowed, stops_first=True, bound=plan.bound)

    def _plan(self, goal: Goal, start: MotionState) -> Steps[Plan]:
        planner = self._planner
        match goal:
            case PoseGoal():
                return (yield from self._to_pose(goal, start))
            case SlidersGoal():
                return (yield from planner.to_sliders(start, goal.position, goal.speed))
            case VelocityGoal():
                return (yield from planner.jog(start, (goal.x, goal.y, goal.phi), goal.timeout))
            case TrajectoryGoal():
                points = [Point(p.t, (p.x, p.y, p.phi), p.velocity, p.acceleration) for p in goal.points]
                return (yield from planner.follow(start, points, goal.stretch))

    def _to_pose(self, goal: PoseGoal, start: MotionState) -> Steps[Plan]:
        target = goal.x, goal.y, goal.phi
        return (yield from self._planner.to_pose(start, target, goal.speed, self._limits(goal)))

    def _limits(self, goal: PoseGoal) -> Kinodynamic | None:
        own = goal.limits
        return self._planner.lowered(own.velocity, own.acceleration, own.jerk) if own else None

    def _seam(self, run: Run, blend: float) -> float:
        """Return the time along a run's path from which on it is within `blend` of its end [s]."""
        end = run.path.duration
        target = _state(run.path, end).pose
        # Strictly ahead, also where time along the path stands still: at override 0 it may be told to run at any time.
        soonest = run.at.s + LEAD * self._period * max(run.at.rate, run.target, 1.0)
        low, high = max(soonest, run.seams[-1].s if run.seams else 0.0), end
        if low >= end or self._planner.nearness(_state(run.path, low).pose, target) <= blend:
            return min(low, end)
        for _ in range(HALVINGS // 2):
            middle = (low + high) / 2.0
            if self._planner.nearness(_state(run.path, middle).pose, target) > blend:
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
        return self._checker.look(longer.path, law, first, last, _state(run.path, s).pose).within_limits


def _one_step(steps: Steps[T]) -> T | None:
    """Return what has been decided in the first step; None if it takes more."""
    try:
        next(steps)
    except StopIteration as end:
        return end.value  # type: ignore[no-any-return]  # typeshed has it untyped
    return None


def _state(path: Path, s: float) -> MotionState:
    """Return the platform's motion at a time along a path, at full speed."""
    out = np.zeros((3, 3))
    value(path.knots, path.pieces, s, out)
    return MotionState(*out.tolist())
