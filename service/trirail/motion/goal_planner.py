"""Planner of motions to goals of any kind. The robot may be at rest or in motion."""

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
from trirail.wire.vocabulary import LOWEST_OVERRIDE

MIN_REPLAN_RATE = 0.9e-2 * LOWEST_OVERRIDE
"""Lowest rate of the current motion at which a new goal is planned without a stop, just below the lowest override. At
lower rates, the robot first stops."""
STOP_SHARES = tuple(0.5**k for k in range(5))
"""Fractions of the greatest deceleration that are tried in turn if the robot must stop before it moves to a goal."""
SLOWDOWN_STEP = 1.3
"""Factor by which a path is slowed in each attempt if the override makes the path too fast."""
MAX_SLOWDOWNS = 12
"""Greatest number of slowdowns by SLOWDOWN_STEP. Twelve slowdowns make a path 23 times slower."""

import_all(kinds)
MOTIONS: dict[type[Goal], type[GoalMotion[Any]]] = {made.kind: made for made in GoalMotion.__subclasses__()}
"""Class that plans each kind of goal."""


def resolve_goal(goal: Goal, frames: NamedFrames, source: PoseSource) -> Goal:
    """Return the goal in the form that the planner requires; see GoalMotion.resolve."""
    return MOTIONS[type(goal)].resolve(goal, frames, source)


class PlannedMotion(NamedTuple):
    """Result of planning: a motion to a goal, with information for its execution."""

    run: Run
    reply: GoalReply
    """Reply to the sender of the goal, without the goal's id."""
    bound: str | None
    """Name of the limit before which a jog brakes, or which the target of a track exceeds."""
    stop: Path | None = None
    """Law that stops the current motion first; None if the present law of the current motion need not change."""
    first: int | None = None
    """Cycle of the schedule in which the motion begins; None if the robot is at rest, and any cycle is possible."""

    @property
    def duration(self) -> float:
        """Time from the start of the motion to the arrival [s]; infinite if the motion has no planned end."""
        return math.inf if self.reply.duration is None else self.reply.duration


class Extension(NamedTuple):
    """Path of a queued goal, which extends the path of the goals before it."""

    s: float
    """Time along the path of the earlier goals at which the extension begins [s]."""
    path: Path
    reply: GoalReply
    """Reply to the sender of the goal, without the goal's id and without the duration."""

    @classmethod
    def from_plan(cls, s: float, plan: Plan) -> Extension:
        """Create an extension from a plan. `s` is the time along the earlier path at which the extension begins [s]."""
        return cls(s, plan.path, structs.replace(plan.reply, queued=True))


class GoalPlanner:
    """Planner of motions to the goals of one robot. The function `beat` is called for each sampled path."""

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

        If the robot is moving, the new motion begins `lead` cycles later. If the robot cannot reach the goal at the
        requested speed without a stop, the planner compares two motions: a slower motion without a stop, and a motion
        after a stop on the old path. The planner returns the motion that arrives earlier.

        Parameters
        ----------
        goal : Goal
            Goal that has been resolved.
        schedule : Schedule
            Schedule with the current motion.
        rate : float
            Rate of the time along the new path.
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
        """Return the path of a goal that follows a run.

        If the limits allow it, the path begins in motion, at a distance of `blend` [m] or less from the end of the
        run's path. Otherwise, the path begins at rest at the end of the run's path. Raises RefusedError if no path is
        possible.
        """
        self._motions[type(goal)].check(goal)
        at, end = self._blend_start(run, blend, lead), run.path.duration
        if at < end:
            # With an override above 100 %, a path that is too fast under the law is planned for the rate of the law.
            for rate in dict.fromkeys((1.0, max(1.0, run.law_state.rate, run.target))):
                try:
                    plan = self._plan_at_rate(goal, nominal_motion(run.path, at), rate)
                    if self._fits(run, at, plan.path):
                        return Extension.from_plan(at, plan)
                except RefusedError:
                    pass
        plan = self._plan(goal, rest(nominal_motion(run.path, end).pose), 1.0, 0.0)
        for _ in range(MAX_SLOWDOWNS):
            if self._fits(run, end, plan.path):
                return Extension.from_plan(end, plan)
            # With an override above 100 %, the path runs faster than planned, and must be planned more slowly.
            slower = structs.replace(plan.reply, slowed=SLOWDOWN_STEP * plan.reply.slowed)
            plan = Plan(stretched(plan.path, SLOWDOWN_STEP), slower)
        raise RefusedError(
            RefusalCode.NO_PLAN,
            "the goal cannot follow the current motion at this override: lower the override, then send the goal again",
        )

    def _plan_from_motion(self, goal: Goal, schedule: Schedule, rate: float) -> PlannedMotion:
        """Plan a motion to the goal from the commanded state, without a stop."""
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
        ):  # the old path may allow a higher override than the new path
            if now > goal.greatest_rate:
                continue
            # The new path begins at the rate of the old path. In the time along the path, all velocities are therefore
            # divided by this rate.
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
        """Plan a motion that first stops on the old path, and then begins at rest."""
        stop, law = schedule.runs[0].copy(), None
        if stop.target != 0.0:
            law = self.time_scaling.stop(stop, schedule.commanded.pose, STOP_SHARES)
            if law is not None:  # otherwise, the current motion runs to the end of its path
                stop.change_law(law, 0.0)
        left = stop.end_time - stop.time
        end = stop.state(left, schedule.commanded.pose).pose
        plan = self._plan(goal, rest(end), rate, schedule.cycle * self._period + left)
        run = self.time_scaling.start_run(plan.path, rate, end)
        duration = left + run.end_time if rate else math.inf
        reply = structs.replace(plan.reply.with_duration(duration), stops_first=True)
        return PlannedMotion(run, reply, plan.bound, stop=law)

    def _plan_at_rate(self, goal: Goal, start: MotionState, rate: float) -> Plan:
        """Return a path to the goal that stays within the limits if the time along the path runs at this rate.

        `start` is the state of motion at full speed at the start of the path.
        """
        velocity = [value * rate for value in start.velocity]
        acceleration = [value * rate**2 for value in start.acceleration]
        plan = self._plan(goal, MotionState(start.pose, velocity, acceleration), rate, 0.0)
        if rate == 1.0:
            return plan
        return Plan(stretched(plan.path, rate), structs.replace(plan.reply, slowed=rate * plan.reply.slowed))

    def _plan(self, goal: Goal, start: MotionState, rate: float, begins: float) -> Plan:
        """Return a path to the goal; see GoalMotion.plan."""
        return self._motions[type(goal)].plan(goal, start, rate, begins)

    def _blend_start(self, run: Run, blend: float, lead: int) -> float:
        """Return the time along a run's path at which a following goal may begin [s].

        At this time, the platform is at most `blend` [m] away from the end of the path. The time is at least `lead`
        cycles in the future.
        """
        end = run.path.duration
        if blend == 0.0:
            return end  # a search would end a little earlier, and cut off marks at the end
        target = nominal_motion(run.path, end).pose
        # Assume a rate of at least 1, even at override 0, because the override may rise at any time.
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
        first, last = longer.arrival_at(s), longer.arrival_at(longer.path.duration)
        sampled = [(longer.law, first, min(last, float(longer.law.knots[-2])) if longer.target == 0.0 else last)]
        # If the law stops before the end, check the rest at full speed. A faster law would be sampled again later.
        if not math.isfinite(last):
            sampled.append((constant_law(1.0), s, longer.path.duration))
        pose = nominal_motion(run.path, s).pose
        return all(
            self._checker.sample(longer.path, law, begin, end, pose).within_limits
            for law, begin, end in sampled
            if math.isfinite(begin)
        )
