"""Requests to the planner, one goal at a time, and use of its answers where they fit the motion under way.

The planner runs beside the loop: its answer may come late, twice, for a motion that is no longer under way, or never.
Nothing that stops the robot waits for it.
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
from trirail.motion.marks import GoalMarks
from trirail.motion.motion_planner import revision
from trirail.motion.packing import pack_run, unpack_law, unpack_path, unpack_run
from trirail.motion.paths import Path, constant_law
from trirail.motion.rate_change import RateChange
from trirail.motion.runs import ZERO_RATES, MotionState, Run, nominal_motion, rest
from trirail.motion.schedule import Schedule
from trirail.motion.time_scaling import TimeScaling
from trirail.wire.goals import Goal
from trirail.wire.messages import GoalReply
from trirail.wire.plan_packets import Extended, NotPlanned, PlanAnswer, Planned, PlanRequest

LEADS = (0.003, 0.012, 0.048)
"""Lead of the request before the begin of a motion from motion, for the first request and each repetition [s]."""
LEAST_LEAD = 2
"""Least lead in cycles: an answer arrives in the next one at the earliest."""
PATIENCE = 8.0
"""Time that a goal waits for the planner, as for the goals before it [s]; a dead planner is reported immediately."""
BUSY = 0.5
"""Silence after which the planner is reported busy [s]."""
SLACK = 2
"""Lead of the request for a motion that came too late, in multiples of the time that its answer took."""
ROUND = 12
"""Cycles that a change of rate has for itself before a goal is planned regardless."""
ROUNDING = (1e-9, 1e-7, 1e-5)
"""Greatest step from the commanded motion to a new one, in position, velocity and acceleration [m, rad, …]."""


class PlannerPort(Protocol):
    """Port for requests to the planner."""

    def request_plan(self, request: PlanRequest) -> None:
        """Send a request without waiting. The planner's answer reaches the control in a later cycle."""


class AcceptedPlan(NamedTuple):
    """Acceptance of a goal by the robot."""

    reply: GoalReply
    """Reply to its sender, without the goal's id."""
    bound: str | None = None
    """Limit before which a jog brakes, or beyond which a track's target is."""


class PlanRequests:
    """Continuation of the schedule of motions: changes of rate made here, goals by the planner's answers."""

    def __init__(self, config: Config, port: PlannerPort, schedule: Schedule) -> None:
        self.override = 1.0
        """Rate at which motions shall run while the mode is moving."""
        self._running = False
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
        self._goal_id = ""
        self._blend: float | None = None
        self._number = 0
        self._asked: PlanRequest | None = None
        self._answer: PlanAnswer | None = None
        self._lost: str | None = None
        self._times = 0
        self._took = 0
        """Cycles from the last request to its answer."""
        self._since: int | None = None
        self._change: RateChange | None = None
        self._greatest_rate = math.inf
        """Greatest rate of the goal under way."""

    @property
    def busy(self) -> bool:
        """Whether a goal is being planned."""
        return self._goal is not None

    @property
    def requests(self) -> int:
        """Number of requests sent to the planner."""
        return self._number

    @property
    def awaits_answer(self) -> bool:
        """Whether the planner has been asked for a goal and has not answered."""
        return self._goal is not None and self._asked is not None and self._answer is None

    @property
    def due(self) -> float:
        """Number of cycles until `think` is due if nothing is received: 0 for now."""
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
        """Time since the planner was asked for a goal that it has not answered [s]."""
        return (self._schedule.cycle - self._since) * self._period if self._since is not None else 0.0

    @property
    def how_busy(self) -> str:
        """Message that the planner is busy, for people; empty while it is not."""
        silence = self.silence
        return f"the planner is busy, it has said nothing for {silence:.1f} s" if silence > BUSY else ""

    def warm_up(self) -> None:
        """Take a motion and stop it, on a schedule that is never run: the first run of code is slow."""
        nowhere = Schedule(rest(ZERO_RATES), self._period)
        path = Path(np.array([0.0, 1.0]), np.zeros((1, 3, 6)))
        nowhere.replace_runs(deque([unpack_run(self._legs, pack_run(Run(self._legs, path, constant_law(1.0), 1.0)))]))
        RateChange(self._scaling, nowhere, 0.0, self._period).step()

    def plan(self, goal: Goal, blend: float | None = None, name: str = "") -> None:
        """Have a goal planned: to preempt the motion under way, or to follow it from within `blend` [m] of its end.

        `name` is its id.
        """
        self._goal_id = name
        self._goal, self._blend, self._times, self._since = goal, blend, 0, None
        self._asked = self._answer = self._lost = None

    def give_up(self) -> None:
        """Stop planning the goal; ignore later answers."""
        self._goal = self._asked = self._answer = self._lost = self._since = None

    def set_running(self, running: bool) -> None:
        """Run the motion under way at the override, or brake it; only the mode decides which."""
        self._running = running
        self._start_rate_change()

    def update_rate(self) -> None:
        """Apply a new override, or a changed path, to the motion under way; a braking one continues to brake."""
        if self._running:
            self._start_rate_change()

    def discard_rate_change(self) -> None:
        """Stop changing the rate: no motion is under way."""
        self._running, self._change = False, None

    def hear(self, answer: PlanAnswer) -> None:
        """Take the planner's answer of this cycle; ignore all but the first answer to the last request."""
        asked = self._asked
        if asked is not None and (answer.number, answer.version) == (asked.number, asked.version) and not self._answer:
            self._answer, self._since = answer, None
            self._took = self._schedule.cycle - asked.cycle

    def lose(self, reason: str) -> None:
        """Have the waiting goal refused: the planner will not answer its request."""
        if self._since is not None:
            self._lost = reason

    def think(self) -> AcceptedPlan | None:
        """Step a change of rate, then request the goal's motion or take it; return the accepted plan of a goal.

        A change of rate has priority; where the sliders do not allow it yet, a goal does not wait for it, but is
        planned from the present motion. While a request is pending only a lower rate changes the motion. Raises
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
            self._asked = None  # the motion has changed since the request
        if self._asked is None:
            if self._change is None or self._change.applied or self._change.cycles >= ROUND:
                self._request_plan(self._goal)
            return None
        return self._apply(self._answer) if self._answer is not None else None

    # ------------------------------------------------------------------ inside

    @property
    def _rate(self) -> float:
        """Rate that the motion under way shall have."""
        return min(self.override, self._greatest_rate) if self._running else 0.0

    def _start_rate_change(self) -> None:
        """Bring the motion under way to its rate, as soon as the sliders allow."""
        self._change = RateChange(self._scaling, self._schedule, self._rate, self._period)

    def _change_rate(self) -> None:
        change = self._change
        if change is not None and (self._asked is None or change.lowers_rate) and change.step():
            self._change = None

    def _request_plan(self, goal: Goal) -> None:
        """Request the goal's motion from the one under way. Raises RefusedError after too many requests."""
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
        """Return the cycles until a motion shall begin; for a frequently renewed goal, from the last answer's delay."""
        lead = self._leads[self._times]
        if self._times:
            return max(lead, SLACK * self._took)
        return max(lead, self._took + 1) if goal.frequent else lead

    def _apply(self, answer: PlanAnswer) -> AcceptedPlan | None:
        """Apply the planner's answer once it is due; request again where it no longer fits."""
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
        run.marks.append(self._marks(planned.switches))
        runs = deque([run])
        if planned.reply.stops_first and schedule.runs:
            runs.appendleft(self._stopping(schedule.runs[0], planned))
        if planned.first not in (None, schedule.cycle) or not self._continues(runs):
            self._asked = None
            return None
        schedule.replace_runs(runs)
        # The goal begins in this cycle, and with it the mode is moving, whatever it was.
        self._running, self._change = True, None
        self._greatest_rate = self._goal.greatest_rate if self._goal else math.inf
        if run.target != self._rate:
            self._start_rate_change()
        return AcceptedPlan(planned.reply, planned.bound)

    def _stopping(self, under_way: Run, planned: Planned) -> Run:
        """Return the motion under way, stopping, with no goal on its path."""
        run = under_way.copy()
        run.seams.clear()
        run.marks.clear()
        if planned.stop is not None:
            run.change_law(unpack_law(planned.stop), 0.0)
        return run

    def _continues(self, runs: Iterable[Run]) -> bool:
        """Whether the runs begin with the present commanded motion, and each where the one before it ends at rest.

        From rest a trajectory may begin with an acceleration: the planner has checked that jerk.
        """
        state = self._schedule.commanded
        for run in runs:
            begins = run.state(0.0, state.pose)
            if state.at_rest:
                state = state._replace(acceleration=begins.acceleration)
            if not _same(begins, state):
                return False
            state = rest(run.state(run.end_time - run.time, state.pose).pose)
        return True

    def _marks(self, switches: bytes) -> GoalMarks:
        """Return the marks of the planned goal. Raises ValueError where the switches are not those of its marks."""
        return GoalMarks(self._goal_id, self._goal.marks if self._goal is not None else (), switches)

    def _extend(self, extended: Extended) -> AcceptedPlan | None:
        schedule = self._schedule
        path = unpack_path(extended.path, 3)
        run = schedule.runs[-1] if schedule.runs else None
        if (
            run is None
            or run.law_state.s >= extended.s
            or not _same(nominal_motion(run.path, extended.s), nominal_motion(path, 0.0))
        ):
            self._asked = None
            return None
        schedule.append(extended.s, path, self._marks(extended.switches))
        return AcceptedPlan(extended.reply.with_duration(schedule.remaining if run.target else math.inf))


def _same(one: MotionState, other: MotionState) -> bool:
    """Whether two states of motion are equal except for rounding; NaN never is."""
    return all(
        abs(a - b) <= allowed
        for allowed, here, there in zip(ROUNDING, one, other, strict=True)
        for a, b in zip(here, there, strict=True)
    )


def _triple(values: Sequence[float]) -> Triple:
    x, y, z = values
    return (x, y, z)
