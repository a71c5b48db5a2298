"""Inbox of the gateway, which queues messages from Zenoh per user until they are read, up to a maximum size."""

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
from trirail.processes.stop_port import Answer
from trirail.wire import boundary, zenoh_session
from trirail.wire.call_mark import mark_in
from trirail.wire.messages import ErrorReply
from trirail.wire.sizes import MAX_BESIDE, MAX_MESSAGE, MAX_NAME, MAX_UNREAD, MAX_UNREAD_OF_ONE
from trirail.wire.stop_protocol import MAX_LINE, STOPS, StopRequest
from trirail.wire.text import is_id

MAX_MESSAGES = 8192
"""Maximum number of unread messages; further messages are refused.

Twice as many are allowed for commands, and three times as many for stops, so that no other message can prevent a stop.
"""
MAX_MESSAGES_OF_USER = 2048
"""Maximum number of unread messages of one user. More are allowed for commands and for stops, as above."""
TOO_MUCH = "too many unread messages: send fewer"
MAX_MERGED_STOPS = 32
"""Maximum number of consecutive equal stops of one user that are merged into one."""


class Inbox:
    """Inbox for all messages on the keys of the gateway.

    Users take turns, and the messages of each user are read at a limited rate, so that a flood of messages delays only
    its sender. Stops are recognised by their key, and are read before all other messages. Messages are numbered in the
    order of their arrival. The number of a stop shows which goals arrived before the stop. A goal that arrived after a
    stop is not read before that stop, unless the stop waits because another user has sent too many.

    Parameters
    ----------
    keys
        Number of names in the key of each kind of query.
    refuse
        Function called with each message that is not accepted, and with the error to send.
    clock
        Function that returns the monotonic time [s].

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
        """Waiting stops. Each item is a list of a stop and the equal stops that were merged into it."""
        self._newest: dict[str, list[Incoming]] = {}
        """Item of `_stops` for each user whose newest message is a waiting stop."""
        self._others: FairQueue[Incoming] = FairQueue()
        self._stops_pace, self._others_pace = Pace(), Pace()
        """Separate rate limits for stops and for other messages, so that they do not delay each other."""
        self._number = 0
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        weakref.finalize(self, os.close, self._wake)

    def fileno(self) -> int:
        """Return the descriptor to pass to select. It is readable while messages wait, and after `wake`."""
        return self._wake

    def wake(self) -> None:
        """Make the descriptor readable. This method may be called from a signal handler."""
        os.eventfd_write(self._wake, 1)

    def declare(self) -> None:
        """Declare the keys in Zenoh. Messages are received from then on."""

        # Not `indirect`: Zenoh's threads call back directly, so that messages are numbered in the order of arrival.
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
        """Yield up to `at_most` messages that may be read now, first stops and then others. Users take turns."""
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
        """Return the time until a waiting message may be read [s]; infinite if no message is waiting."""
        with self._lock:
            return self._due(self._clock())

    def earlier(self, number: int) -> bool:
        """Return True if any unread message, except stops, arrived before the message with this `number`."""
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
        """Yield users in the order of their turns, except those whose next message is a goal after their own stop."""
        for user in self._others.users:
            incoming, stops = self._others.first(user), user in self._stops.users
            if not (incoming.kind == "goal" and stops and incoming.number > self._stops.first(user)[0].number):
                yield user

    def _due(self, now: float) -> float:
        stops = (_wait(self._stops_pace, user, now) for user in self._stops.users)
        others = (_wait(self._others_pace, user, now) for user in self._readable())
        return min((*stops, *others), default=math.inf)

    def stop_at_port(self, request: StopRequest, answer: Answer) -> None:
        """Enqueue a request from the stop port. This method may be called from any thread."""
        content = request.content.encode()
        stop = Incoming("cmd", request.key, len(content), content, "", None, time.monotonic_ns(), at_door=answer)
        stop = stop._replace(held=len(content) + OVERHEAD, mark=mark_in(request.id))
        self._keep(_named(stop, request.id))

    def _on_query(self, kind: str, query: zenoh.Query) -> None:
        encoding = str(query.encoding) if query.encoding is not None else ""
        attachment = query.attachment
        beside = len(str(query.selector)) + (len(attachment) if attachment is not None else 0)
        incoming = _incoming(kind, str(query.key_expr), query.payload, encoding, query, beside)
        if incoming.size + beside > MAX_MESSAGE + MAX_BESIDE:
            self._keep_nothing(incoming._replace(size=incoming.size + beside, payload=b""))
            return
        if attachment is not None and len(attachment) <= MAX_NAME:
            text = attachment.to_bytes().decode(errors="replace")
            incoming = incoming._replace(mark=mark_in(text))
            incoming = _named(incoming, text) if _stops(incoming) else incoming
        self._keep(incoming)

    def _keep_nothing(self, large: Incoming) -> None:
        """Refuse a message that is too large immediately, which frees its memory. A stop takes effect nevertheless."""
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
        """Enqueue a message and return True, or return False if there is no space for it."""
        user, room = incoming.user, 3 if _stops(incoming) else 2 if incoming.kind == "cmd" else 1
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
        """Merge a stop into the user's previous message, if that is an equal, waiting stop. Return True if merged."""
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
    """Return True if a message stops the robot, which depends only on its key and not on its content."""
    return incoming.kind == "cmd" and incoming.key.rpartition("/")[2] in STOPS


def _named(stop: Incoming, name: str) -> Incoming:
    """Return a stop with its id set, if the id is valid.

    The copies of a stop that arrive over Zenoh and at the stop port have the same id. A stop that is too large for the
    stop port has no copy there, and therefore gets no id.
    """
    return stop._replace(id=name) if is_id(name) and stop.size <= MAX_LINE else stop


def _request_of(stop: Incoming) -> tuple[object, ...]:
    """Return a value that is equal for equal stops. A stop whose payload was dropped is not equal to any other stop."""
    known = stop.size == len(stop.payload)
    return stop.key, stop.payload, stop.encoding, None if known else stop.arrived_ns


def _incoming(
    kind: str, key: str, payload: zenoh.ZBytes | None, encoding: str, query: zenoh.Query | None, beside: int = 0
) -> Incoming:
    """Return a received message as an Incoming. `beside` is the size of the query without its payload [bytes]."""
    size = len(payload) if payload is not None else 0
    content = payload.to_bytes() if payload is not None and size <= MAX_MESSAGE else b""
    held = len(content) + OVERHEAD + (size + beside if query is not None else 0)
    return Incoming(kind, key, size, content, encoding, query, time.monotonic_ns(), held=held)


def _wait(pace: Pace, user: str, now: float) -> float:
    """Return the time until the next message of a user may be read [s]; 0 for messages without a user."""
    return pace.wait(user, now) if user else 0.0
