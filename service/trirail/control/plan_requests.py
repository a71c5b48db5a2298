"""Asks the planner for motions, one goal at a time, and takes its answers where they fit the motion under way.

The planner thinks beside the loop: its answer may come late, twice, for a motion that is not under way any more, or
never. Nothing that stops the robot waits for it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from trirail_drivers.interface import Triple

from trirail.config import Config, corrected_geometry
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.backlash_reserve import planned_limits
from trirail.motion.feasibility import Checker
from trirail.motion.limits import Bounds
from trirail.motion.motion_planner import revision
from trirail.motion.packing import pack_run, unpack_law, unpack_path, unpack_run
from trirail.motion.paths import Path, constant
from trirail.motion.rate_change import RateChange
from trirail.motion.runs import STILL, MotionState, Run, nominal, rest
from trirail.motion.schedule import Schedule
from trirail.motion.time_scaling import TimeScaling
from trirail.wire.goals import Goal
from trirail.wire.plan_packets import Extended, NotPlanned, PlanAnswer, Planned, PlanRequest

LEADS = (0.003, 0.012, 0.048)
"""How long before it is to begin a motion from motion is asked for, each time that it has to be asked for anew [s]."""
LEAST_LEAD = 2
"""And in cycles: an answer comes in the next one at the earliest."""
PATIENCE = 8.0
"""How long a goal waits for the planner, as for the goals before it; one that has died is told at once [s]."""
BUSY = 0.5
"""A planner that has said nothing for so long is told to be busy [s]."""
SLACK = 2
"""A motion that came too late is asked for so many times as far ahead as the answer took."""
ROUND = 12
"""Cycles that a change of rate has for itself before a goal is planned all the same."""
ROUNDING = (1e-9, 1e-7, 1e-5)
"""By so much may a motion begin beside the one commanded, in position, velocity and acceleration [m, rad, …]."""


class PlannerPort(Protocol):
    """Where the planner can be asked."""

    def request_plan(self, request: PlanRequest) -> None:
        """Send a request; never waits. What the planner answers is given to the control in a later cycle."""


class AcceptedPlan(NamedTuple):
    """A goal is the robot's now."""

    duration: float
    """Expected time from now to the end of its path [s]; infinite while the override is zero."""
    slowed: float
    stops_first: bool
    queued: bool
    """Whether it begins when the one before it is reached."""
    bound: str | None = None
    """The limit before which a jog comes to rest, or beyond which a track's target is."""
    lag: float | None = None
    """Of a track: trirail.wire.messages.GoalReply."""


class PlanRequests:
    """Decides how the schedule of motions goes on: its rate by itself, goals by what the planner answers."""

    def __init__(self, config: Config, port: PlannerPort, schedule: Schedule) -> None:
        self.override = 1.0
        """The rate at which motions are to run."""
        robot, self._period = corrected_geometry(config), config.period
        limits = planned_limits(config.limits, config.correction.backlash)
        checker = Checker(robot, limits, Bounds(limits, self._period, labels=robot.labels), self._period)
        self._scaling = TimeScaling(robot, checker, self._period)
        self._legs = robot.packed()
        self._revision = revision(config)
        self._port = port
        self._schedule = schedule
        self._leads = [max(LEAST_LEAD, math.ceil(lead / self._period)) for lead in LEADS]
        self._goal: Goal | None = None
        self._blend: float | None = None
        self._number = 0
        self._asked: PlanRequest | None = None
        self._answer: PlanAnswer | None = None
        self._lost: str | None = None
        self._times = 0
        self._took = 0
        """Cycles from the last question to its answer."""
        self._since: int | None = None
        self._change: RateChange | None = None
        self._greatest_rate = math.inf
        """Of the goal under way."""

    @property
    def busy(self) -> bool:
        """Whether a goal is being planned."""
        return self._goal is not None

    @property
    def due(self) -> float:
        """In how many cycles there is something to think about, if nothing is heard: 0 for now."""
        if self._goal is None:
            return math.inf if self._change is None else 0
        asked, answer, now = self._asked, self._answer, self._schedule.cycle
        if self._change is not None or self._lost is not None or asked is None:
            return 0
        if isinstance(answer, Planned) and answer.first is not None:
            return answer.first - now
        if answer is not None or asked.version != self._schedule.version:
            return 0
        return max(0, math.floor(BUSY / self._period) - round(self.silence / self._period))

    @property
    def silence(self) -> float:
        """How long the planner has been asked for a goal, and has said nothing [s]."""
        return (self._schedule.cycle - self._since) * self._period if self._since is not None else 0.0

    @property
    def how_busy(self) -> str:
        """That the planner is busy, for people; empty while it is not."""
        silence = self.silence
        return f"the planner is busy, it has said nothing for {silence:.1f} s" if silence > BUSY else ""

    def warm_up(self) -> None:
        """Take a motion and stop it, on a schedule that nobody runs: what runs for the first time is slow."""
        nowhere = Schedule(rest(STILL), self._period)
        path = Path(np.array([0.0, 1.0]), np.zeros((1, 3, 6)))
        nowhere.replace_runs(deque([unpack_run(self._legs, pack_run(Run(self._legs, path, constant(1.0), 1.0)))]))
        RateChange(self._scaling, nowhere, 0.0, self._period).step()

    def plan(self, goal: Goal, blend: float | None = None) -> None:
        """Have a goal planned: to preempt the motion under way, or to follow it from within `blend` [m] of its end."""
        self._goal, self._blend, self._times, self._since = goal, blend, 0, None
        self._asked = self._answer = self._lost = None

    def give_up(self) -> None:
        """Have the goal planned no longer: what is answered is left aside."""
        self._goal = self._asked = self._answer = self._lost = self._since = None

    def run_at(self, rate: float) -> None:
        """Let the goal's motion run at another rate, as soon as the sliders allow."""
        self._change = RateChange(self._scaling, self._schedule, min(rate, self._greatest_rate), self._period)

    def leave_rate(self) -> None:
        """The motion has ended: leave its rate alone."""
        self._change = None

    def hear(self, answer: PlanAnswer) -> None:
        """Take what the planner has said in this cycle; all but the first answer to what was last asked is left."""
        asked = self._asked
        if asked is not None and (answer.number, answer.version) == (asked.number, asked.version) and not self._answer:
            self._answer, self._since = answer, None
            self._took = self._schedule.cycle - asked.cycle

    def lose(self, reason: str) -> None:
        """The planner will not answer what it was asked: a goal that waits for that is refused."""
        if self._since is not None:
            self._lost = reason

    def think(self) -> AcceptedPlan | None:
        """Take one look at a change of rate, then ask for the goal or take its motion; return how a goal is reached.

        A change of rate goes first; where the sliders do not allow it yet, a goal does not wait for it: it is planned
        from the motion as it is. While that is asked for only what makes the robot slower changes its motion. Raises
        RefusedError where the goal cannot be reached.
        """
        self._change_rate()
        if self._goal is None:
            return None
        if self.silence > PATIENCE:
            raise RefusedError(RefusalCode.EXPIRED, f"{self.how_busy}: send the goal again when the machine has time")
        if self._lost is not None:
            raise RefusedError(RefusalCode.PLANNER_LOST, f"{self._lost}: send the goal again")
        if self._asked is not None and self._asked.version != self._schedule.version:
            self._asked = None  # it was asked from a motion that has become another one
        if self._asked is None:
            if self._change is None or self._change.made or self._change.tried >= ROUND:
                self._request_plan(self._goal)
            return None
        return self._apply(self._answer) if self._answer is not None else None

    # ------------------------------------------------------------------ inside

    def _change_rate(self) -> None:
        change = self._change
        if change is not None and (self._asked is None or change.lowers) and change.step():
            self._change = None

    def _request_plan(self, goal: Goal) -> None:
        """Ask for the goal's motion from the one under way; RefusedError when that has been asked too often."""
        if self._times == len(self._leads):
            text = f"its motion came too late {self._times} times, or the motion under way changed: send the goal again"
            raise RefusedError(RefusalCode.NO_PLAN, text)
        schedule, (pose, velocity, acceleration) = self._schedule, self._schedule.commanded
        self._number += 1
        self._answer = None
        self._asked = PlanRequest(
            self._number,
            schedule.version,
            self._revision,
            schedule.cycle,
            self._lead(goal),
            min(self.override, goal.greatest_rate),
            (_triple(pose), _triple(velocity), _triple(acceleration)),
            tuple(map(pack_run, schedule.runs)),
            goal,
            None if schedule.ended else self._blend,
        )
        self._times += 1
        self._since = self._since if self._since is not None else schedule.cycle
        self._port.request_plan(self._asked)

    def _lead(self, goal: Goal) -> int:
        """Return in how many cycles a motion is to begin: of a goal that is renewed often, as the last one came."""
        lead = self._leads[self._times]
        if self._times:
            return max(lead, SLACK * self._took)
        return max(lead, self._took + 1) if goal.frequent else lead

    def _apply(self, answer: PlanAnswer) -> AcceptedPlan | None:
        """Carry out what the planner has decided, once its time has come; ask anew where it does not fit any more."""
        if isinstance(answer, NotPlanned):
            raise answer.error()
        try:
            taken = self._extend(answer) if isinstance(answer, Extended) else self._preempt(answer)
        except ValueError as error:
            raise RefusedError(RefusalCode.PLANNER_LOST, f"the planner's answer is no motion: {error}") from error
        if taken is not None:
            self.give_up()
        return taken

    def _preempt(self, planned: Planned) -> AcceptedPlan | None:
        schedule = self._schedule
        if planned.first is not None and schedule.cycle < planned.first:
            return None  # it waits for its time
        run = unpack_run(self._legs, planned.run)
        runs = deque([run])
        if planned.stops_first and schedule.runs:
            runs.appendleft(self._stopping(schedule.runs[0], planned))
        if planned.first not in (None, schedule.cycle) or not self._continues(runs):
            self._asked = None
            return None
        schedule.replace_runs(runs)
        self._change, self._greatest_rate = None, self._goal.greatest_rate if self._goal else math.inf
        if run.target != min(self.override, self._greatest_rate):
            self.run_at(self.override)
        return AcceptedPlan(
            planned.duration if planned.duration is not None else math.inf,
            planned.slowed,
            planned.stops_first,
            queued=False,
            bound=planned.bound,
            lag=planned.lag,
        )

    def _stopping(self, under_way: Run, planned: Planned) -> Run:
        """Return the motion under way as it stops, with no goal on its way."""
        run = under_way.copy()
        run.seams.clear()
        if planned.stop is not None:
            run.change_law(unpack_law(planned.stop), 0.0)
        return run

    def _continues(self, runs: Iterable[Run]) -> bool:
        """Whether runs begin with the motion that is commanded now, each of them where the one before it stands.

        From rest a trajectory may begin with an acceleration: that is a jerk, which the planner has looked at.
        """
        state = self._schedule.commanded
        for run in runs:
            begins = run.state(0.0, state.pose)
            if state.at_rest:
                state = state._replace(acceleration=begins.acceleration)
            if not _same(begins, state):
                return False
            state = rest(run.state(run.ends - run.time, state.pose).pose)
        return True

    def _extend(self, extended: Extended) -> AcceptedPlan | None:
        schedule = self._schedule
        path = unpack_path(extended.path, 3)
        run = schedule.runs[-1] if schedule.runs else None
        if run is None or run.at.s >= extended.s or not _same(nominal(run.path, extended.s), nominal(path, 0.0)):
            self._asked = None
            return None
        schedule.append(extended.s, path)
        duration = schedule.remaining if run.target else math.inf
        return AcceptedPlan(duration, extended.slowed, stops_first=False, queued=True)


def _same(one: MotionState, other: MotionState) -> bool:
    """Whether two states of motion are one but for rounding; what is not a number is not."""
    return all(
        abs(a - b) <= allowed
        for allowed, here, there in zip(ROUNDING, one, other, strict=True)
        for a, b in zip(here, there, strict=True)
    )


def _triple(values: Sequence[float]) -> Triple:
    x, y, z = values
    return (x, y, z)
