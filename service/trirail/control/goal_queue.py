"""Queue of received goals. The queue sends one goal at a time to the planner, and ends goals that have expired."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from trirail.control.lease import LeaseArbiter
from trirail.control.ledger import ActiveGoal, Ledger, Withdrawal
from trirail.control.outputs import Outputs
from trirail.control.plan_requests import PlanRequests
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.goal_motion import PoseSource
from trirail.motion.goal_planner import resolve_goal
from trirail.motion.schedule import Schedule
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.goals import Goal
from trirail.wire.messages import Notice, Outcome
from trirail.wire.packets import GoalRequest

MAX_PASSES = 8
"""Greatest number of times that goals of other users may interrupt the planning of a lengthy goal."""
MAX_TARGET_AGE_S = 0.5
"""Greatest difference between the time of a track's target and the present [s]. Other reports are refused."""


class _ReceivedGoal(NamedTuple):
    """Goal, and the time at which the gateway received the goal, expressed as a cycle number."""

    request: GoalRequest
    cycle: float
    passes: int = 0
    """Number of times that goals of other users have interrupted the planning of this goal."""

    def known_since(self, period: float) -> float:
        """Return the time at which the target of a track was at the reported pose, expressed as a cycle number."""
        return self.cycle - self.request.age / period


class GoalQueue:
    """Queue of goals for the planner. Users are served in turn, and the ledger receives the outcome of each goal."""

    def __init__(
        self,
        ledger: Ledger,
        lease: LeaseArbiter,
        planner: PlanRequests,
        schedule: Schedule,
        frames: NamedFrames,
        queue: int,
        period: float,
        outputs: Outputs,
    ) -> None:
        self._ledger = ledger
        self._lease = lease
        self._planner = planner
        self._schedule = schedule
        self._frames = frames
        self._queue = queue
        self._period = period
        self._outputs = outputs
        self._waiting: deque[_ReceivedGoal] = deque()
        self._served: dict[str, int] = {}
        """Sequence number of the latest goal of each user that was planned since the queue was last idle."""
        self._planned: _ReceivedGoal | None = None
        self._busy_reported = False

    @property
    def idle(self) -> bool:
        """Whether the queue is empty and the planner has no goal."""
        return not self._waiting and not self._planner.busy

    def due(self, cycle: int) -> float:
        """Return the cycle in which `step` must be called even if nothing is received until then.

        `cycle` is the number of the next cycle.
        """
        expiring = min((goal.expires for goal in self._not_begun), default=math.inf)
        if self._planner.busy and self._planned is not None:
            request, sent, _ = self._planned
            if self._is_passed(self._planned):
                return cycle
            valid = request.goal.valid_for
            expiring = min(expiring, self._alive_until(self._planned))
            expiring = min(expiring, sent + valid / self._period if valid is not None else math.inf)
        elif self._waiting:
            return cycle
        return min(math.floor(expiring) + 1 if math.isfinite(expiring) else math.inf, cycle + self._planner.due)

    def enqueue(self, request: GoalRequest, now_ns: int, cycle: int) -> None:
        """Add a goal to the queue. A renewal replaces the earlier renewals that are still waiting.

        Parameters
        ----------
        now_ns
            Current time of the monotonic clock [ns].
        cycle
            Number of the next cycle.

        """
        age = (now_ns - request.received_ns) * 1e-9 / self._period
        sent = _ReceivedGoal(request, cycle - age)
        if self.idle:
            self._served.clear()
        self._waiting.append(sent)
        self._pass_over_renewals()
        self._ledger.keep_alive(request, self._alive_until(sent))

    def step(self, cycle: int, admit: Callable[[], bool], place: PoseSource) -> GoalRequest | None:
        """Request a plan for the next goal, or accept a finished plan.

        Return the goal if its plan has been accepted, so that its motion begins now; otherwise None.

        Parameters
        ----------
        admit
            Function that returns True if the robot is moving to a goal. It raises RefusedError if the robot cannot
            accept a goal now.
        place
            Function that returns the pose from which a relative move begins.

        """
        if self._planned is not None and self._is_passed(self._planned):
            self._planner.cancel()
            self._waiting.appendleft(self._planned._replace(passes=self._planned.passes + 1))
        if not self._planner.busy and self._waiting:
            self._planned = self._next()
            try:
                self._consider(self._planned, cycle, admit, place)
            except RefusedError as refusal:
                self._ledger.refuse(self._planned.request, refusal)
        try:
            if self._planner.busy and self._planned is not None:
                self._report_busy(self._planned.request)
                # During planning, the goal to be renewed may have ended, or another user may have acquired the lease.
                self._ledger.check_id(self._planned.request)
                self._lease.check(self._planned.request.user)
                self._check_age(self._planned, cycle)
            at_end = self._planner.busy and self._schedule.ended
            accepted = self._planner.step()
        except RefusedError as refusal:
            self._planner.cancel()
            if self._planned is not None:
                self._ledger.refuse(self._planned.request, refusal)
            return None
        if accepted is None or self._planned is None:
            return None
        request, sent, _ = self._planned
        valid = request.goal.valid_for
        expires = sent + valid / self._period if valid is not None else math.inf
        same = [later for later in (self._planned, *self._waiting) if later.request.id == request.id]
        self._ledger.begin(request, accepted, expires, max(map(self._alive_until, same)), at_end=at_end)
        self._pass_over_renewals()
        return request

    def withdraw(self, outcome: Withdrawal, reason: str) -> None:
        """End all goals that have been received but have not begun."""
        requests = [sent.request for sent in self._waiting]
        if self._planner.busy and self._planned is not None:
            requests.insert(0, self._planned.request)
        self._planner.cancel()
        self._waiting.clear()
        for request in requests:
            self._ledger.withdraw(request, outcome, reason)

    def stop_alone(self, goal_id: str, reason: EventText) -> bool:
        """Stop a goal that has not begun, and return True. Return False without effect for the current goal.

        Raises RefusedError if no goal has this id.
        """
        if self._ledger.goal is not None and self._ledger.goal.id == goal_id:
            return False
        for number, goal in enumerate(self._ledger.goals):
            if goal.id == goal_id:
                self._drop(number, goal_id, "stopped", reason)
                return True
        if self._planner.busy and self._planned is not None and self._planned.request.id == goal_id:
            self._planner.cancel()
            self._ledger.withdraw(self._planned.request, "stopped", reason.text)
            return True
        for sent in self._waiting:
            if sent.request.id == goal_id:
                self._waiting.remove(sent)
                self._ledger.withdraw(sent.request, "stopped", reason.text)
                return True
        raise RefusedError(RefusalCode.NO_GOAL, f"goal {goal_id!r} is not in progress: it has ended or was never sent")

    def expire(self, cycle: int) -> bool:
        """End planned goals that can no longer begin in time, together with the goals that follow them.

        Return whether the current goal has ended, because a pause or an override of 0 has kept it at its start.
        """
        late = next((goal for goal in self._not_begun if cycle > goal.expires), None)
        if late is None:
            return False
        number, reason = self._ledger.goals.index(late), coded("the goal did not start in time", EventCode.TOO_LATE)
        self._drop(number, late.id, "expired", reason)
        return number == 0

    @property
    def _not_begun(self) -> list[ActiveGoal]:
        """Planned goals that have not begun to move the robot."""
        return list(self._ledger.goals)[0 if self._schedule.has_not_begun else 1 :]

    def _pass_over_renewals(self) -> None:
        """Keep only the newest waiting renewal of the current goal. An older one could expire while it is planned."""
        for before in [sent for sent in self._waiting if self._ledger.renewed_by(sent.request)][:-1]:
            self._waiting.remove(before)
            self._ledger.pass_over(before.request)

    def _next(self) -> _ReceivedGoal:
        """Remove and return the oldest waiting goal of the user who was served least recently."""
        sent = min(self._waiting, key=lambda sent: self._served.get(sent.request.user, 0))
        self._waiting.remove(sent)
        self._served[sent.request.user] = max(self._served.values(), default=0) + 1
        return sent

    def _is_passed(self, planned: _ReceivedGoal) -> bool:
        """Return whether the planning of a goal may be interrupted for a goal of another user."""
        if not self._planner.awaits_answer or not planned.request.goal.lengthy or planned.passes >= MAX_PASSES:
            return False
        return any(sent.request.user != planned.request.user for sent in self._waiting)

    def _consider(self, sent: _ReceivedGoal, cycle: int, admit: Callable[[], bool], place: PoseSource) -> None:
        """Check a goal and request its plan. Raises RefusedError if the goal is not accepted."""
        ledger, request, goal = self._ledger, sent.request, sent.request.goal
        ledger.check_id(request)
        if request.withdrawn is not None:
            ledger.withdraw(request, "stopped", request.withdrawn)
            return
        self._lease.check(request.user)
        if not ledger.renewed_by(request):
            goal.check_beginning()
        moving = admit()
        self._check_age(sent, cycle)
        planned = self._timed(resolve_goal(goal, self._frames, place), sent, cycle)
        blend = ledger.goals[-1].blend if moving and ledger.goals and goal.follows else None
        if blend is not None and len(ledger.goals) > self._queue:
            text = (
                f"the goal queue is full ({self._queue} goals, motion.queue): send the goal when another goal has ended"
            )
            raise RefusedError(RefusalCode.QUEUE_FULL, text, value=len(ledger.goals), limit=self._queue)
        self._outputs.check_marks(planned.marks)
        if planned.stop_at is not None:
            self._outputs.check_input(planned.stop_at.input)
        self._planner.plan(planned, blend, request.id)

    def _timed(self, planned: Goal, sent: _ReceivedGoal, cycle: int) -> Goal:
        """Return the goal with the time of its target converted to the time of the schedule.

        Raises RefusedError if the time of the target is too far from the present.
        """
        # The present is the SYNC of this cycle, at which the drives accept the setpoints of the schedule's current
        # cycle.
        if not planned.timed:
            return planned
        ago = (cycle - sent.known_since(self._period)) * self._period
        if ago > MAX_TARGET_AGE_S >= abs(sent.request.age):
            waited = ago - sent.request.age
            text = (
                f"the target has waited {waited:.3f} s for earlier messages of its sender to be read: "
                "send fewer messages per second"
            )
            raise RefusedError(RefusalCode.BUSY, text, value=waited)
        if not abs(ago) <= MAX_TARGET_AGE_S:
            when = f"{ago:.3f} s ago" if ago > 0.0 else f"in {-ago:.3f} s"
            text = (
                f"the time of the target is {when} by this machine's clock; the maximum is {MAX_TARGET_AGE_S:g} s: "
                "synchronise the clocks of both machines"
            )
            raise RefusedError(RefusalCode.WRONG_TIME, text, value=ago, limit=math.copysign(MAX_TARGET_AGE_S, ago))
        return planned.at(self._schedule.cycle * self._period - ago)

    def _report_busy(self, request: GoalRequest) -> None:
        """Report that a goal is waiting because the planner is busy. Only one report is sent per busy period."""
        busy = self._planner.busy_message
        if busy and not self._busy_reported:
            words, silence = f"{busy}: goal {request.id} is waiting", self._planner.silence
            text = coded(words, EventCode.PLANNER_BUSY, goal=request.id, silence=silence)
            self._ledger.notices.append(Notice("service", "warning", text.text, user=request.user, **text.fields))
        self._busy_reported = bool(busy)

    def _check_age(self, sent: _ReceivedGoal, cycle: int) -> None:
        """Raise RefusedError if the goal can no longer begin in time."""
        valid = sent.request.goal.valid_for
        why = f"; {self._planner.busy_message}" if self._planner.busy_message else ""
        if valid is not None and cycle - sent.cycle > valid / self._period:
            raise RefusedError(RefusalCode.EXPIRED, f"the goal did not start within its valid_for of {valid:g} s{why}")
        if cycle > self._alive_until(sent):
            raise RefusedError(RefusalCode.EXPIRED, f"the timeout of the goal elapsed before the goal could start{why}")

    def _alive_until(self, sent: _ReceivedGoal) -> float:
        """Return the cycle in which the goal ends without a renewal; infinite if the goal needs no renewals."""
        return sent.cycle + sent.request.goal.timeout / self._period

    def _drop(self, number: int, goal_id: str, outcome: Outcome, reason: EventText) -> None:
        """End a planned goal and the goals that follow it."""
        words = f"the earlier goal {goal_id} {outcome}"
        before = coded(words, EventCode.EARLIER_GOAL_ENDED, goal=goal_id, outcome=outcome)
        self._ledger.end("stopped", before, but=number + 1)
        self._ledger.end(outcome, reason, but=number)
        if number:
            self._schedule.drop(number - 1)
            self._planner.update_rate()
        if self._planner.busy and self._planned is not None:
            # The goal in planning would follow a dropped goal, so it is planned again.
            self._planner.cancel()
            self._waiting.appendleft(self._planned)
