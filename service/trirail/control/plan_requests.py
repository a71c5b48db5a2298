"""Requests to the planner for one goal at a time, and application of the planned motions to the schedule.

The planner is a separate process. An answer may arrive late or twice, may be missing, or may belong to a motion that
has ended. No function that stops the robot waits for the planner.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Sequence
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
from trirail.motion.rules import RULES
from trirail.motion.runs import ZERO_RATES, MotionState, OwnBounds, Run, nominal_motion, rest
from trirail.motion.schedule import Schedule
from trirail.motion.time_scaling import TimeScaling
from trirail.wire.goals import Goal
from trirail.wire.messages import GoalReply
from trirail.wire.plan_packets import NotPlanned, PathExtension, PlanAnswer, PlanRequest, PreemptingMotion

LEADS = (0.003, 0.012, 0.048)
"""Time between a request and the start of the planned motion, if the robot is moving [s]. The first value is used for
the first request, the others for its repetitions."""
MIN_LEAD_CYCLES = 2
"""Shortest time between a request and the start of the motion [cycles]. An answer arrives at least one cycle later."""
PLANNING_TIMEOUT_S = 8.0
"""Longest wait for an answer of the planner, or for a motion that does not change while the goal is planned [s]. The
end of the planner process is reported without this delay."""
BUSY_AFTER_S = 0.5
"""Time without an answer after which the planner is reported as busy [s]."""
LEAD_FACTOR = 2
"""Shortest time between a repeated request and the start of the motion, in multiples of the last answer's delay."""
MAX_RATE_CHANGE_CYCLES = 12
"""Longest time that planning of a goal waits for a change of the rate [cycles]."""
ROUNDING = (1e-9, 1e-7, 1e-5)
"""Greatest differences in position, velocity and acceleration between the commanded motion and the start of a new
motion [m, rad, …]."""


class PlannerPort(Protocol):
    """Connection of the control to the planner, which may be another process."""

    def request_plan(self, request: PlanRequest) -> None:
        """Send a request without waiting. The control receives the planner's answer in a later cycle."""


class AcceptedPlan(NamedTuple):
    """Plan of a goal that has become part of the schedule."""

    reply: GoalReply
    """Reply to the sender of the goal, without the goal's id."""
    bound: str | None = None
    """Name of the limit that stops a jog, or that the target of a track exceeds."""


class PlanRequests:
    """Updates of the motion schedule. Changes of the rate are computed here; goals are planned by the planner."""

    def __init__(self, config: Config, port: PlannerPort, schedule: Schedule, rules: int = RULES) -> None:
        """`rules` is the version of the rules by which the rate changes; see trirail.motion.rules."""
        self.override = 1.0
        """Speed override of all motions, as a factor."""
        self._running = False
        robot, self._period = corrected_geometry(config), config.period
        limits = planned_limits(config.limits, config.correction.backlash)
        checker = Checker(robot, limits, Bounds(limits, self._period, labels=robot.labels), self._period)
        self._scaling = TimeScaling(robot, checker, self._period, rules)
        self._legs = robot.packed()
        self._revision = revision(config)
        self._port = port
        self._schedule = schedule
        self._leads = [max(MIN_LEAD_CYCLES, math.ceil(lead / self._period)) for lead in LEADS]
        self._goal: Goal | None = None
        self._goal_id = ""
        self._blend: float | None = None
        self._number = 0
        self._request: PlanRequest | None = None
        self._answer: PlanAnswer | None = None
        self._planned_run: Run | None = None
        """Motion of the answer, unpacked when the answer arrived, so that less is left to do in the cycle when the
        motion begins.
        """
        self._prepared: tuple[object, Run | None] = None, None
        """Latest answer that has been prepared, and its motion."""
        self._lost: str | None = None
        self._attempts = 0
        """Number of plans that were too late, or did not fit the motion for which they were requested."""
        self._answer_cycles = 0
        """Delay of the last answer [cycles]."""
        self._since: int | None = None
        """Cycle of the first request for the current goal since the last of these plans."""
        self._change: RateChange | None = None
        self._wanted_rate = 0.0
        """Rate to which the current motion has been changed last, as far as its limits allow."""

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
        """Whether a request has been sent to the planner and has not been answered."""
        return self._goal is not None and self._request is not None and self._answer is None

    @property
    def due(self) -> float:
        """Number of cycles until `step` must be called if nothing is received; 0 if it must be called now."""
        if self._running and self._rate != self._wanted_rate:
            return 0
        if self._goal is None:
            return math.inf if self._change is None else 0
        asked, answer, now = self._request, self._answer, self._schedule.cycle
        if self._change is not None or self._lost is not None or asked is None:
            return 0
        if isinstance(answer, PreemptingMotion) and answer.first is not None:
            return answer.first - now
        if answer is not None or asked.version != self._schedule.version:
            return 0
        return max(0, math.floor(BUSY_AFTER_S / self._period) - round(self.silence / self._period))

    @property
    def silence(self) -> float:
        """Time since the latest request for the current goal, if it has not been answered [s]."""
        asked = self._request
        return self._seconds_since(asked.cycle) if asked is not None and self._answer is None else 0.0

    @property
    def busy_message(self) -> str:
        """Message to the user that the planner is busy; empty if the planner is not busy."""
        silence = self.silence
        return f"the planner is busy and has not answered for {silence:.1f} s" if silence > BUSY_AFTER_S else ""

    def warm_up(self) -> None:
        """Compute a rate change for a schedule that is never executed, because the first call of the code is slow."""
        nowhere = Schedule(rest(ZERO_RATES), self._period)
        path = Path(np.array([0.0, 1.0]), np.zeros((1, 3, 6)))
        nowhere.replace_runs(deque([unpack_run(self._legs, pack_run(Run(self._legs, path, constant_law(1.0), 1.0)))]))
        RateChange(self._scaling, nowhere, 0.0, self._period).step()

    def plan(self, goal: Goal, blend: float | None = None, name: str = "") -> None:
        """Start planning a goal.

        Parameters
        ----------
        blend
            Distance from the end of the current motion at which the goal may begin [m]; None to preempt the current
            motion.
        name
            Id of the goal.

        """
        self._goal_id = name
        self._goal, self._blend, self._attempts, self._since = goal, blend, 0, None
        self._request = self._answer = self._planned_run = self._lost = None

    def cancel(self) -> None:
        """Stop planning the goal, and ignore answers that arrive later."""
        self._goal = self._request = self._answer = self._planned_run = self._lost = None

    @property
    def needs_old_motion(self) -> bool:
        """Whether the current goal begins only after the old motion has run to its end, because it cannot stop sooner.

        A pause would not brake the old motion, since the goal's path begins at its end.
        """
        runs = self._schedule.runs
        return len(runs) > 1 and runs[0].target != 0.0

    def run(self) -> None:
        """Run the current motion at the speed override."""
        self._running = True
        self._start_rate_change()

    def brake(self, *, stops: bool) -> None:
        """Brake the current motion to a standstill on its path; with `stops`, regardless of the goal's own limits."""
        self._running = False
        self._start_rate_change(stops=stops)

    def update_rate(self) -> None:
        """Adapt the rate of the current motion to a new override or a changed path, unless the motion is braking."""
        if self._running:
            self._start_rate_change()

    def discard_rate_change(self) -> None:
        """Discard the rate change, because the motion has ended."""
        self._running, self._change = False, None

    def prepare(self, answer: object) -> None:
        """Unpack the motion of an answer, so that `receive` has less to do."""
        self._prepared = answer, None
        if isinstance(answer, PreemptingMotion):
            with contextlib.suppress(ValueError):  # an invalid motion is refused when it would begin
                self._prepared = answer, unpack_run(self._legs, answer.run)

    def receive(self, answer: PlanAnswer) -> None:
        """Store the first answer to the latest request; ignore all other answers."""
        asked = self._request
        if asked is not None and (answer.number, answer.version) == (asked.number, asked.version) and not self._answer:
            self._answer = answer
            if self._prepared[0] is not answer:
                self.prepare(answer)
            _, self._planned_run = self._prepared
            self._answer_cycles = self._schedule.cycle - asked.cycle

    def fail(self, reason: str) -> None:
        """Record that the planner will not answer, so that `step` refuses the goal."""
        if self.awaits_answer:
            self._lost = reason

    def step(self) -> AcceptedPlan | None:
        """Advance a rate change, then request or apply the motion of the goal. Return the plan once it is accepted.

        A rate change takes precedence over a request. If the limits of the sliders delay the change for more than
        MAX_RATE_CHANGE_CYCLES, the goal is planned from the current motion without waiting. While a request is pending,
        the rate is only lowered. Raises RefusedError if the goal cannot be reached.
        """
        self._change_rate()
        if self._goal is None:
            return None
        self._check_wait()
        if self._lost is not None:
            raise RefusedError(RefusalCode.PLANNER_LOST, f"{self._lost}: send the goal again")
        if self._request is not None and self._request.version != self._schedule.version:
            self._request = None  # the motion has changed since the request
        if self._request is None:
            if self._awaits_lower_rate:
                return None
            if self._change is None or self._change.applied or self._change.cycles >= MAX_RATE_CHANGE_CYCLES:
                self._request_plan(self._goal)
            return None
        return self._apply(self._answer) if self._answer is not None else None

    # ------------------------------------------------------------------ inside

    def _seconds_since(self, cycle: int) -> float:
        return (self._schedule.cycle - cycle) * self._period

    def _check_wait(self) -> None:
        """Raise RefusedError if the goal has waited too long for an answer that fits the present motion."""
        if self._answer is not None or self._since is None or self._seconds_since(self._since) <= PLANNING_TIMEOUT_S:
            return
        if self.busy_message:
            raise RefusedError(
                RefusalCode.EXPIRED, f"{self.busy_message}: send the goal again when the machine is less busy"
            )
        # A request that is dropped because the motion has changed is not one of the attempts.
        text = (
            f"no plan was ready within {PLANNING_TIMEOUT_S:g} s while the motion was changing: "
            "send the goal again when the override no longer changes"
        )
        raise RefusedError(RefusalCode.NO_PLAN, text)

    @property
    def _rate(self) -> float:
        """Target rate of the current motion: the override, or the lower rate that a goal on its path allows."""
        if not self._running:
            return 0.0
        rate, last = self.override, self._schedule.last
        if last is not None:
            rate = min(rate, last.allowed_rate)
        return min(rate, self._goal_rate) if self._extends_motion else rate

    @property
    def _goal_rate(self) -> float:
        """Greatest rate that the goal being planned allows; infinite if there is no such goal."""
        return self._goal.greatest_rate if self._goal is not None else math.inf

    @property
    def _own_bounds(self) -> OwnBounds:
        """Bounds of the goal being planned."""
        own = self._goal.limits if self._goal is not None else None
        if own is None:
            return OwnBounds(self._goal_rate)
        rates = own.velocity, own.acceleration, own.jerk
        limits = np.array([each if each is not None else (math.inf,) * 3 for each in rates]).T
        return OwnBounds(self._goal_rate, limits)

    @property
    def _extends_motion(self) -> bool:
        """Whether the goal being planned follows the current motion without preempting it."""
        return self._blend is not None and self._schedule.last is not None and not self._schedule.ended

    @property
    def _awaits_lower_rate(self) -> bool:
        """Whether the current motion is faster than the goal allows, so that the goal cannot follow on its path yet."""
        last = self._schedule.last
        if last is None or not self._extends_motion:
            return False
        return max(last.law_state.rate, last.target) > self._goal_rate

    def _start_rate_change(self, *, stops: bool = False) -> None:
        """Start changing the rate of the current motion to its target."""
        self._wanted_rate = self._rate
        self._change = RateChange(self._scaling, self._schedule, self._rate, self._period, stops=stops)

    def _change_rate(self) -> None:
        if self._running and self._rate != self._wanted_rate:  # a goal that allows only a lower rate has come or gone
            self._start_rate_change()
        change = self._change
        if change is not None and (self._request is None or change.lowers_rate) and change.step():
            self._change = None

    def _request_plan(self, goal: Goal) -> None:
        """Request a motion from the current motion to the goal. Raises RefusedError after too many attempts."""
        if self._attempts == len(self._leads):
            text = f"no plan was ready in time in {self._attempts} attempts: send the goal again"
            raise RefusedError(RefusalCode.NO_PLAN, text)
        schedule, (pose, velocity, acceleration) = self._schedule, self._schedule.commanded
        self._number += 1
        self._answer = self._planned_run = None
        self._request = PlanRequest(
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
        self._since = self._since if self._since is not None else schedule.cycle
        self._port.request_plan(self._request)

    def _lead(self, goal: Goal) -> int:
        """Return the number of cycles between a request and the start of the requested motion."""
        lead = self._leads[self._attempts]
        if self._attempts:
            return max(lead, LEAD_FACTOR * self._answer_cycles)
        if not goal.renewed:
            return lead
        # The last answer may be that of a lengthy goal, whose delay exceeds the time-out of a jog or track.
        return max(lead, min(self._answer_cycles + 1, math.floor(0.5 * goal.timeout / self._period)))

    def _apply(self, answer: PlanAnswer) -> AcceptedPlan | None:
        """Apply the planner's answer once it is due. If the current motion no longer fits, drop the answer.

        After a dropped answer, `step` requests another plan.
        """
        if isinstance(answer, NotPlanned):
            raise answer.error()
        try:
            accepted = self._extend(answer) if isinstance(answer, PathExtension) else self._preempt(answer)
        except ValueError as error:
            raise RefusedError(
                RefusalCode.PLANNER_LOST, f"the planner's answer is not a valid motion: {error}"
            ) from error
        if accepted is not None:
            self.cancel()
        return accepted

    def _preempt(self, planned: PreemptingMotion) -> AcceptedPlan | None:
        schedule = self._schedule
        if planned.first is not None and schedule.cycle < planned.first:
            return None  # not due yet
        if planned.first is not None and schedule.cycle > planned.first:
            self._try_again()  # too late
            return None
        run = self._planned_run or unpack_run(self._legs, planned.run)
        run.own = self._own_bounds
        run.marks.append(self._marks(planned.switches))
        runs = deque([run])
        if planned.reply.stops_first and schedule.runs:
            runs.appendleft(self._stopping(schedule.runs[0], planned))
        if not self._continues(runs):
            self._try_again()
            return None
        schedule.replace_runs(runs)
        # The goal begins in this cycle, and the mode changes to moving.
        self._running, self._change = True, None
        self._wanted_rate = self._rate
        if run.target != self._rate:
            self._start_rate_change()
        return AcceptedPlan(planned.reply, planned.bound)

    def _try_again(self) -> None:
        """Drop the planner's answer, and let `step` request another plan with a longer lead."""
        self._request = self._since = None
        self._attempts += 1

    def _stopping(self, under_way: Run, planned: PreemptingMotion) -> Run:
        """Return a copy of the current motion that stops on its path, without the goals that follow on the path."""
        run = under_way.copy()
        run.withdraw_following()
        if planned.stop is not None:
            run.change_law(unpack_law(planned.stop), 0.0)
        return run

    def _continues(self, runs: Sequence[Run]) -> bool:
        """Return True if the runs continue the commanded motion and each other without a jump."""
        # A trajectory may begin with an acceleration from rest, because the planner has checked the resulting jerk.
        state = self._schedule.commanded
        for number, run in enumerate(runs):
            if number:
                before = runs[number - 1]
                state = rest(before.state(before.end_time - before.time, state.pose).pose)
            begins = run.state(0.0, state.pose)
            if state.at_rest:
                state = state._replace(acceleration=begins.acceleration)
            if not _same(begins, state):
                return False
        return True

    def _marks(self, switches: bytes) -> GoalMarks:
        """Return the marks of the goal being planned. Raises ValueError if the switches do not match the marks."""
        return GoalMarks(self._goal_id, self._goal.marks if self._goal is not None else (), switches)

    def _extend(self, extended: PathExtension) -> AcceptedPlan | None:
        schedule = self._schedule
        path = unpack_path(extended.path, 3)
        run = schedule.runs[-1] if schedule.runs else None
        if (
            run is None
            or run.law_state.s >= extended.s
            or not _same(nominal_motion(run.path, extended.s), nominal_motion(path, 0.0))
        ):
            self._try_again()
            return None
        schedule.append(extended.s, path, self._marks(extended.switches), self._own_bounds)
        return AcceptedPlan(extended.reply.with_duration(schedule.remaining if run.target else math.inf))


def _same(one: MotionState, other: MotionState) -> bool:
    """Return whether two states of motion agree within ROUNDING. The result is False for NaN."""
    return all(
        abs(a - b) <= allowed
        for allowed, here, there in zip(ROUNDING, one, other, strict=True)
        for a, b in zip(here, there, strict=True)
    )


def _triple(values: Sequence[float]) -> Triple:
    x, y, z = values
    return (x, y, z)
