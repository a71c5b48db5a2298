"""Goals that wait in the gateway: the loop has only a few at once, and what it has not been given can be withdrawn."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from msgspec import structs

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.inbox import Incoming
from trirail.wire.packets import GoalRequest
from trirail.wire.sizes import MAX_UNREAD

MOST = 5_000
"""Goals that may wait for those before them; beyond that they are refused."""
PATIENCE = 8.0
"""A goal that has waited longer for those before it does not begin any more: its sender gives up soon [s]."""


class WaitingGoal(NamedTuple):
    """A goal, and the message that it came in, without its payload."""

    incoming: Incoming
    request: GoalRequest


class Backlog:
    """Goals in the order in which they came, bounded in number and in bytes; each leaves it exactly once, by `take`.

    A goal that is withdrawn keeps its place: the loop tells of its end in its turn.
    """

    def __init__(self) -> None:
        self._goals: deque[WaitingGoal] = deque()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._goals)

    def __iter__(self) -> Iterator[WaitingGoal]:
        return iter(self._goals)

    def check_room(self, size: int) -> None:
        """Raise RefusedError if there is no room for one more goal of so many bytes."""
        if len(self._goals) >= MOST or self._bytes + size > MAX_UNREAD:
            raise RefusedError(RefusalCode.BUSY, f"{len(self._goals)} goals are waiting already: send fewer")

    def add(self, incoming: Incoming, request: GoalRequest) -> None:
        """Put a goal behind the others."""
        self._goals.append(WaitingGoal(incoming._replace(payload=b""), request))
        self._bytes += incoming.size

    def first(self) -> WaitingGoal | None:
        """Return the goal whose turn it is, None where none waits; one that has waited too long is withdrawn."""
        if not self._goals:
            return None
        incoming, request = self._goals[0]
        if request.withdrawn is None and time.monotonic_ns() - request.received_ns > PATIENCE * 1e9:
            reason = f"too many goals before it: it has waited longer than {PATIENCE:g} s"
            request = structs.replace(request, withdrawn=reason)
        return WaitingGoal(incoming, request)

    def take(self) -> None:
        """Let go of the first: the loop has it."""
        self._bytes -= self._goals.popleft().incoming.size

    def withdraw(self, goal_id: str, reason: str) -> bool:
        """Withdraw the first goal of an id; whether there is one."""
        for number, (incoming, request) in enumerate(self._goals):
            if request.id == goal_id:
                self._goals[number] = WaitingGoal(incoming, structs.replace(request, withdrawn=reason))
                return True
        return False

    def withdraw_all(self, reason: str) -> None:
        """Withdraw every goal."""
        self._goals = deque(
            WaitingGoal(incoming, structs.replace(request, withdrawn=reason)) for incoming, request in self._goals
        )
