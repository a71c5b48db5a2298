"""Goals that wait in the gateway: the loop has only a few at once, and what it has not been given can be withdrawn."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import NamedTuple

from msgspec import structs

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.fairness import FairQueue
from trirail.processes.incoming import Incoming
from trirail.wire.packets import GoalRequest
from trirail.wire.sizes import MAX_UNREAD

MOST = 5_000
"""Goals that may wait for those before them; beyond that they are refused."""
MOST_OF_ONE = 1_250
"""Of them those of one user: the others have room whatever he sends."""
PATIENCE = 8.0
"""A goal that has waited longer for those before it does not begin any more: its sender gives up soon [s]."""


class WaitingGoal(NamedTuple):
    """A goal, and the message that it came in, without its payload."""

    incoming: Incoming
    request: GoalRequest


class Backlog:
    """Goals by user, each user's in the order in which they came, bounded in number and in bytes; users take turns.

    Each goal leaves it exactly once, by `drop_first`: one that is withdrawn keeps its place, and the loop tells of
    its end in its turn.
    """

    def __init__(self) -> None:
        self._goals: FairQueue[WaitingGoal] = FairQueue()
        self._bytes = 0
        self._stop = 0, ""
        self._stopped: dict[str, tuple[int, str]] = {}
        """By id, before which message a goal was told to stop that may not be read yet, and why; the newest last."""

    def __iter__(self) -> Iterator[WaitingGoal]:
        return iter(self._goals)

    @property
    def users(self) -> list[str]:
        """Who has goals in it, in the order of their turns."""
        return list(self._goals.users)

    def check_room(self, user: str, size: int) -> None:
        """Raise RefusedError if there is no room for one more goal of so many bytes."""
        own = self._goals.of(user)
        if own >= MOST_OF_ONE:
            raise RefusedError(RefusalCode.BUSY, f"{own} goals of {user} are waiting already: send fewer")
        if len(self._goals) >= MOST or self._bytes + size > MAX_UNREAD:
            raise RefusedError(RefusalCode.BUSY, f"{len(self._goals)} goals are waiting already: send fewer")

    def add(self, incoming: Incoming, request: GoalRequest) -> None:
        """Put a goal behind the user's others; withdrawn where it had come before the robot was told to stop."""
        for before, reason in (self._stop, self._stopped.get(request.id, (0, ""))):
            if incoming.number < before:
                request = structs.replace(request, withdrawn=reason)
        self._goals.put(request.user, WaitingGoal(incoming._replace(payload=b""), request))
        self._bytes += incoming.size

    def first(self, user: str) -> WaitingGoal:
        """Return the goal of a user whose turn it is; one that has waited too long is withdrawn. KeyError for none."""
        incoming, request = self._goals.first(user)
        if request.withdrawn is None and time.monotonic_ns() - request.received_ns > PATIENCE * 1e9:
            reason = f"too many goals before it: it has waited longer than {PATIENCE:g} s"
            request = structs.replace(request, withdrawn=reason)
        return WaitingGoal(incoming, request)

    def drop_first(self, user: str) -> None:
        """Let go of the user's first: the loop has it."""
        self._bytes -= self._goals.pop(user).incoming.size

    def withdraw(self, goal_id: str, reason: str) -> bool:
        """Withdraw the goal of an id; whether there is one."""
        found = any(goal.request.id == goal_id for goal in self._goals)
        if found:
            self._goals.change(lambda goal: _withdrawn(goal, reason) if goal.request.id == goal_id else goal)
        return found

    def withdraw_coming(self, goal_id: str, reason: str, before: int) -> None:
        """Withdraw the goal of an id where it is read after this, and had come before a message."""
        self._stopped.pop(goal_id, None)
        self._stopped[goal_id] = before, reason
        if len(self._stopped) > MOST:
            del self._stopped[next(iter(self._stopped))]

    def withdraw_all(self, reason: str, before: int) -> None:
        """Withdraw every goal that came before a message, those as well that are read after it."""
        if before >= self._stop[0]:  # one that came earlier may be read later
            self._stop = before, reason
        self._goals.change(lambda goal: _withdrawn(goal, reason) if goal.incoming.number < before else goal)

    def withdraw_others(self, user: str | None, reason: str) -> None:
        """Withdraw every goal but a user's."""
        self._goals.change(lambda goal: goal if goal.request.user == user else _withdrawn(goal, reason))


def _withdrawn(goal: WaitingGoal, reason: str) -> WaitingGoal:
    """Return a goal as one that does not begin any more; for the first reason that there was."""
    request = goal.request
    return goal if request.withdrawn else goal._replace(request=structs.replace(request, withdrawn=reason))
