"""What has come to the gateway and waits there: messages before they are decoded, and goals. Users take turns.

The loop has only a few goals at once: what it has not been given can be withdrawn.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, KeysView
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import zenoh
from msgspec import structs

from trirail.errors import RefusalCode, RefusedError
from trirail.wire import boundary
from trirail.wire.packets import GoalRequest
from trirail.wire.sizes import MAX_UNREAD

Kind = Literal["goal", "cmd", "info", "role", "poses", "teach", "forget", "alignment"]


class Incoming(NamedTuple):
    """A query or a put, as Zenoh handed it over, or a request at the door for stops."""

    kind: Kind
    key: str
    """As it was sent: it may have wildcards."""
    size: int
    """Of the payload [bytes]."""
    payload: bytes
    """Empty where it is larger than is decoded."""
    encoding: str
    query: zenoh.Query | None
    """None for a put, which has no answer, and for a request at the door."""
    arrived_ns: int
    """When it came, by the monotonic clock: it may have waited since, behind its user's others."""
    number: int = 0
    """Messages are numbered as they come."""
    id: str = ""
    """Of a stop: the same in every copy of it; "" where it has none."""
    at_door: Callable[[Any], None] | None = None
    """Of a request at the door: takes its answer."""
    alike: tuple[Incoming, ...] = ()
    """Stops of the same user, kind and content that came behind it before it was read: one is carried out for all."""

    @property
    def user(self) -> str:
        """Who is said to have sent it; "" for what names nobody."""
        return self.key.split("/")[3] if self.key.count("/") > 2 else ""

    def content(self, kind: Any, what: str) -> Any:
        """Return its payload as a message of that kind, a type or union. Raises RefusedError, beginning with `what`."""
        boundary.check_size(self.size)
        return boundary.decode(self.payload, kind, what, self.encoding)

    def unanswered(self) -> Incoming:
        """Return it as one that nobody waits for an answer to."""
        return self._replace(query=None, at_door=None, alike=())


BURST = 400
"""Messages of one user that are read as soon as it is his turn."""
RATE = 200.0
"""Messages of one user that are read a second beyond that: ten times what a stream of goals or a held jog sends."""
_FORGOTTEN = 1000
"""With so many users those are forgotten who have their whole burst again."""


class Pace:
    """A token bucket for each user, as the generic cell rate algorithm keeps it: one moment instead of a count."""

    def __init__(self, burst: int = BURST, rate: float = RATE) -> None:
        self._burst, self._rate = burst, rate
        self._full_at: dict[str, float] = {}
        """When each user's bucket is full again, in seconds of the caller's clock."""

    def wait(self, user: str, now: float) -> float:
        """Return how long it is until a user's next message may be read; 0 where it may be now [s]."""
        # Half a message less than the burst: a sum of so many fractions does not end at a whole one.
        return max(0.0, self._full_at.get(user, -math.inf) - now - (self._burst - 0.5) / self._rate)

    def count(self, user: str, now: float) -> None:
        """Note that a message of a user has been read."""
        self._full_at[user] = max(self._full_at.get(user, now), now) + 1.0 / self._rate
        if len(self._full_at) > _FORGOTTEN:
            self._full_at = {user: full for user, full in self._full_at.items() if full > now}


T = TypeVar("T")


class FairQueue(Generic[T]):
    """Round robin: who has been served goes behind the others; who comes anew begins behind them."""

    def __init__(self) -> None:
        self._of: dict[str, deque[T]] = {}  # the users in the order of their turns, none without anything
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[T]:
        for waiting in self._of.values():
            yield from waiting

    @property
    def users(self) -> KeysView[str]:
        """Who has something in it, in the order of their turns; not to be looked through while it changes."""
        return self._of.keys()

    def of(self, user: str) -> int:
        """Return how much of it is a user's."""
        return len(self._of.get(user, ()))

    def put(self, user: str, item: T) -> None:
        """Put something behind the user's own."""
        self._of.setdefault(user, deque()).append(item)
        self._length += 1

    def first(self, user: str) -> T:
        """Return the user's first; KeyError where there is none."""
        return self._of[user][0]

    def pop(self, user: str) -> T:
        """Take the first of a user, who goes behind the others; KeyError where there is none."""
        waiting = self._of.pop(user)
        item = waiting.popleft()
        self._length -= 1
        if waiting:
            self._of[user] = waiting
        return item

    def change(self, make: Callable[[T], T]) -> None:
        """Put something else in the place of each."""
        self._of = {user: deque(map(make, waiting)) for user, waiting in self._of.items()}


GOALS = 5_000
"""Goals that may wait for those before them; beyond that they are refused."""
GOALS_OF_ONE = 1_250
"""Of them those of one user: the others have room whatever he sends."""
GOAL_PATIENCE = 8.0
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
        if own >= GOALS_OF_ONE:
            raise RefusedError(RefusalCode.BUSY, f"{own} goals of {user} are waiting already: send fewer")
        if len(self._goals) >= GOALS or self._bytes + size > MAX_UNREAD:
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
        if request.withdrawn is None and time.monotonic_ns() - request.received_ns > GOAL_PATIENCE * 1e9:
            waited = f"it has waited longer than {GOAL_PATIENCE:g} s"
            reason = f"{waited}, for goals before it or a busy machine: send it again"
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
        if len(self._stopped) > GOALS:
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
