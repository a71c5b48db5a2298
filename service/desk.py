"""Who asked for what, and what became of it: every goal ends once, every command is answered once."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from service.errors import RefusedError
from service.messages import Level, Outcome, VelocityGoal
from service.packets import Accepted, Answer, CommandRequest, Confirmed, GoalRequest, Refused, RefusedRequest, Request

REMEMBERED_IDS = 10_000
"""Goals whose ids may not be used again; older ones are forgotten."""


class Happening(NamedTuple):
    """Something to tell everyone, in the order in which it happened."""

    kind: str
    level: Level
    message: str
    mode: str | None = None
    id: str | None = None
    outcome: Outcome | None = None
    user: str | None = None


class Goal(NamedTuple):
    """The goal that the robot is moving to."""

    id: str
    user: str
    is_jog: bool


class Desk:
    """Keeps the running goal and the commands under way; what it has to say waits in `answers` and `happenings`."""

    def __init__(self) -> None:
        self.goal: Goal | None = None
        self.answers: list[Answer] = []
        self.happenings: list[Happening] = []
        self._commands: list[tuple[CommandRequest, int]] = []
        self._ended: dict[str, None] = {}

    # ------------------------------------------------------------------ goals

    def check_id(self, request: GoalRequest) -> None:
        """Raise RefusedError if the id has been used; a jog's own velocities share one."""
        goal_id = request.id
        running = self.goal is not None and self.goal.id == goal_id
        fresh = running and self.goal is not None and self.goal.is_jog and isinstance(request.goal, VelocityGoal)
        if goal_id in self._ended or (running and not fresh):
            raise RefusedError("duplicate_id", f"goal id {goal_id!r} has been used: every goal needs its own")

    def begin(self, request: GoalRequest, duration: float) -> None:
        """Accept a goal; the one before is preempted, unless this is the same one afresh."""
        self.answers.append(Accepted(request.ticket, request.id, duration))
        if self.goal is not None and self.goal.id == request.id:
            return
        self.end("preempted", f"preempted by goal {request.id}")
        self.goal = Goal(request.id, request.user, isinstance(request.goal, VelocityGoal))

    def end(self, outcome: Outcome, reason: str) -> None:
        """End the running goal, if there is one."""
        if self.goal is not None:
            goal, self.goal = self.goal, None
            self._ending(goal.id, goal.user, outcome, reason, "error" if outcome == "faulted" else "info")

    def refuse(self, request: Request, refusal: RefusedError) -> None:
        """Answer that a request is not carried out. A goal that is refused has ended; a used id has its own ending."""
        if isinstance(request, RefusedRequest):
            return
        text = str(refusal)
        self.answers.append(Refused(request.ticket, refusal.code, text, refusal.slider, refusal.value, refusal.limit))
        if isinstance(request, CommandRequest):
            self.tell("refused", "warning", f"{request.name} refused: {text}", user=request.user)
        elif refusal.code == "duplicate_id":
            self.tell("refused", "warning", text, user=request.user)
        else:
            outcome: Outcome = "expired" if refusal.code == "expired" else "rejected"
            self._ending(request.id, request.user, outcome, text, "warning")

    def _ending(self, goal_id: str, user: str, outcome: Outcome, reason: str, level: Level) -> None:
        self._ended[goal_id] = None
        if len(self._ended) > REMEMBERED_IDS:
            del self._ended[next(iter(self._ended))]
        self.tell("goal", level, f"goal {goal_id} {outcome}: {reason}", id=goal_id, outcome=outcome, user=user)

    # ------------------------------------------------------------------ commands

    def undertake(self, request: CommandRequest, cycle: int) -> None:
        """Take a command on; it is answered once it has been carried out."""
        self._commands.append((request, cycle))

    def settle(self, verdict: Callable[[str, int], str | None], mode: str) -> None:
        """Answer the commands that are done or never will be.

        `verdict`, given a command's name and the cycle it came in, is "" for done, None for not yet, else why not.
        """
        still = []
        for request, since in self._commands:
            why = verdict(request.name, since)
            if why is None:
                still.append((request, since))
            elif why:
                self.answers.append(Refused(request.ticket, "failed", f"{request.name} failed: {why}"))
            else:
                self.answers.append(Confirmed(request.ticket, request.name, mode))
        self._commands = still

    # ------------------------------------------------------------------ everyone

    def tell(
        self,
        kind: str,
        level: Level,
        message: str,
        *,
        mode: str | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
        outcome: Outcome | None = None,
        user: str | None = None,
    ) -> None:
        """Note something that everyone is to know."""
        self.happenings.append(Happening(kind, level, message, mode, id, outcome, user))
