"""Which goal is planned next, which ones wait, and which must not begin any more."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from trirail.control.lease import LeaseArbiter
from trirail.control.ledger import Ledger, Withdrawal
from trirail.control.plan_requests import PlanRequests
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.goal_motion import Place
from trirail.motion.goal_planner import meant
from trirail.motion.schedule import Schedule
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.goals import Goal
from trirail.wire.messages import Notice, Outcome
from trirail.wire.packets import GoalRequest

FURTHEST = 0.5
"""How long ago, or how far ahead, a target may have been where a track says [s]: farther nobody knows where it is."""


class _Sent(NamedTuple):
    """A goal that has come, and when it was sent, as a cycle: what waited at the gateway is older than the cycle."""

    request: GoalRequest
    cycle: float

    def known_since(self, period: float) -> float:
        """Return when a target was where a track says, as a cycle."""
        return self.cycle - self.request.age / period


class GoalQueue:
    """Takes goals in their order to the planner, and to the ledger what becomes of them."""

    def __init__(
        self,
        ledger: Ledger,
        lease: LeaseArbiter,
        planner: PlanRequests,
        schedule: Schedule,
        frames: NamedFrames,
        queue: int,
        period: float,
    ) -> None:
        self._ledger = ledger
        self._lease = lease
        self._planner = planner
        self._schedule = schedule
        self._frames = frames
        self._queue = queue
        self._period = period
        self._waiting: deque[_Sent] = deque()
        self._served: dict[str, int] = {}
        """When each user's last goal had its turn, counted since there was none to plan."""
        self._planned: _Sent | None = None
        self._told_busy = False

    @property
    def idle(self) -> bool:
        """Whether no goal is being planned and none waits for that."""
        return not self._waiting and not self._planner.busy

    def due(self, cycle: int) -> float:
        """Return before which cycle, `cycle` or a later one, there is something to think about, if nothing is heard."""
        expiring = min((goal.expires for number, goal in enumerate(self._ledger.goals) if number), default=math.inf)
        if self._planner.busy and self._planned is not None:
            request, sent = self._planned
            valid = request.goal.valid_for
            expiring = min(expiring, self._alive_until(self._planned))
            expiring = min(expiring, sent + valid / self._period if valid is not None else math.inf)
        elif self._waiting:
            return cycle
        return min(math.floor(expiring) + 1 if math.isfinite(expiring) else math.inf, cycle + self._planner.due)

    def enqueue(self, request: GoalRequest, now_ns: int, cycle: int) -> None:
        """Take a goal before a cycle, at a time of the monotonic clock; it waits for its user's turn.

        A renewal that comes often takes the place of the one before it that still waits.
        """
        age = (now_ns - request.received_ns) * 1e-9 / self._period
        sent = _Sent(request, cycle - age)
        if self.idle:
            self._served.clear()
        if request.goal.frequent and self._ledger.renewed_by(request):
            before = next((other for other in self._waiting if self._ledger.renewed_by(other.request)), None)
            if before is not None:
                self._waiting.remove(before)
                self._ledger.pass_over(before.request)
        self._waiting.append(sent)
        self._ledger.keep_alive(request, self._alive_until(sent))

    def think(self, cycle: int, admit: Callable[[], bool], place: Place) -> GoalRequest | None:
        """Have the next goal planned if none is, and take what has been planned; return a goal that begins.

        `admit` raises RefusedError where the robot takes no goal, and says whether it is moving to one; `place` says
        from where a move begins.
        """
        if not self._planner.busy and self._waiting:
            self._planned = self._next()
            try:
                self._consider(self._planned, cycle, admit, place)
            except RefusedError as refusal:
                self._ledger.refuse(self._planned.request, refusal)
        try:
            if self._planner.busy and self._planned is not None:
                self._tell_busy(self._planned.request)
                self._ledger.check_id(self._planned.request)  # it may end while its renewal is being planned
                self._lease.check(self._planned.request.user)  # and the lease may have another holder by now
                self._check_age(self._planned, cycle)
            at_end = self._planner.busy and self._schedule.ended
            taken = self._planner.think()
        except RefusedError as refusal:
            self._planner.give_up()
            if self._planned is not None:
                self._ledger.refuse(self._planned.request, refusal)
            return None
        if taken is None or self._planned is None:
            return None
        request, sent = self._planned
        valid = request.goal.valid_for
        expires = sent + valid / self._period if valid is not None else math.inf
        same = [later for later in (self._planned, *self._waiting) if later.request.id == request.id]
        self._ledger.begin(request, taken, expires, max(map(self._alive_until, same)), at_end=at_end)
        return request

    def withdraw(self, outcome: Withdrawal, reason: str) -> None:
        """End what has been sent but not begun."""
        requests = [sent.request for sent in self._waiting]
        if self._planner.busy and self._planned is not None:
            requests.insert(0, self._planned.request)
        self._planner.give_up()
        self._waiting.clear()
        for request in requests:
            self._ledger.withdraw(request, outcome, reason)

    def stop_alone(self, goal_id: str, reason: str) -> bool:
        """Stop a goal that has not begun; whether that was all. Raises RefusedError if it is not under way at all."""
        if self._ledger.goal is not None and self._ledger.goal.id == goal_id:
            return False
        for number, goal in enumerate(self._ledger.goals):
            if goal.id == goal_id:
                self._drop(number, goal_id, "stopped", reason)
                return True
        if self._planner.busy and self._planned is not None and self._planned.request.id == goal_id:
            self._planner.give_up()
            self._ledger.withdraw(self._planned.request, "stopped", reason)
            return True
        for sent in self._waiting:
            if sent.request.id == goal_id:
                self._waiting.remove(sent)
                self._ledger.withdraw(sent.request, "stopped", reason)
                return True
        raise RefusedError(RefusalCode.NO_GOAL, f"goal {goal_id!r} is not under way: it has ended, or never was")

    def expire(self, cycle: int) -> None:
        """Let go of waiting goals that can no more begin in time, and of those behind them."""
        for number, goal in enumerate(self._ledger.goals):
            if number and cycle > goal.expires:
                self._drop(number, goal.id, "expired", "it has not begun in time")
                return

    def _next(self) -> _Sent:
        """Take the oldest goal of the user who has waited longest for his turn."""
        sent = min(self._waiting, key=lambda sent: self._served.get(sent.request.user, 0))
        self._waiting.remove(sent)
        self._served[sent.request.user] = max(self._served.values(), default=0) + 1
        return sent

    def _consider(self, sent: _Sent, cycle: int, admit: Callable[[], bool], place: Place) -> None:
        """Begin to plan a goal, or refuse it."""
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
        planned = self._timed(meant(goal, self._frames, place), sent, cycle)
        blend = ledger.goals[-1].blend if moving and ledger.goals and goal.follows else None
        if blend is not None and len(ledger.goals) > self._queue:
            text = f"{self._queue} goals are waiting already (motion.queue): send it when one has ended"
            raise RefusedError(RefusalCode.QUEUE_FULL, text, value=len(ledger.goals), limit=self._queue)
        self._planner.plan(planned, blend)

    def _timed(self, planned: Goal, sent: _Sent, cycle: int) -> Goal:
        """Return a goal with its time as the schedule counts it. Raises RefusedError where that is too far from now.

        The setpoints of the schedule's cycle, which is commanded now, are taken up at this cycle's SYNC: that is now.
        """
        if not planned.timed:
            return planned
        ago = (cycle - sent.known_since(self._period)) * self._period
        if ago > FURTHEST >= abs(sent.request.age):
            waited = ago - sent.request.age
            text = (
                f"what was told of the target has waited {waited:.3f} s behind its sender's others: send fewer a second"
            )
            raise RefusedError(RefusalCode.BUSY, text, value=waited)
        if not abs(ago) <= FURTHEST:
            when = f"{ago:.3f} s ago" if ago > 0.0 else f"in {-ago:.3f} s"
            text = (
                f"the target is said to be there {when}, by the clock of this machine: {FURTHEST:g} s at most is taken"
            )
            raise RefusedError(RefusalCode.WRONG_TIME, text, value=ago, limit=math.copysign(FURTHEST, ago))
        return planned.at(self._schedule.cycle * self._period - ago)

    def _tell_busy(self, request: GoalRequest) -> None:
        """Tell everyone, once until it has said something, that a goal waits for a planner that is busy."""
        busy = self._planner.how_busy
        if busy and not self._told_busy:
            self._ledger.notices.append(
                Notice("service", "warning", f"{busy}: goal {request.id} waits", user=request.user)
            )
        self._told_busy = bool(busy)

    def _check_age(self, sent: _Sent, cycle: int) -> None:
        """Refuse what can no more begin in time."""
        valid = sent.request.goal.valid_for
        why = f"; {self._planner.how_busy}" if self._planner.how_busy else ""
        if valid is not None and cycle - sent.cycle > valid / self._period:
            raise RefusedError(RefusalCode.EXPIRED, f"the goal came too late: it was valid for {valid:g} s{why}")
        if cycle > self._alive_until(sent):
            raise RefusedError(
                RefusalCode.EXPIRED, f"it came too late: its timeout was over before it could begin{why}"
            )

    def _alive_until(self, sent: _Sent) -> float:
        """Return the cycle in which a goal ends that nobody renews; infinite for those that need not be."""
        return sent.cycle + sent.request.goal.timeout / self._period

    def _drop(self, number: int, goal_id: str, outcome: Outcome, reason: str) -> None:
        """End a goal that waits, and those behind it."""
        self._ledger.end("stopped", f"goal {goal_id} before it {outcome}", but=number + 1)
        self._ledger.end(outcome, reason, but=number)
        self._schedule.drop(number - 1)
        self._planner.run_at(self._planner.override)
