"""Queues of the gateway for messages that are not decoded yet and goals that the loop does not have yet.

Users take turns. The gateway sends the loop only a few goals at a time, so that it can withdraw the others itself.
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
    """Query or put as received from Zenoh, or a request at the stop port."""

    kind: str
    """Kind, a key of trirail.processes.gateway.ROUTES."""
    key: str
    """Key expression of the message; it may have wildcards."""
    size: int
    """Size of the payload [bytes]."""
    payload: bytes
    """Payload; empty if it is too large to be decoded."""
    encoding: str
    query: zenoh.Query | None
    """Query to answer; None for a put and for a request at the stop port."""
    arrived_ns: int
    """Arrival time on the monotonic clock [ns]."""
    number: int = 0
    """Sequence number in the order of arrival."""
    id: str = ""
    """Id of a stop, the same in all of its copies; "" for none."""
    at_door: Callable[[Any], None] | None = None
    """Receiver of the answer to a request at the stop port."""
    held: int = 0
    """Memory that the message holds in Zenoh and in this process: payload, key, parameters and attachment [bytes]."""
    hold: Reservation | None = None
    """Reservation of that memory; None for a message that is not kept."""
    alike: tuple[Incoming, ...] = ()
    """Equal stops of the same user that were merged into this one, which is carried out once for all of them."""

    @property
    def user(self) -> str:
        """User named by the key; "" without one, and for a query about a role, whose key may name any user."""
        return self.key.split("/")[3] if self.kind != "role" and self.key.count("/") > 2 else ""

    def content(self, kind: Any, what: str) -> Any:
        """Return the payload decoded as a type or union `kind`.

        Raises RefusedError, with a message that begins with `what`.
        """
        boundary.check_size(self.size)
        return boundary.decode(self.payload, kind, what, self.encoding)

    def unanswered(self) -> Incoming:
        """Return a copy of the message that will not be answered."""
        return self._replace(query=None, at_door=None, alike=(), held=len(self.payload) + OVERHEAD)


BURST = 400
"""Number of one user's messages that may be read in a burst."""
RATE = 200.0
"""Rate at which one user's messages are read after a burst [1/s]; ten times that of a stream of goals or a jog."""
_MAX_BUCKETS = 1000
"""Number of users above which full buckets are forgotten."""


class Pace:
    """Token bucket for each user, as in the generic cell rate algorithm; it stores a time instead of a count."""

    def __init__(self, burst: int = BURST, rate: float = RATE) -> None:
        self._burst, self._rate = burst, rate
        self._full_at: dict[str, float] = {}
        """Time at which each user's bucket is full again, in seconds of the caller's clock."""

    def wait(self, user: str, now: float) -> float:
        """Return the time until a user's next message may be read; 0 if it may be now [s]."""
        # Half a message less than the burst: a sum of that many fractions does not end at a whole one.
        return max(0.0, self._full_at.get(user, -math.inf) - now - (self._burst - 0.5) / self._rate)

    def count(self, user: str, now: float) -> None:
        """Take a token from the bucket of a user whose message has been read."""
        self._full_at[user] = max(self._full_at.get(user, now), now) + 1.0 / self._rate
        if len(self._full_at) > _MAX_BUCKETS:
            self._full_at = {user: full for user, full in self._full_at.items() if full > now}


T = TypeVar("T")


class FairQueue(Generic[T]):
    """Round-robin queue: a served user moves behind the others, and a new user joins behind them."""

    def __init__(self) -> None:
        self._queues: dict[str, deque[T]] = {}  # in the order of the users' turns, without empty queues
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[T]:
        for waiting in self._queues.values():
            yield from waiting

    @property
    def users(self) -> KeysView[str]:
        """Users with items, in the order of their turns: a view that must not be iterated while the queue changes."""
        return self._queues.keys()

    def count(self, user: str) -> int:
        """Return the number of a user's items."""
        return len(self._queues.get(user, ()))

    def put(self, user: str, item: T) -> None:
        """Append an item to those of its user."""
        self._queues.setdefault(user, deque()).append(item)
        self._length += 1

    def first(self, user: str) -> T:
        """Return the user's first item. Raises KeyError if there is none."""
        return self._queues[user][0]

    def pop(self, user: str) -> T:
        """Remove and return the first item of a user, and move the user behind the others. Raises KeyError."""
        waiting = self._queues.pop(user)
        item = waiting.popleft()
        self._length -= 1
        if waiting:
            self._queues[user] = waiting
        return item

    def change(self, make: Callable[[T], T]) -> None:
        """Replace each item."""
        self._queues = {user: deque(map(make, waiting)) for user, waiting in self._queues.items()}


GOALS = 5_000
"""Maximum number of waiting goals; more are refused."""
GOALS_OF_ONE = 1_250
"""Maximum number of one user's waiting goals; it leaves room for other users."""
GOAL_PATIENCE = 8.0
"""Longest time that a goal waits for those before it [s]; it is then withdrawn, as its sender gives up soon after."""


class WaitingGoal(NamedTuple):
    """A goal and the message that contained it, without the payload."""

    incoming: Incoming
    request: GoalRequest


class Backlog:
    """Queue of goals, bounded in number and in bytes. A user's goals keep their order of arrival; users take turns.

    Each goal leaves the queue exactly once, by `drop_first`. A withdrawn goal keeps its place, so that the loop reports
    its end in the right order.
    """

    def __init__(self) -> None:
        self._goals: FairQueue[WaitingGoal] = FairQueue()
        self._bytes = 0
        self._stop = 0, ""
        self._stopped: dict[str, tuple[int, str]] = {}
        """Stops of single goals, by goal id, the newest last: the number of the stop's message, and the reason."""

    def __iter__(self) -> Iterator[WaitingGoal]:
        return iter(self._goals)

    @property
    def users(self) -> list[str]:
        """Users with waiting goals, in the order of their turns."""
        return list(self._goals.users)

    def check_room(self, user: str, size: int) -> None:
        """Raise RefusedError if there is no room for another goal of this size [bytes]."""
        own = self._goals.count(user)
        if own >= GOALS_OF_ONE:
            raise RefusedError(
                RefusalCode.BUSY, f"{own} goals of {user} are already waiting, which is the maximum: send fewer goals"
            )
        if len(self._goals) >= GOALS or self._bytes + size > MAX_UNREAD:
            raise RefusedError(RefusalCode.BUSY, f"too many goals are waiting ({len(self._goals)}): send fewer goals")

    def add(self, incoming: Incoming, request: GoalRequest) -> None:
        """Enqueue a goal behind the user's others, withdrawn if it arrived before a stop that applies to it."""
        for before, reason in (self._stop, self._stopped.get(request.id, (0, ""))):
            if incoming.number < before:
                request = structs.replace(request, withdrawn=reason)
        self._goals.put(request.user, WaitingGoal(incoming._replace(payload=b""), request))
        self._bytes += incoming.size

    def first(self, user: str) -> WaitingGoal:
        """Return the next goal of a user, withdrawn if it has waited too long. Raises KeyError if there is none."""
        incoming, request = self._goals.first(user)
        if request.withdrawn is None and time.monotonic_ns() - request.received_ns > GOAL_PATIENCE * 1e9:
            waited = f"the goal waited longer than {GOAL_PATIENCE:g} s"
            reason = f"{waited} for earlier goals or because the machine was busy: send the goal again"
            request = structs.replace(request, withdrawn=reason)
        return WaitingGoal(incoming, request)

    def drop_first(self, user: str) -> None:
        """Remove the user's first goal, which has been sent to the loop."""
        self._bytes -= self._goals.pop(user).incoming.size

    def withdraw(self, goal_id: str, reason: str) -> bool:
        """Withdraw the goal with this id; return whether it was waiting."""
        is_waiting = any(goal.request.id == goal_id for goal in self._goals)
        if is_waiting:
            self._goals.change(lambda goal: _withdrawn(goal, reason) if goal.request.id == goal_id else goal)
        return is_waiting

    def withdraw_coming(self, goal_id: str, reason: str, before: int) -> None:
        """Withdraw the goal with this id if it is read later, and arrived before the message numbered `before`."""
        self._stopped.pop(goal_id, None)
        self._stopped[goal_id] = before, reason
        if len(self._stopped) > GOALS:
            del self._stopped[next(iter(self._stopped))]

    def withdraw_all(self, reason: str, before: int) -> None:
        """Withdraw every goal that arrived before the message numbered `before`, including those read later."""
        if before >= self._stop[0]:  # stops may be read in another order than they arrived
            self._stop = before, reason
        self._goals.change(lambda goal: _withdrawn(goal, reason) if goal.incoming.number < before else goal)

    def withdraw_others(self, user: str | None, reason: str) -> None:
        """Withdraw the goals of all other users."""
        self._goals.change(lambda goal: goal if goal.request.user == user else _withdrawn(goal, reason))


def _withdrawn(goal: WaitingGoal, reason: str) -> WaitingGoal:
    """Return a goal as withdrawn; the first reason is kept."""
    request = goal.request
    return goal if request.withdrawn else goal._replace(request=structs.replace(request, withdrawn=reason))
