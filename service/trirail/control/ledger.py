"""Ledger of active goals and commands. It ensures that each goal ends once and that each command is answered once."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Literal, NamedTuple

from msgspec import structs
from trirail_drivers.interface import Triple

from trirail.control.in_position import SettlingResult
from trirail.control.plan_requests import AcceptedPlan
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.goals import Goal
from trirail.wire.marks import StopAt
from trirail.wire.messages import REMEMBERED_IDS, GoalReply, Level, Notice, Outcome
from trirail.wire.packets import (
    Accepted,
    Answer,
    CommandDone,
    CommandRequest,
    GoalRequest,
    Refused,
)
from trirail.wire.vocabulary import Command

Withdrawal = Literal["stopped", "faulted"]
"""Outcome of a goal that ends before it begins. The event and the refusal of the goal both contain this word."""
_LEVELS: dict[Outcome, Level] = {
    "faulted": "error",
    "rejected": "warning",
    "expired": "warning",
    "unsettled": "warning",
}


class ActiveGoal(NamedTuple):
    """Goal that the robot is moving to, or that is queued behind the current goal."""

    id: str
    user: str
    kind: type[Goal]
    blend: float | None
    """Distance from the end of this goal at which the next goal may begin [m]; None if the next goal preempts it."""
    expires: float
    """Last cycle in which the goal may begin."""
    alive_until: float
    """Last cycle of the goal if the goal is not renewed."""
    released: bool = False
    """Whether the goal was not renewed in time. A late renewal cannot revive the goal."""
    refusal: Refused | None = None
    """Answer that refused a renewal, which has ended the goal; None if there is none."""
    bound: str | None = None
    """Name of the limit that stops a jog, or that the target of a track exceeds."""
    settles: bool = True
    """Whether the goal waits after the end of its path until the robot is in position."""
    target: Triple | None = None
    """Last reported pose of a track's target."""
    stop_at: StopAt | None = None
    """Edge of an input at which the goal ends."""
    at_edge: EventText | None = None
    """Text about that edge, after which the goal only brakes; None before the edge."""
    lag: float | None = None
    """Latest lag of a track behind its target; see trirail.wire.messages.GoalReply."""


class _GoalEnd(NamedTuple):
    """Summary of a goal that has ended.

    `bound` is the limit at which a jog has ended, `refusal` the text that refused the renewal of a goal that is done;
    empty if no renewal was refused. A summary is kept for long. It contains no exception, because the traceback of an
    exception keeps the local variables of all its calls, such as the goal with its trajectory.
    """

    user: str
    kind: type[Goal]
    outcome: Outcome
    reason: str
    bound: str | None
    refusal: str

    def renewal_error(self, goal_id: str) -> RefusedError:
        """Return the error for a renewal that arrives after the end of this goal."""
        if self.bound is not None:
            text = f"jog {goal_id!r} has ended at the limit of {self.bound}: start a new jog away from this limit"
            return RefusedError(RefusalCode.AT_LIMIT, text)
        if self.outcome == "done":
            return _not_renewed(goal_id, self.refusal)
        text = f"goal {goal_id!r} has ended ({self.outcome}: {self.reason}); start a new goal"
        return RefusedError(RefusalCode.JOG_OVER, text)


class Ledger:
    """Ledger of the active goals and commands. The lists `answers` and `notices` collect the outgoing messages."""

    def __init__(self, on_end: Callable[[str, Outcome], None] = lambda _goal, _outcome: None) -> None:
        """Create an empty ledger. Before the end of a goal is announced, `on_end` is called with its id and outcome."""
        self._on_end = on_end
        self.goals: deque[ActiveGoal] = deque()
        """Current goal, followed by the queued goals."""
        self.passed: deque[ActiveGoal] = deque(maxlen=8)
        """Last goals that have passed on to the next goal since this was cleared."""
        self.answers: list[Answer] = []
        self.notices: list[Notice] = []
        self._commands: dict[Command, deque[tuple[CommandRequest, int]]] = {}
        self._ended: dict[str, _GoalEnd] = {}
        self._refused: tuple[str, RefusalCode] | None = None
        """Id of the last refused goal of a frequently renewed kind, and the code of the refusal."""

    # ------------------------------------------------------------------ goals

    @property
    def goal(self) -> ActiveGoal | None:
        """Goal that the robot is moving to."""
        return self.goals[0] if self.goals else None

    def check_id(self, request: GoalRequest) -> None:
        """Raise RefusedError if the id has already been used, unless the request renews the current goal."""
        goal_id = request.id
        running = any(goal.id == goal_id for goal in self.goals)
        ended = self._ended.get(goal_id)
        if ended is not None and ended.kind.renewed and (ended.kind, ended.user) == (type(request.goal), request.user):
            raise ended.renewal_error(goal_id)
        if ended is not None or (running and not self.renewed_by(request)):
            raise RefusedError(
                RefusalCode.DUPLICATE_ID, f"goal id {goal_id!r} has already been used: give every goal its own id"
            )
        if self.goal is not None and self.goal.released and self.renewed_by(request):
            raise _not_renewed(goal_id, self.goal.refusal.message if self.goal.refusal is not None else "")

    def pass_over(self, request: GoalRequest) -> None:
        """Answer a renewal as accepted although a newer renewal has replaced it."""
        self.answers.append(Accepted(request.ticket, GoalReply(request.id, None)))

    def keep_alive(self, request: GoalRequest, until: float) -> None:
        """Extend the current goal until the cycle `until` if the request renews the goal.

        A goal that ends because a renewal was refused is not extended.
        """
        if self.renewed_by(request) and self.goals[0].refusal is None:
            self.goals[0] = self.goals[0]._replace(alive_until=until)

    def release(self, cycle: int) -> ActiveGoal | None:
        """Return the current goal if it was not renewed in time, or if a renewal was refused.

        Each goal is returned only once.
        """
        goal = self.goal
        if goal is None or goal.released or cycle <= goal.alive_until:
            return None
        self.goals[0] = goal._replace(released=True)
        return goal

    def begin(
        self, request: GoalRequest, plan: AcceptedPlan, expires: float, alive_until: float, *, at_end: bool = False
    ) -> None:
        """Accept a goal or a renewal. A new goal preempts the active goals, unless the new goal is queued.

        Parameters
        ----------
        expires
            Last cycle in which the goal may begin.
        alive_until
            Last cycle of the goal if the goal is not renewed.
        at_end
            Whether the previous motion has ended. If True, a previous goal with a blend ends as done, not as preempted.

        """
        self.answers.append(Accepted(request.ticket, structs.replace(plan.reply, id=request.id)))
        if self.renewed_by(request):
            self._renew(request, plan)
            return
        goal, last = request.goal, self.goals[-1] if self.goals else None
        passes = at_end and last is not None and last.blend is not None and goal.follows
        if not plan.reply.queued and not passes:
            self.end_at_edge()
            self.end("preempted", coded(f"preempted by goal {request.id}", EventCode.PREEMPTED, goal=request.id))
        begun = ActiveGoal(
            request.id,
            request.user,
            type(goal),
            goal.blend,
            expires,
            alive_until,
            settles=goal.settle,
            stop_at=goal.stop_at,
        )
        self.goals.append(begun)
        if passes:
            self.pass_on()
        if goal.renewed:
            self._renew(request, plan)
        if marks := plan.reply.marks:
            words = f"goal {request.id} switches outputs at {len(marks)} mark{'s' * (len(marks) > 1)} on its path"
            text = coded(words, EventCode.MARKS_PLANNED, goal=request.id, number=len(marks))
            self.notices.append(Notice("output", "info", text.text, goal=request.id, planned=marks, **text.fields))

    def _renew(self, request: GoalRequest, plan: AcceptedPlan) -> None:
        """Update the current goal from a renewal, and announce a target that is beyond a limit."""
        goal, goal_under_way = request.goal, self.goals[0]
        if goal.target is not None and plan.bound not in (None, goal_under_way.bound):
            words = (
                f"the target of goal {goal_under_way.id} is beyond the limit of {plan.bound}; "
                "the robot waits at the limit"
            )
            text = coded(words, EventCode.BEYOND_LIMIT, goal=goal_under_way.id)
            self.notices.append(Notice("service", "warning", text.text, user=goal_under_way.user, **text.fields))
        bound = plan.bound or (goal_under_way.bound if goal.target is not None else None)  # report a limit once
        self.goals[0] = goal_under_way._replace(bound=bound, target=goal.target, lag=plan.reply.lag)

    def pass_on(self) -> None:
        """End the first goal as done, because the next goal has begun."""
        goal = self.goals.popleft()
        self.passed.append(goal)
        following = self.goals[0].id
        reason = coded(f"passed on the way to goal {following}", EventCode.PASSED, goal=following)
        self._end_goal(goal.id, goal.user, goal.kind, "done", reason)

    def end(self, outcome: Outcome, reason: EventText, but: int = 0, settled: SettlingResult | None = None) -> None:
        """End all active goals except the first `but` goals."""
        kept = [self.goals.popleft() for _ in range(min(but, len(self.goals)))]
        while self.goals:
            goal = self.goals.popleft()
            at_limit = outcome == "done" and not goal.released and not goal.kind.waits_at_end
            bound = goal.bound if at_limit else None
            refusal = goal.refusal if outcome == "done" and bound is None else None
            text = reason
            if bound is not None:
                text = coded(f"at the limit of {bound}", EventCode.STOPPED_AT_LIMIT)
            elif refusal is not None:
                text = coded(f"a renewal was refused: {refusal.message}", EventCode.REFUSED)
            self._end_goal(goal.id, goal.user, goal.kind, outcome, text, bound, settled, refusal)
        self.goals.extend(kept)

    def note_edge(self, reason: EventText) -> None:
        """Record that the current goal has ended at the edge of an input, and end the goals that follow it."""
        self.end("stopped", reason, but=1)
        self.goals[0] = self.goals[0]._replace(at_edge=reason)

    def end_at_edge(self) -> None:
        """End the current goal as done if it only brakes after the edge of its input."""
        if self.goals and (at_edge := self.goals[0].at_edge) is not None:
            goal = self.goals.popleft()
            self._end_goal(goal.id, goal.user, goal.kind, "done", at_edge)

    def withdraw(self, request: GoalRequest, outcome: Withdrawal, reason: str) -> None:
        """End a goal that has not begun, and answer the request with a refusal."""
        text = f"goal {request.id} {outcome} before it began: {reason}"
        refused = Refused(request.ticket, RefusalCode(outcome), text)
        self.answers.append(refused)
        if all(goal.id != request.id for goal in self.goals):  # otherwise the id is that of an active goal
            ended = coded(reason, EventCode.REFUSED)
            self._end_goal(request.id, request.user, type(request.goal), outcome, ended, refused=refused)

    def is_all_of(self, user: str | None) -> bool:
        """Return whether all active goals, and all active commands that need the lease, belong to the given user."""
        commands = (request for under_way in self._commands.values() for request, _ in under_way)
        senders = [goal.user for goal in self.goals] + [one.user for one in commands if not one.name.ignores_lease]
        return all(sender == user for sender in senders)

    def refuse(self, request: GoalRequest | CommandRequest, refusal: RefusedError) -> None:
        """Refuse a request and announce the refusal. A refused goal has ended, unless its id was already in use.

        If refusals of a frequently renewed goal repeat, only the first refusal is announced, because the client may
        send hundreds of renewals before the answer arrives.
        """
        text = answered = str(refusal)
        if isinstance(request, GoalRequest) and request.goal.frequent and not self.renewed_by(request):
            ended = refusal.code in (RefusalCode.DUPLICATE_ID, RefusalCode.AT_LIMIT, RefusalCode.JOG_OVER)
            answered = text if ended else f"{text}; goal {request.id!r} has ended: start a new goal"
        refused = Refused(request.ticket, refusal.code, answered, refusal.slider, refusal.value, refusal.limit)
        self.answers.append(refused)
        if isinstance(request, CommandRequest):
            self.notices.append(_refused(f"{request.name} refused: {text}", request.user, refused))
            return
        if request.goal.frequent:
            before, self._refused = self._refused, (request.id, refusal.code)
            if before == self._refused:
                return
        if refusal.code in (RefusalCode.DUPLICATE_ID, RefusalCode.AT_LIMIT, RefusalCode.JOG_OVER):
            self.notices.append(_refused(text, request.user, refused))
        else:
            outcome: Outcome = "expired" if refusal.code is RefusalCode.EXPIRED else "rejected"
            if self.renewed_by(request):
                self.notices.append(_refused(text, request.user, refused))
                if not request.goal.frequent:  # a refused renewal also ends the goal
                    self.goals[0] = self.goals[0]._replace(alive_until=-math.inf, refusal=refused)
            else:
                reason = coded(text, EventCode.REFUSED)
                self._end_goal(request.id, request.user, type(request.goal), outcome, reason, refused=refused)

    def renewed_by(self, request: GoalRequest) -> bool:
        """Return whether a request renews the current goal. Both must have the same id, user and kind."""
        goal = self.goal
        return (
            goal is not None
            and (goal.id, goal.user) == (request.id, request.user)
            and request.goal.renewed
            and type(request.goal) is goal.kind
        )

    def _end_goal(
        self,
        goal_id: str,
        user: str,
        kind: type[Goal],
        outcome: Outcome,
        reason: EventText,
        bound: str | None = None,
        settled: SettlingResult | None = None,
        refused: Refused | None = None,
    ) -> None:
        if goal_id in self._ended:  # the event that ended the goal has also withdrawn a waiting renewal
            return
        self._on_end(goal_id, outcome)
        level = _LEVELS.get(outcome, "info")
        refusal = refused.message if refused is not None and outcome == "done" else ""
        self._ended[goal_id] = _GoalEnd(user, kind, outcome, reason.text, bound, refusal)
        if len(self._ended) > REMEMBERED_IDS:
            del self._ended[next(iter(self._ended))]
        words = f"goal {goal_id} {outcome}: {reason}"
        notice = Notice(
            "goal", level, words, id=goal_id, outcome=outcome, reason=reason.text, user=user, **reason.fields
        )
        notice = _with_code(notice, refused) if refused is not None else notice
        self.notices.append(structs.replace(notice, **settled._asdict()) if settled is not None else notice)

    # ------------------------------------------------------------------ commands

    def undertake(self, request: CommandRequest, cycle: int) -> None:
        """Add a command that has started in `cycle`. The command is answered when it is complete."""
        self._commands.setdefault(request.name, deque()).append((request, cycle))

    @property
    def busy(self) -> bool:
        """Whether a command is in progress."""
        return any(self._commands.values())

    def settle(self, verdict: Callable[[Command, int], str | None], mode: str, cycle: int) -> None:
        """Answer the commands that are complete or have failed.

        Commands of the same name are answered in the order of their arrival.

        Parameters
        ----------
        verdict
            Function that returns the result of a command's completion rule. The arguments are the name of the command
            and the cycle in which the command arrived.
        mode
            Current mode, which the answer contains.
        cycle
            First cycle that shows the effect of the command.

        """
        for name, under_way in self._commands.items():
            while under_way and (why := verdict(name, under_way[0][1])) is not None:
                request, _ = under_way.popleft()
                if why:
                    self.answers.append(Refused(request.ticket, RefusalCode.FAILED, f"{name} failed: {why}"))
                else:
                    self.answers.append(CommandDone(request.ticket, name, mode, cycle))


def _refused(text: str, user: str, refused: Refused) -> Notice:
    return _with_code(Notice("refused", "warning", text, user=user, event_code=EventCode.REFUSED), refused)


def _with_code(notice: Notice, refused: Refused) -> Notice:
    """Return the notice with the fields of the refusal added."""
    about = {name: getattr(refused, name) for name in ("code", "slider", "value", "limit")}
    return structs.replace(notice, **about)


def _not_renewed(goal_id: str, refusal: str) -> RefusedError:
    """Return the error for a renewal of a goal that was not renewed in time, or that a refused renewal has ended."""
    if refusal:
        text = f"goal {goal_id!r} has ended because a renewal was refused ({refusal}); start a new goal"
        return RefusedError(RefusalCode.JOG_OVER, text)
    return RefusedError(
        RefusalCode.JOG_OVER, f"goal {goal_id!r} was not renewed in time and has ended: start a new goal"
    )
