"""Who asked for what, and what became of it: every goal ends once, every command is answered once."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Literal, NamedTuple

from msgspec import structs
from trirail_drivers.interface import Triple

from trirail.control.in_position import Settled
from trirail.control.plan_requests import AcceptedPlan
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.goals import Goal
from trirail.wire.messages import REMEMBERED_IDS, Level, Notice, Outcome
from trirail.wire.packets import (
    Accepted,
    Answer,
    CommandRequest,
    Confirmed,
    GoalRequest,
    Looked,
    PoseChanged,
    Refused,
    RefusedRequest,
    Remark,
    Request,
)
from trirail.wire.vocabulary import Command

Withdrawal = Literal["stopped", "faulted"]
"""How a goal ends that has been sent but did not begin: the outcome in its event, and the code of its refusal."""
_LEVELS: dict[Outcome, Level] = {
    "faulted": "error",
    "rejected": "warning",
    "expired": "warning",
    "unsettled": "warning",
}


class ActiveGoal(NamedTuple):
    """A goal that the robot is moving to, or that is to follow it."""

    id: str
    user: str
    kind: type[Goal]
    blend: float | None
    """How far from its end the next goal may begin [m]; None where that preempts it."""
    expires: float
    """In which cycle it is too late to begin."""
    alive_until: float
    """In which cycle it ends unless it has been renewed."""
    released: bool = False
    """Whether that has happened: what nobody renewed does not come back."""
    bound: str | None = None
    """The limit before which a jog comes to rest, or beyond which a track's target is."""
    settles: bool = True
    """Whether it is done only when the robot is in position."""
    target: Triple | None = None
    """The pose that a track's target was last told to have."""
    lag: float | None = None
    """Likewise, trirail.wire.messages.GoalReply."""


class _Ended(NamedTuple):
    """How a goal has ended; `bound` as of an ActiveGoal, where a jog has ended at it."""

    user: str
    kind: type[Goal]
    outcome: Outcome
    reason: str
    bound: str | None

    def over(self, goal_id: str) -> RefusedError:
        """Return what is said to one who would renew it."""
        if self.bound is not None:
            text = f"jog {goal_id!r} has ended at the limit of {self.bound}: begin a new one, away from it"
            return RefusedError(RefusalCode.AT_LIMIT, text)
        if self.outcome == "done":
            return _not_renewed(goal_id)
        text = f"goal {goal_id!r} is over, {self.outcome}: {self.reason}; begin a new one"
        return RefusedError(RefusalCode.JOG_OVER, text)


class Ledger:
    """Keeps the goals and the commands under way; what it has to say waits in `answers` and `notices`."""

    def __init__(self) -> None:
        self.goals: deque[ActiveGoal] = deque()
        """The goal that the robot is moving to, and those to follow it."""
        self.answers: list[Answer] = []
        self.notices: list[Notice] = []
        self._commands: dict[Command, deque[tuple[CommandRequest, int]]] = {}
        self._ended: dict[str, _Ended] = {}
        self._refused: tuple[str, RefusalCode] | None = None
        """The track of which something was refused last, and why."""

    # ------------------------------------------------------------------ goals

    @property
    def goal(self) -> ActiveGoal | None:
        """The goal that the robot is moving to."""
        return self.goals[0] if self.goals else None

    def check_id(self, request: GoalRequest) -> None:
        """Raise RefusedError if the id has been used; what renews a goal shares its own."""
        goal_id = request.id
        running = any(goal.id == goal_id for goal in self.goals)
        ended = self._ended.get(goal_id)
        if ended is not None and ended.kind.renewed and (ended.kind, ended.user) == (type(request.goal), request.user):
            raise ended.over(goal_id)
        if ended is not None or (running and not self.renewed_by(request)):
            raise RefusedError(RefusalCode.DUPLICATE_ID, f"goal id {goal_id!r} has been used: every goal needs its own")
        if self.goal is not None and self.goal.released and self.renewed_by(request):
            raise _not_renewed(goal_id)

    def pass_over(self, request: GoalRequest) -> None:
        """Accept a renewal in whose place a newer one is taken up."""
        self.answers.append(Accepted(request.ticket, request.id, math.inf, 1.0, stops_first=False, queued=False))

    def keep_alive(self, request: GoalRequest, until: float) -> None:
        """Let the goal under way go on until a cycle, if this renews it and it is not to end."""
        if self.renewed_by(request) and self.goals[0].alive_until > -math.inf:
            self.goals[0] = self.goals[0]._replace(alive_until=until)

    def release(self, cycle: int) -> ActiveGoal | None:
        """Return the goal under way if it has not been renewed in time, the first time that this is so."""
        goal = self.goal
        if goal is None or goal.released or cycle <= goal.alive_until:
            return None
        self.goals[0] = goal._replace(released=True)
        return goal

    def begin(
        self, request: GoalRequest, taken: AcceptedPlan, expires: float, alive_until: float, *, at_end: bool = False
    ) -> None:
        """Accept a goal; those before it are preempted, unless it follows them or renews the one under way.

        `at_end` tells whether the motion before it has ended: to a goal with a blend, that goal is done.
        """
        self.answers.append(
            Accepted(
                request.ticket, request.id, taken.duration, taken.slowed, taken.stops_first, taken.queued, taken.lag
            )
        )
        if self.renewed_by(request):
            self._renew(request, taken)
            return
        goal, last = request.goal, self.goals[-1] if self.goals else None
        passes = at_end and last is not None and last.blend is not None and goal.follows
        if not taken.queued and not passes:
            self.end("preempted", f"preempted by goal {request.id}")
        begun = ActiveGoal(request.id, request.user, type(goal), goal.blend, expires, alive_until, settles=goal.settle)
        self.goals.append(begun)
        if passes:
            self.pass_on()
        if goal.renewed:
            self._renew(request, taken)

    def _renew(self, request: GoalRequest, taken: AcceptedPlan) -> None:
        """Take in what was told of the goal under way; where a target is out of reach, everyone is to know."""
        goal, told = request.goal, self.goals[0]
        if goal.target is not None and taken.bound not in (None, told.bound):
            text = f"the target of goal {told.id} is beyond the limit of {taken.bound}: the robot waits there"
            self.notices.append(Notice("service", "warning", text, user=told.user))
        bound = taken.bound or (told.bound if goal.target is not None else None)  # a limit is told of once
        self.goals[0] = told._replace(bound=bound, target=goal.target, lag=taken.lag)

    def pass_on(self) -> None:
        """The first goal is reached, and the one that waited for it has begun."""
        goal = self.goals.popleft()
        self._ending(goal.id, goal.user, goal.kind, "done", f"passed on the way to goal {self.goals[0].id}")

    def end(self, outcome: Outcome, reason: str, but: int = 0, settled: Settled | None = None) -> None:
        """End the goals, but so many of the first."""
        kept = [self.goals.popleft() for _ in range(min(but, len(self.goals)))]
        while self.goals:
            goal = self.goals.popleft()
            at_limit = outcome == "done" and not goal.released and not goal.kind.waits_at_end
            bound = goal.bound if at_limit else None
            words = f"at the limit of {bound}" if bound else reason
            self._ending(goal.id, goal.user, goal.kind, outcome, words, bound, settled)
        self.goals.extend(kept)

    def withdraw(self, request: GoalRequest, outcome: Withdrawal, reason: str) -> None:
        """Answer that a goal has ended before it began."""
        self.answers.append(
            Refused(request.ticket, RefusalCode(outcome), f"goal {request.id} {outcome} before it began: {reason}")
        )
        if not self.renewed_by(request):
            self._ending(request.id, request.user, type(request.goal), outcome, reason)

    def is_all_of(self, user: str | None) -> bool:
        """Whether the goals and commands under way that need the lease are all a user's."""
        commands = (request for under_way in self._commands.values() for request, _ in under_way)
        senders = [goal.user for goal in self.goals] + [one.user for one in commands if not one.name.everybodys]
        return all(sender == user for sender in senders)

    def refuse(self, request: Request, refusal: RefusedError) -> None:
        """Answer that a request is not carried out. A goal that is refused has ended; a used id has its own ending.

        Everyone is told, of renewals that come often once: hundreds may follow before their sender hears of it.
        """
        if isinstance(request, RefusedRequest | PoseChanged | Looked | Remark):
            return
        text = str(refusal)
        self.answers.append(Refused(request.ticket, refusal.code, text, refusal.slider, refusal.value, refusal.limit))
        if isinstance(request, CommandRequest):
            self.notices.append(Notice("refused", "warning", f"{request.name} refused: {text}", user=request.user))
            return
        if request.goal.frequent:
            before, self._refused = self._refused, (request.id, refusal.code)
            if before == self._refused:
                return
        if refusal.code in (RefusalCode.DUPLICATE_ID, RefusalCode.AT_LIMIT, RefusalCode.JOG_OVER):
            self.notices.append(Notice("refused", "warning", text, user=request.user))
        else:
            outcome: Outcome = "expired" if refusal.code is RefusalCode.EXPIRED else "rejected"
            if self.renewed_by(request):
                self.notices.append(Notice("refused", "warning", text, user=request.user))
                if not request.goal.frequent:  # whoever asked for that is not to have the old one either
                    self.keep_alive(request, -math.inf)
            else:
                self._ending(request.id, request.user, type(request.goal), outcome, text)

    def renewed_by(self, request: GoalRequest) -> bool:
        """Whether it renews the goal that is under way; only its own user can."""
        goal = self.goal
        return (
            goal is not None
            and (goal.id, goal.user) == (request.id, request.user)
            and request.goal.renewed
            and type(request.goal) is goal.kind
        )

    def _ending(
        self,
        goal_id: str,
        user: str,
        kind: type[Goal],
        outcome: Outcome,
        reason: str,
        bound: str | None = None,
        settled: Settled | None = None,
    ) -> None:
        if goal_id in self._ended:  # by what also withdraws its renewals
            return
        level = _LEVELS.get(outcome, "info")
        self._ended[goal_id] = _Ended(user, kind, outcome, reason, bound)
        if len(self._ended) > REMEMBERED_IDS:
            del self._ended[next(iter(self._ended))]
        words = f"goal {goal_id} {outcome}: {reason}"
        said = Notice("goal", level, words, id=goal_id, outcome=outcome, reason=reason, user=user)
        self.notices.append(structs.replace(said, **settled._asdict()) if settled is not None else said)

    # ------------------------------------------------------------------ commands

    def undertake(self, request: CommandRequest, cycle: int) -> None:
        """Take a command on; it is answered once it has been carried out."""
        self._commands.setdefault(request.name, deque()).append((request, cycle))

    @property
    def busy(self) -> bool:
        """Whether a command is under way."""
        return any(self._commands.values())

    def settle(self, verdict: Callable[[Command, int], str | None], mode: str, cycle: int) -> None:
        """Answer the commands that are done or never will be.

        `verdict`, given a command's name and the cycle it came in, is "" for done, None for not yet, else why not.
        What is done shows from `cycle` on. A command is never done before an earlier one of its name: where that is
        not, the later ones are not looked at.
        """
        for name, under_way in self._commands.items():
            while under_way and (why := verdict(name, under_way[0][1])) is not None:
                request, _ = under_way.popleft()
                if why:
                    self.answers.append(Refused(request.ticket, RefusalCode.FAILED, f"{name} failed: {why}"))
                else:
                    self.answers.append(Confirmed(request.ticket, name, mode, cycle))


def _not_renewed(goal_id: str) -> RefusedError:
    return RefusedError(RefusalCode.JOG_OVER, f"goal {goal_id!r} was not renewed in time and is over: begin a new one")
