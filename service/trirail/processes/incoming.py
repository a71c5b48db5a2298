"""Queues of the gateway, for messages that have not been decoded and for goals that have not been sent to the loop.

Users take turns. The gateway sends only a few goals to the loop at a time, so that it can withdraw the other goals
itself.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, KeysView
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec
import zenoh
from msgspec import structs

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.memory_budget import OVERHEAD, Reservation
from trirail.wire import boundary
from trirail.wire.call_mark import CallMark
from trirail.wire.packets import GoalRequest
from trirail.wire.sizes import MAX_UNREAD


class StopPair:
    """Stop with an id, and its copy, which the client sends on the other channel: Zenoh or the stop port."""

    def __init__(self, at_port: bool, copy_within: float) -> None:
        self.at_port = at_port
        """Whether the first of the two has arrived at the stop port."""
        self.copy_within = copy_within
        """Time after the reply within which the copy may arrive [s]."""
        self.answer: msgspec.Struct | None = None
        """Reply to both; None until the stop is answered."""
        self.answered_at = math.inf
        self.copy: Incoming | None = None
        """Copy that waits for the reply."""


class Incoming(NamedTuple):
    """Query or put that was received from Zenoh, or request that was received at the stop port."""

    kind: str
    """Kind of message, which is a key of trirail.processes.gateway.ROUTES."""
    key: str
    """Key expression of the message, which may contain wildcards."""
    size: int
    """Size of the payload [bytes]."""
    payload: bytes
    """Payload of the message; empty if the payload is too large to be decoded."""
    encoding: str
    query: zenoh.Query | None
    """Query to answer; None for a put and for a request at the stop port."""
    arrived_ns: int
    """Arrival time on the monotonic clock [ns]."""
    number: int = 0
    """Sequence number in the order of arrival."""
    mark: CallMark | None = None
    """Call for which the client has sent the message; None if the message is not marked."""
    id: str = ""
    """Id of a stop, which is the same in both copies of the stop; "" if the message has no id."""
    at_door: Callable[[Any], None] | None = None
    """Function that sends the answer to a request at the stop port; None for messages from Zenoh."""
    held: int = 0
    """Memory that the message occupies in Zenoh and in this process: payload, key, parameters, attachment [bytes]."""
    hold: Reservation | None = None
    """Reservation of the memory `held`; None if the message is not in the inbox."""
    alike: tuple[Incoming, ...] = ()
    """Equal stops of the same user that were merged into this stop. The stop is carried out once for all of them."""
    pair: StopPair | None = None
    """Pair to which a stop with an id belongs, from when the stop is carried out."""

    @property
    def user(self) -> str:
        """User that the key names; "" if the key names no user.

        It is also "" for a query about a role, because the key of such a query may name any user.
        """
        return self.key.split("/")[3] if self.kind != "role" and self.key.count("/") > 2 else ""

    def content(self, kind: Any, what: str) -> Any:
        """Decode the payload as the type or union `kind`.

        Raises RefusedError with a message that begins with `what`, if the payload is invalid.
        """
        boundary.check_size(self.size)
        return boundary.decode(self.payload, kind, what, self.encoding)

    def check_age(self) -> None:
        """Raise RefusedError if the message has waited too long, so that its sender may no longer expect its effect."""
        if time.monotonic_ns() - self.arrived_ns > MAX_COMMAND_WAIT * 1e9:
            raise RefusedError(
                RefusalCode.TIMEOUT,
                f"not carried out: it waited longer than {MAX_COMMAND_WAIT:g} s for earlier messages or because the "
                "machine was busy: send it again",
            )

    def unanswered(self) -> Incoming:
        """Return a copy of the message that will not be answered."""
        return self._replace(query=None, at_door=None, alike=(), pair=None, held=len(self.payload) + OVERHEAD)


MAX_COMMAND_WAIT = 2.0
"""Maximum time that a command waits for earlier messages [s], except stops and renewals of the lease."""
BURST = 400
"""Number of messages of one user that may be read in a burst."""
RATE = 200.0
"""Rate at which messages of one user are read after a burst [1/s], ten times that of a jog or a stream of goals."""
_MAX_BUCKETS = 1000
"""Number of users above which the full buckets are deleted."""


class Pace:
    """Rate limiter with a token bucket per user, stored as a time as in the generic cell rate algorithm."""

    def __init__(self, burst: int = BURST, rate: float = RATE) -> None:
        self._burst, self._rate = burst, rate
        self._full_at: dict[str, float] = {}
        """Time at which each user's bucket is full again, in seconds of the caller's clock."""

    def wait(self, user: str, now: float) -> float:
        """Return the time until the next message of a user may be read [s]; 0 if it may be read now."""
        # Half a message less than the burst, because the sum of many intervals has a rounding error.
        return max(0.0, self._full_at.get(user, -math.inf) - now - (self._burst - 0.5) / self._rate)

    def count(self, user: str, now: float) -> None:
        """Take a token from a user's bucket, because a message of that user has been read."""
        self._full_at[user] = max(self._full_at.get(user, now), now) + 1.0 / self._rate
        if len(self._full_at) > _MAX_BUCKETS:
            self._full_at = {user: full for user, full in self._full_at.items() if full > now}


T = TypeVar("T")


class FairQueue(Generic[T]):
    """Round-robin queue, in which users take turns. A user who is new or has been served is last in the order."""

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
        """View of the users with items, in the order of their turns. Do not iterate over it while the queue changes."""
        return self._queues.keys()

    def count(self, user: str) -> int:
        """Return the number of items of a user."""
        return len(self._queues.get(user, ()))

    def put(self, user: str, item: T) -> None:
        """Append an item to the items of a user."""
        self._queues.setdefault(user, deque()).append(item)
        self._length += 1

    def first(self, user: str) -> T:
        """Return the first item of a user. Raises KeyError if the user has no item."""
        return self._queues[user][0]

    def pop(self, user: str) -> T:
        """Remove and return the first item of a user. That user is then last in the order.

        Raises KeyError if the user has no item.
        """
        waiting = self._queues.pop(user)
        item = waiting.popleft()
        self._length -= 1
        if waiting:
            self._queues[user] = waiting
        return item

    def change(self, make: Callable[[T], T]) -> None:
        """Replace each item by the result of `make`, called with the item."""
        self._queues = {user: deque(map(make, waiting)) for user, waiting in self._queues.items()}


GOALS = 5_000
"""Maximum number of waiting goals; further goals are refused."""
GOALS_OF_ONE = 1_250
"""Maximum number of waiting goals of one user. It leaves space for the goals of other users."""
GOAL_PATIENCE = 8.0
"""Maximum time that a goal waits to be sent to the loop, while earlier goals are planned [s].

After that time, the goal is withdrawn, because its sender stops waiting for the reply soon afterwards.
"""


class WaitingGoal(NamedTuple):
    """Goal that waits to be sent to the loop, and the message that contained it, without the payload."""

    incoming: Incoming
    request: GoalRequest


class Backlog:
    """Queue of goals, which limits their number and their size. Users take turns.

    The goals of a user stay in the order of their arrival. Each goal leaves the queue exactly once, by `drop_first`. A
    withdrawn goal remains in its place in the queue, so that the loop reports its end in the right order.
    """

    def __init__(self) -> None:
        self._goals: FairQueue[WaitingGoal] = FairQueue()
        self._bytes = 0
        self._stop = 0, ""
        self._call_stop = 0, ""
        """Newest stop that also ends calls which have sent nothing but their first messages, as a pause does not."""
        self._stop_calls: dict[str, tuple[int, str]] = {}
        """Times of the newest calls of stops [ns], by connection, and their reasons."""
        self._calls: dict[CallMark, int] = {}
        """Number of the message that has announced each call that sends goals later, such as an alignment."""
        self._stopped: dict[str, tuple[int, str]] = {}
        """Stops of single goals, by goal id. The values are the number of the stop's message, and the reason."""

    def __iter__(self) -> Iterator[WaitingGoal]:
        return iter(self._goals)

    @property
    def users(self) -> list[str]:
        """Users with waiting goals, in the order of their turns."""
        return list(self._goals.users)

    def check_room(self, user: str, size: int) -> None:
        """Raise RefusedError if there is no space for another goal of this size [bytes]."""
        own = self._goals.count(user)
        if own >= GOALS_OF_ONE:
            raise RefusedError(
                RefusalCode.BUSY, f"{own} goals of {user} are already waiting, which is the maximum: send fewer goals"
            )
        if len(self._goals) >= GOALS or self._bytes + size > MAX_UNREAD:
            raise RefusedError(RefusalCode.BUSY, f"too many goals are waiting ({len(self._goals)}): send fewer goals")

    def add(self, incoming: Incoming, request: GoalRequest) -> None:
        """Enqueue a goal after the user's other goals.

        If a stop that applies to the goal has overtaken it, it is enqueued as withdrawn.
        """
        before, reason = self._stopped.get(request.id, (0, ""))
        reason = reason if incoming.number < before else self._overtaking(incoming)
        if reason:
            request = structs.replace(request, withdrawn=reason)
        self._goals.put(request.user, WaitingGoal(incoming._replace(payload=b""), request))
        self._bytes += incoming.size

    def first(self, user: str) -> WaitingGoal:
        """Return the next goal of a user. If it has waited too long, it is returned as withdrawn.

        Raises KeyError if the user has no goal.
        """
        goal = self._goals.first(user)
        if time.monotonic_ns() - goal.request.received_ns <= GOAL_PATIENCE * 1e9:
            return goal
        waited = f"the goal waited longer than {GOAL_PATIENCE:g} s"
        return _withdrawn(goal, f"{waited} for earlier goals or because the machine was busy: send the goal again")

    def drop_first(self, user: str) -> None:
        """Remove the first goal of a user, because it has been sent to the loop."""
        self._bytes -= self._goals.pop(user).incoming.size

    def withdraw(self, goal_id: str, reason: str) -> bool:
        """Withdraw the goal with this id. Return True if it was waiting."""
        is_waiting = any(goal.request.id == goal_id for goal in self._goals)
        if is_waiting:
            self._goals.change(lambda goal: _withdrawn(goal, reason) if goal.request.id == goal_id else goal)
        return is_waiting

    def withdraw_coming(self, goal_id: str, reason: str, before: int) -> None:
        """Withdraw a goal that has not been read yet, if it arrived before the message numbered `before`."""
        self._stopped.pop(goal_id, None)
        self._stopped[goal_id] = before, reason
        if len(self._stopped) > GOALS:
            del self._stopped[next(iter(self._stopped))]

    def withdraw_all(self, reason: str, stop: Incoming, *, ends_calls: bool) -> None:
        """Withdraw every goal that a stop has overtaken, including goals not read yet.

        With `ends_calls`, the goals are also withdrawn that calls of before the stop send later.
        """
        # Stops may be read in an order other than that of their arrival.
        self._stop = max(self._stop, (stop.number, reason))
        if ends_calls:
            self._call_stop = max(self._call_stop, (stop.number, reason))
        for mark in filter(None, (each.mark for each in (stop, *stop.alike))):
            newest, _ = self._stop_calls.pop(mark.connection, (0, ""))
            self._stop_calls[mark.connection] = max(newest, mark.called_ns), reason
            if len(self._stop_calls) > GOALS:
                del self._stop_calls[next(iter(self._stop_calls))]
        self._goals.change(lambda goal: _withdrawn(goal, reason) if goal.incoming.number < stop.number else goal)

    def check_stops(self, incoming: Incoming) -> None:
        """Raise RefusedError if a stop of all goals has overtaken a message."""
        if reason := self._overtaking(incoming):
            raise RefusedError(RefusalCode.STOPPED, f"not carried out: {reason} was called later and came first")

    def note_call(self, incoming: Incoming) -> None:
        """Store the number of a message that announces a call."""
        if incoming.mark is not None:
            first = self._calls.pop(incoming.mark, incoming.number)
            self._calls[incoming.mark] = min(first, incoming.number)
            if len(self._calls) > GOALS:
                del self._calls[next(iter(self._calls))]

    def _overtaking(self, incoming: Incoming) -> str:
        """Return the reason of a stop that has overtaken a message, or that came after the call of the message.

        Return "" if there is no such stop.
        """
        before, reason = self._stop
        if incoming.number < before:
            return reason
        if incoming.mark is None:
            return ""
        before, reason = self._call_stop
        if self._calls.get(incoming.mark, before) < before:
            return reason
        called_ns, reason = self._stop_calls.get(incoming.mark.connection, (0, ""))
        return reason if incoming.mark.called_ns < called_ns else ""

    def withdraw_others(self, user: str | None, reason: str) -> None:
        """Withdraw the goals of all users except `user`."""
        self._goals.change(lambda goal: goal if goal.request.user == user else _withdrawn(goal, reason))


def _withdrawn(goal: WaitingGoal, reason: str) -> WaitingGoal:
    """Return a withdrawn copy of a goal. A goal that is already withdrawn is returned unchanged."""
    request = goal.request
    return goal if request.withdrawn else goal._replace(request=structs.replace(request, withdrawn=reason))
