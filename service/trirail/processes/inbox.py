"""Inbox for messages from Zenoh: queued by user until they are read, bounded in number and in bytes."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from functools import partial

import zenoh

from trirail.errors import RefusalCode
from trirail.processes.incoming import FairQueue, Incoming, Pace
from trirail.processes.memory_budget import OVERHEAD, Budget
from trirail.processes.stop_door import Answer
from trirail.wire import boundary, zenoh_session
from trirail.wire.messages import ErrorReply
from trirail.wire.sizes import MAX_BESIDE, MAX_MESSAGE, MAX_NAME, MAX_UNREAD, MAX_UNREAD_OF_ONE
from trirail.wire.stop_protocol import MAX_LINE, STOPS, StopRequest
from trirail.wire.text import is_id

MAX_MESSAGES = 8192
"""Maximum number of unread messages; more are refused. The limit is double for commands, so goals cannot block a stop.
"""
MAX_MESSAGES_OF_USER = 2048
"""Maximum number of one user's unread messages; the limit is double for commands."""
TOO_MUCH = "too many unread messages: send fewer"
MAX_MERGED_STOPS = 32
"""Maximum number of consecutive equal stops of one user that are merged into one."""


class Inbox:
    """Inbox of the gateway's keys.

    Users take turns, each at a limited rate, so that a flood delays only its sender. Stops are recognised by their key
    and read before all other messages. Messages are numbered: a stop's number shows which goals were sent before it,
    and a goal sent after a stop is never read before that stop.

    Parameters
    ----------
    keys
        Kinds of queries, each with the number of names in its key.
    refuse
        Called with each message that is not kept, and the error.
    clock
        Monotonic clock [s].

    """

    def __init__(
        self,
        session: zenoh.Session,
        robot: str,
        keys: Mapping[str, int],
        refuse: Callable[[Incoming, ErrorReply], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._session = session
        self._robot = robot
        self._keys = keys
        self._refuse = refuse
        self._budget = Budget(MAX_UNREAD, MAX_UNREAD_OF_ONE)
        self._lock = threading.Lock()
        self._stops: FairQueue[list[Incoming]] = FairQueue()
        """Stops; each contains the equal stops that were merged into it."""
        self._newest: dict[str, list[Incoming]] = {}
        """Waiting stops that are the newest message of their user, with the equal ones merged into them."""
        self._others: FairQueue[Incoming] = FairQueue()
        self._stops_pace, self._others_pace = Pace(), Pace()
        """Separate rates, so that a user's stops and other messages do not delay each other."""
        self._number = 0
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        weakref.finalize(self, os.close, self._wake)

    def fileno(self) -> int:
        """Return the descriptor to pass to select: readable while messages wait, or after `wake`."""
        return self._wake

    def wake(self) -> None:
        """Make the descriptor readable; safe from a signal handler."""
        os.eventfd_write(self._wake, 1)

    def declare(self) -> None:
        """Declare the keys, and so begin to receive."""

        # Not `indirect`: Zenoh calls back as messages arrive, so that they are numbered in the order of arrival.
        def declare(kind: str, names: int) -> zenoh.Queryable[None]:
            on_query = zenoh.handlers.Callback(partial(self._on_query, kind), indirect=False)
            return self._session.declare_queryable(key(kind, *"*" * names), on_query)

        on_sample = zenoh.handlers.Callback(self._on_sample, indirect=False)
        key = partial(zenoh_session.key, self._robot)
        self._declared = [
            *(declare(kind, names) for kind, names in self._keys.items()),
            self._session.declare_subscriber(key("goal", "*"), on_sample),
            self._session.liveliness().declare_token(key("alive")),
        ]

    def next_messages(self, at_most: int) -> Iterator[Incoming]:
        """Yield at most `at_most` messages that may be read now, stops first; users take turns."""
        for _ in range(at_most):
            with self._lock:
                incoming = self._next(self._clock())
            if incoming is None:
                break
            yield incoming
        with self._lock:
            if self._due(self._clock()) > 0.0:
                with contextlib.suppress(BlockingIOError):
                    os.eventfd_read(self._wake)

    def due(self) -> float:
        """Return the time until a waiting message may be read [s]; infinite if none waits."""
        with self._lock:
            return self._due(self._clock())

    def earlier(self, number: int) -> bool:
        """Return whether a message with a lower number waits to be read."""
        with self._lock:
            return any(self._others.first(user).number < number for user in self._others.users)

    def _next(self, now: float) -> Incoming | None:
        user = next((user for user in self._stops.users if not _wait(self._stops_pace, user, now)), None)
        if user is not None:
            self._stops_pace.count(user, now)
            stop, *alike = stops = self._stops.pop(user)
            if self._newest.get(user) is stops:
                del self._newest[user]
            return stop._replace(alike=tuple(alike))
        user = next((user for user in self._readable() if not _wait(self._others_pace, user, now)), None)
        if user is not None:
            self._others_pace.count(user, now)
            return self._others.pop(user)
        return None

    def _readable(self) -> Iterator[str]:
        """Yield users in the order of their turns, except those whose next message is a goal behind a stop."""
        stop = min((self._stops.first(user)[0].number for user in self._stops.users), default=math.inf)
        for user in self._others.users:
            incoming = self._others.first(user)
            if incoming.kind != "goal" or incoming.number < stop:
                yield user

    def _due(self, now: float) -> float:
        stops = (_wait(self._stops_pace, user, now) for user in self._stops.users)
        others = (_wait(self._others_pace, user, now) for user in self._readable())
        return min((*stops, *others), default=math.inf)

    def stop_at_door(self, request: StopRequest, answer: Answer) -> None:
        """Enqueue a request from the stop port; safe from any thread."""
        content = request.content.encode()
        stop = Incoming("cmd", request.key, len(content), content, "", None, time.monotonic_ns(), at_door=answer)
        self._keep(_named(stop._replace(held=len(content) + OVERHEAD), request.id))

    def _on_query(self, kind: str, query: zenoh.Query) -> None:
        encoding = str(query.encoding) if query.encoding is not None else ""
        attachment = query.attachment
        beside = len(str(query.selector)) + (len(attachment) if attachment is not None else 0)
        incoming = _incoming(kind, str(query.key_expr), query.payload, encoding, query, beside)
        if incoming.size + beside > MAX_MESSAGE + MAX_BESIDE:
            self._keep_nothing(incoming._replace(size=incoming.size + beside, payload=b""))
            return
        if _stops(incoming) and attachment is not None and len(attachment) <= MAX_NAME:
            incoming = _named(incoming, attachment.to_bytes().decode(errors="replace"))
        self._keep(incoming)

    def _keep_nothing(self, large: Incoming) -> None:
        """Refuse a message that is too large immediately, to free its memory; a stop still takes effect."""
        error = ErrorReply(RefusalCode.TOO_LARGE, boundary.too_large(large.size))
        if _stops(large):
            name = large.key.rpartition("/")[2]
            if self._has_kept(large.unanswered()):
                error = ErrorReply(error.code, f"{error.message}; {name} is carried out nevertheless")
            else:
                error = ErrorReply(RefusalCode.BUSY, TOO_MUCH)
        self._refuse(large, error)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self._keep(_incoming("goal", str(sample.key_expr), sample.payload, str(sample.encoding), None))

    def _keep(self, incoming: Incoming) -> None:
        if not self._has_kept(incoming):
            self._refuse(incoming._replace(payload=b""), ErrorReply(RefusalCode.BUSY, TOO_MUCH))

    def _has_kept(self, incoming: Incoming) -> bool:
        """Enqueue a message; return False if there is no room for it."""
        user, room = incoming.user, 2 if incoming.kind == "cmd" else 1
        hold = self._budget.hold(user, incoming.held, room)
        if hold is None:
            return False
        with self._lock:
            self._number += 1
            incoming = incoming._replace(number=self._number, hold=hold)
            fits = self._joins(incoming)
            if not fits:
                unread, own = len(self._stops) + len(self._others), self._stops.count(user) + self._others.count(user)
                fits = unread < room * MAX_MESSAGES and own < room * MAX_MESSAGES_OF_USER
                if fits:
                    self._put(incoming)
        if fits:
            self.wake()
        return fits

    def _joins(self, incoming: Incoming) -> bool:
        """Merge a stop into an equal, waiting one if that is the user's previous message; return whether it was."""
        stops = self._newest.get(incoming.user)
        if (
            not _stops(incoming)
            or stops is None
            or len(stops) >= MAX_MERGED_STOPS
            or _request_of(stops[0]) != _request_of(incoming)
        ):
            return False
        stops.append(incoming._replace(payload=stops[0].payload))
        return True

    def _put(self, incoming: Incoming) -> None:
        self._newest.pop(incoming.user, None)
        if _stops(incoming):
            self._newest[incoming.user] = [incoming]
            self._stops.put(incoming.user, self._newest[incoming.user])
        else:
            self._others.put(incoming.user, incoming)


def _stops(incoming: Incoming) -> bool:
    """Return whether a message stops the robot, regardless of its content."""
    return incoming.kind == "cmd" and incoming.key.rpartition("/")[2] in STOPS


def _named(stop: Incoming, name: str) -> Incoming:
    """Return a stop with its id, if valid. A stop too large for the stop port has no copy there, and gets no id."""
    return stop._replace(id=name) if is_id(name) and stop.size <= MAX_LINE else stop


def _request_of(stop: Incoming) -> tuple[object, ...]:
    """Return the request of a stop for comparison; a stop whose payload was not kept equals no other."""
    known = stop.size == len(stop.payload)
    return stop.key, stop.payload, stop.encoding, None if known else stop.arrived_ns


def _incoming(
    kind: str, key: str, payload: zenoh.ZBytes | None, encoding: str, query: zenoh.Query | None, beside: int = 0
) -> Incoming:
    """Return a received message; `beside` is the size of its query without the payload [bytes]."""
    size = len(payload) if payload is not None else 0
    content = payload.to_bytes() if payload is not None and size <= MAX_MESSAGE else b""
    held = len(content) + OVERHEAD + (size + beside if query is not None else 0)
    return Incoming(kind, key, size, content, encoding, query, time.monotonic_ns(), held=held)


def _wait(pace: Pace, user: str, now: float) -> float:
    """Return the time until a user's next message may be read [s]; messages without a user are not limited."""
    return pace.wait(user, now) if user else 0.0
