"""Messages that wait in the gateway before they are decoded, and goals. Users take turns.

The loop has only a few goals at a time: those not given to it yet can be withdrawn.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, KeysView
from typing import Any, Generic, NamedTuple, TypeVar

import zenoh
from msgspec import structs

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.memory_budget import OVERHEAD, Reservation
from trirail.wire import boundary
from trirail.wire.packets import GoalRequest
from trirail.wire.sizes import MAX_UNREAD


class Incoming(NamedTuple):
    """A query or a put, as Zenoh handed it over, or a request at the door for stops."""

    kind: str
    """Its key in trirail.processes.gateway.ROUTES."""
    key: str
    """Key expression that was sent: it may have wildcards."""
    size: int
    """Size of the payload [bytes]."""
    payload: bytes
    """Empty if it is too large to be decoded."""
    encoding: str
    query: zenoh.Query | None
    """None for a put, which has no answer, and for a request at the door."""
    arrived_ns: int
    """Arrival time on the monotonic clock: it may have waited since, behind its user's others."""
    number: int = 0
    """Sequence number, in the order of arrival."""
    id: str = ""
    """Id of a stop: the same in every copy of it, "" if it has none."""
    at_door: Callable[[Any], None] | None = None
    """Receiver of the answer to a request at the door."""
    held: int = 0
    """Memory that it holds in Zenoh and in this process: payload, key, parameters and attachment [bytes]."""
    hold: Reservation | None = None
    """Reservation of that memory; None for a message that is not kept."""
    alike: tuple[Incoming, ...] = ()
    """Stops of the same user, kind and content that came behind it before it was read: one is carried out for all."""

    @property
    def user(self) -> str:
        """User that its key names; "" for a message that names none or any, such as a query for a role."""
        return self.key.split("/")[3] if self.kind != "role" and self.key.count("/") > 2 else ""

    def content(self, kind: Any, what: str) -> Any:
        """Return its payload as a message of that kind, a type or union. Raises RefusedError, beginning with `what`."""
        boundary.check_size(self.size)
        return boundary.decode(self.payload, kind, what, self.encoding)

    def unanswered(self) -> Incoming:
        """Return it as a message without an answer."""
        return self._replace(query=None, at_door=None, alike=(), held=len(self.payload) + OVERHEAD)


BURST = 400
"""Messages of one user that are read without a pause."""
RATE = 200.0
"""Messages of one user that are read a second beyond that: ten times those of a stream of goals or a held jog."""
_FORGOTTEN = 1000
"""Number of users from which those with a full bucket are forgotten."""


class Pace:
    """Token bucket for each user, in the form of the generic cell rate algorithm: one time instead of a count."""

    def __init__(self, burst: int = BURST, rate: float = RATE) -> None:
        self._burst, self._rate = burst, rate
        self._full_at: dict[str, float] = {}
        """Time at which each user's bucket is full again, in seconds of the caller's clock."""

    def wait(self, user: str, now: float) -> float:
        """Return the time until a user's next message may be read; 0 if it may be now [s]."""
        # Half a message less than the burst: a sum of that many fractions does not end at a whole one.
        return max(0.0, self._full_at.get(user, -math.inf) - now - (self._burst - 0.5) / self._rate)

    def count(self, user: str, now: float) -> None:
        """Count a message of a user that has been read."""
        self._full_at[user] = max(self._full_at.get(user, now), now) + 1.0 / self._rate
        if len(self._full_at) > _FORGOTTEN:
            self._full_at = {user: full for user, full in self._full_at.items() if full > now}


T = TypeVar("T")


class FairQueue(Generic[T]):
    """Round-robin queue: a user served goes behind the others; a new one begins behind them."""

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
        """Users with items in it, in the order of their turns; not to be iterated while it changes."""
        return self._of.keys()

    def of(self, user: str) -> int:
        """Return the number of a user's items."""
        return len(self._of.get(user, ()))

    def put(self, user: str, item: T) -> None:
        """Put an item behind the user's own."""
        self._of.setdefault(user, deque()).append(item)
        self._length += 1

    def first(self, user: str) -> T:
        """Return the user's first item; KeyError if there is none."""
        return self._of[user][0]

    def pop(self, user: str) -> T:
        """Remove the first item of a user, and put the user behind the others; KeyError if there is none."""
        waiting = self._of.pop(user)
        item = waiting.popleft()
        self._length -= 1
        if waiting:
            self._of[user] = waiting
        return item

    def change(self, make: Callable[[T], T]) -> None:
        """Replace each item."""
        self._of = {user: deque(map(make, waiting)) for user, waiting in self._of.items()}


GOALS = 5_000
"""Most goals that wait for those before them; more are refused."""
GOALS_OF_ONE = 1_250
"""Most waiting goals of one user, so that others always have room."""
GOAL_PATIENCE = 8.0
"""Longest wait of a goal for those before it; then it does not begin any more: its sender gives up soon [s]."""


class WaitingGoal(NamedTuple):
    """A goal, and the message that it came in, without its payload."""

    incoming: Incoming
    request: GoalRequest


class Backlog:
    """Goals by user, each user's in the order of arrival, bounded in number and in bytes; users take turns.

    Each goal leaves it exactly once, by `drop_first`: a withdrawn one keeps its place, and the loop reports its end in
    its turn.
    """

    def __init__(self) -> None:
        self._goals: FairQueue[WaitingGoal] = FairQueue()
        self._bytes = 0
        self._stop = 0, ""
        self._stopped: dict[str, tuple[int, str]] = {}
        """Stops by id of goals that may be unread: the message before which they apply, and why; the newest last."""

    def __iter__(self) -> Iterator[WaitingGoal]:
        return iter(self._goals)

    @property
    def users(self) -> list[str]:
        """Users with goals in it, in the order of their turns."""
        return list(self._goals.users)

    def check_room(self, user: str, size: int) -> None:
        """Raise RefusedError if there is no room for one more goal of that size."""
        own = self._goals.of(user)
        if own >= GOALS_OF_ONE:
            raise RefusedError(RefusalCode.BUSY, f"{own} goals of {user} are waiting already: send fewer")
        if len(self._goals) >= GOALS or self._bytes + size > MAX_UNREAD:
            raise RefusedError(RefusalCode.BUSY, f"{len(self._goals)} goals are waiting already: send fewer")

    def add(self, incoming: Incoming, request: GoalRequest) -> None:
        """Put a goal behind the user's others; withdrawn if it arrived before the robot was stopped."""
        for before, reason in (self._stop, self._stopped.get(request.id, (0, ""))):
            if incoming.number < before:
                request = structs.replace(request, withdrawn=reason)
        self._goals.put(request.user, WaitingGoal(incoming._replace(payload=b""), request))
        self._bytes += incoming.size

    def first(self, user: str) -> WaitingGoal:
        """Return the next goal of a user; one that has waited too long is withdrawn. KeyError if there is none."""
        incoming, request = self._goals.first(user)
        if request.withdrawn is None and time.monotonic_ns() - request.received_ns > GOAL_PATIENCE * 1e9:
            waited = f"it has waited longer than {GOAL_PATIENCE:g} s"
            reason = f"{waited}, for goals before it or a busy machine: send it again"
            request = structs.replace(request, withdrawn=reason)
        return WaitingGoal(incoming, request)

    def drop_first(self, user: str) -> None:
        """Remove the user's first goal: the loop has it."""
        self._bytes -= self._goals.pop(user).incoming.size

    def withdraw(self, goal_id: str, reason: str) -> bool:
        """Withdraw the goal with an id; return whether there is one."""
        found = any(goal.request.id == goal_id for goal in self._goals)
        if found:
            self._goals.change(lambda goal: _withdrawn(goal, reason) if goal.request.id == goal_id else goal)
        return found

    def withdraw_coming(self, goal_id: str, reason: str, before: int) -> None:
        """Withdraw the goal with an id if it is read later, and arrived before a message."""
        self._stopped.pop(goal_id, None)
        self._stopped[goal_id] = before, reason
        if len(self._stopped) > GOALS:
            del self._stopped[next(iter(self._stopped))]

    def withdraw_all(self, reason: str, before: int) -> None:
        """Withdraw every goal that arrived before a message, including those read later."""
        if before >= self._stop[0]:  # one that came earlier may be read later
            self._stop = before, reason
        self._goals.change(lambda goal: _withdrawn(goal, reason) if goal.incoming.number < before else goal)

    def withdraw_others(self, user: str | None, reason: str) -> None:
        """Withdraw the goals of all other users."""
        self._goals.change(lambda goal: goal if goal.request.user == user else _withdrawn(goal, reason))


def _withdrawn(goal: WaitingGoal, reason: str) -> WaitingGoal:
    """Return a goal as withdrawn; the first reason stays."""
    request = goal.request
    return goal if request.withdrawn else goal._replace(request=structs.replace(request, withdrawn=reason))
