"""Planner that plans a motion to a goal of any kind, starting from the motion under way."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from msgspec import structs

from trirail.config import Limits
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.geometry import Geometry
from trirail.motion import kinds
from trirail.motion.feasibility import Checker
from trirail.motion.goal_motion import GoalMotion, PoseSource
from trirail.motion.limits import Bounds
from trirail.motion.path_planner import TOO_FAST_IN_MOTION, PathPlanner, Plan
from trirail.motion.paths import BISECTIONS, Path, constant_law
from trirail.motion.runs import MotionState, Run, nominal_motion, rest, stretched
from trirail.motion.schedule import Schedule
from trirail.motion.time_scaling import TimeScaling
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.goal_kind import import_all
from trirail.wire.goals import Goal
from trirail.wire.messages import GoalReply

MIN_REPLAN_RATE = 0.05
"""Lowest rate at which a new goal is planned from motion. Below it, the goal is planned from a standstill."""
STOP_SHARES = tuple(0.5**k for k in range(5))
"""Shares of the quickest stop that are tried if the robot must stop before it moves to a goal."""
SLOWDOWN_STEP = 1.3
"""Factor by which a path is slowed if the override makes it too fast."""
MAX_SLOWDOWNS = 12
"""Greatest number of such slowdowns; 1.3 to the power of 12 is a factor of 23."""

import_all(kinds)
MOTIONS: dict[type[Goal], type[GoalMotion[Any]]] = {made.kind: made for made in GoalMotion.__subclasses__()}
"""Class that plans each kind of goal."""


def resolve_goal(goal: Goal, frames: NamedFrames, source: PoseSource) -> Goal:
    """Return the goal in the base frame, as the planner requires it. Raises RefusedError for an unknown name."""
    return MOTIONS[type(goal)].resolve(goal, frames, source)


class PlannedMotion(NamedTuple):
    """Motion that has been planned to a goal."""

    run: Run
    reply: GoalReply
    """Reply to the sender of the goal, without the goal's id."""
    bound: str | None
    """Limit before which a jog brakes, or which the target of a track exceeds."""
    stop: Path | None = None
    """Law that stops the current motion first; None if its present law already leads to a standstill."""
    first: int | None = None
    """Cycle of the schedule in which the motion begins. None if the robot is at rest, so it may begin in any cycle."""

    @property
    def duration(self) -> float:
        """Time from the start of the motion to the arrival [s]; infinite if it never arrives."""
        return math.inf if self.reply.duration is None else self.reply.duration


class Extension(NamedTuple):
    """Path planned for a goal that follows the goals before it."""

    s: float
    """Time along the path of the earlier goals at which this path begins [s]."""
    path: Path
    reply: GoalReply
    """Reply to the sender of the goal, without the goal's id and the duration."""

    @classmethod
    def from_plan(cls, s: float, plan: Plan) -> Extension:
        """Return a plan as an extension that begins at a time along the earlier path [s]."""
        return cls(s, plan.path, structs.replace(plan.reply, queued=True))


class GoalPlanner:
    """Planner of the goals of one robot. It calls `beat` for each path that it samples."""

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
        """Return the motion to a goal, starting from the commanded state.

        If the robot moves, the new motion begins `lead` cycles later. If the motion does not fit as requested, the
        planner compares a motion at a lower speed with one after a stop on the old path, and returns the one that
        arrives sooner.

        Parameters
        ----------
        goal : Goal
            Goal that has been resolved.
        schedule : Schedule
            Schedule with the motion under way.
        rate : float
            Rate at which time runs along the new path.
        lead : int
            Number of cycles until the new motion may begin.

        Raises
        ------
        RefusedError
            No motion leads to the goal.
        """
        self._motions[type(goal)].check(goal)
        moves = bool(schedule.runs) and not (schedule.commanded.at_rest and schedule.runs[0].at_rest)
        later = schedule.ahead(lead) if moves else schedule
        first = later.cycle if moves else None
        sooner: PlannedMotion | None = None
        try:
            sooner = self._plan_from_motion(goal, later, rate)
        except RefusedError as error:
            if later.commanded.at_rest or error.code is RefusalCode.WRONG_START:
                raise
        if sooner is not None and (later.commanded.at_rest or sooner.reply.slowed <= 1.0):
            return sooner._replace(first=first)
        try:
            stopping = self._plan_after_stop(goal, later, rate)
        except RefusedError:
            if sooner is None:
                raise
            stopping = None
        best = min((motion for motion in (sooner, stopping) if motion), key=lambda motion: motion.duration)
        return best._replace(first=first)

    def append(self, goal: Goal, run: Run, blend: float, lead: int) -> Extension:
        """Return the path of a goal that follows a run. It begins within `blend` [m] of the end of the run's path.

        The path begins in motion if the limits allow it, and otherwise at rest at the end. Raises RefusedError.
        """
        self._motions[type(goal)].check(goal)
        at, end = self._blend_start(run, blend, lead), run.path.duration
        if at < end:
            try:
                plan = self._plan(goal, nominal_motion(run.path, at), 1.0, 0.0)
                if self._fits(run, at, plan.path):
                    return Extension.from_plan(at, plan)
            except RefusedError:
                pass
        plan = self._plan(goal, rest(nominal_motion(run.path, end).pose), 1.0, 0.0)
        for _ in range(MAX_SLOWDOWNS):
            if self._fits(run, end, plan.path):
                return Extension.from_plan(end, plan)
            # An override runs the path faster than it was planned.
            slower = structs.replace(plan.reply, slowed=SLOWDOWN_STEP * plan.reply.slowed)
            plan = Plan(stretched(plan.path, SLOWDOWN_STEP), slower)
        raise RefusedError(
            RefusalCode.NO_PLAN,
            "the goal cannot follow the current motion at this override: lower the override, then send the goal again",
        )

    def _plan_from_motion(self, goal: Goal, schedule: Schedule, rate: float) -> PlannedMotion:
        """Plan from the commanded state, without a stop."""
        start, begins = schedule.commanded, schedule.cycle * self._period
        if start.at_rest:
            plan = self._plan(goal, start, rate, begins)
            run = self.time_scaling.start_run(plan.path, rate, start.pose)
            return PlannedMotion(run, plan.reply.with_duration(run.end_time if rate else math.inf), plan.bound)
        if schedule.runs[0].law_state.rate < MIN_REPLAN_RATE:
            raise TOO_FAST_IN_MOTION
        for now in (
            schedule.runs[0].law_state.rate,
            1.0,
        ):  # the new path may not allow an override that the old path allowed
            # Time along the new path runs at the rate of the old path, so the motion is slower in the path's own time.
            velocity = [value / now for value in start.velocity]
            acceleration = [value / now**2 for value in start.acceleration]
            plan = self._plan(goal, MotionState(start.pose, velocity, acceleration), now, begins)
            run = self.time_scaling.start_run(plan.path, now, start.pose)
            if run.target >= now:
                final = self.time_scaling.possible_rate(plan.path, rate, start.pose)
                duration = plan.path.duration / final if final else math.inf
                return PlannedMotion(run, plan.reply.with_duration(duration), plan.bound)
        raise TOO_FAST_IN_MOTION

    def _plan_after_stop(self, goal: Goal, schedule: Schedule, rate: float) -> PlannedMotion:
        """Plan from the pose at which the current motion can stop."""
        stop, law = schedule.runs[0].copy(), None
        if stop.target != 0.0:
            law = self.time_scaling.stop(stop, schedule.commanded.pose, STOP_SHARES)
            if law is not None:  # without a law, it runs to the end of its path
                stop.change_law(law, 0.0)
        left = stop.end_time - stop.time
        end = stop.state(left, schedule.commanded.pose).pose
        plan = self._plan(goal, rest(end), rate, schedule.cycle * self._period + left)
        run = self.time_scaling.start_run(plan.path, rate, end)
        duration = left + run.end_time if rate else math.inf
        reply = structs.replace(plan.reply.with_duration(duration), stops_first=True)
        return PlannedMotion(run, reply, plan.bound, stop=law)

    def _plan(self, goal: Goal, start: MotionState, rate: float, begins: float) -> Plan:
        """Return a path to the goal, planned by GoalMotion.plan."""
        return self._motions[type(goal)].plan(goal, start, rate, begins)

    def _blend_start(self, run: Run, blend: float, lead: int) -> float:
        """Return the time along a path [s], at least `lead` cycles ahead, that is within `blend` [m] of its end."""
        end = run.path.duration
        target = nominal_motion(run.path, end).pose
        # Stay strictly ahead even at override 0, because the override may rise at any time.
        soonest = run.law_state.s + lead * self._period * max(run.law_state.rate, run.target, 1.0)
        low, high = max(soonest, run.seams[-1].s if run.seams else 0.0), end
        if low >= end or self._planner.distance(nominal_motion(run.path, low).pose, target) <= blend:
            return min(low, end)
        for _ in range(BISECTIONS // 2):
            middle = (low + high) / 2.0
            if self._planner.distance(nominal_motion(run.path, middle).pose, target) > blend:
                low = middle
            else:
                high = middle
        return high

    def _fits(self, run: Run, s: float, path: Path) -> bool:
        """Return whether a path that is appended to a run stays within the limits under the run's law."""
        longer = run.copy()
        longer.append(s, path)
        law, first = longer.law, longer.arrival_at(s)
        last = longer.arrival_at(longer.path.duration)
        if not math.isfinite(last):  # it stops before that; later it runs at most at full speed, or is sampled again
            law, first, last = constant_law(1.0), s, longer.path.duration
        return self._checker.sample(longer.path, law, first, last, nominal_motion(run.path, s).pose).within_limits
