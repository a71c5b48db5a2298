"""What Zenoh hands over to the gateway: kept by user until it is read, bounded in number and in bytes."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Literal, NamedTuple

import zenoh

from trirail.processes.fair_queue import FairQueue
from trirail.processes.pace import Pace
from trirail.wire import boundary, zenoh_session
from trirail.wire.sizes import MAX_MESSAGE, MAX_UNREAD
from trirail.wire.vocabulary import Command

UNREAD = 8192
"""Messages that may wait to be read; beyond that they are refused, commands at twice as many: a flood of goals must not
keep a stop out."""
UNREAD_OF_ONE = 2048
"""Of them those of one user, and likewise."""

Kind = Literal["goal", "cmd", "info", "role", "poses", "teach", "forget"]

_STOPS = frozenset(name for name in Command if name.stops and name.everybodys)


class Incoming(NamedTuple):
    """A query or a put, as Zenoh handed it over."""

    kind: Kind
    key: str
    """As it was sent: it may have wildcards."""
    size: int
    """Of the payload [bytes]."""
    payload: bytes
    """Empty where it is larger than is decoded."""
    encoding: str
    query: zenoh.Query | None
    """None for a put: it has no answer."""
    arrived_ns: int
    """When it came, by the monotonic clock: it may have waited since, behind its user's others."""
    number: int = 0
    """Messages are numbered as they come."""

    @property
    def user(self) -> str:
        """Who is said to have sent it; "" for what names nobody."""
        return self.key.split("/")[3] if self.key.count("/") > 2 else ""

    def content(self, kind: Any, what: str) -> Any:
        """Return its payload as a message of that kind, a type or union. Raises RefusedError, beginning with `what`."""
        boundary.check_size(self.size)
        return boundary.decode(self.payload, kind, what, self.encoding)


class Inbox:
    """Declares what the gateway listens to, and keeps what comes. `too_much` is given what there is no room for.

    Users take turns, each at his pace, so that one who floods waits for himself. What stops the robot as a whole comes
    before all else: by its number the goals are known that were sent before it. `clock` gives seconds.
    """

    def __init__(
        self,
        opened: zenoh.Session,
        robot: str,
        too_much: Callable[[Incoming], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._session = opened
        self._robot = robot
        self._too_much = too_much
        self._lock = threading.Lock()
        self._stops: FairQueue[Incoming] = FairQueue()
        self._others: FairQueue[Incoming] = FairQueue()
        self._lanes = ((self._stops, Pace()), (self._others, Pace()))
        """What is read first comes first; who sends many stops has his pace in the rest for himself, and likewise."""
        self._number = 0
        self._bytes = 0
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        """For select and its like: readable where something waits, or `wake` was called."""
        return self._wake

    def wake(self) -> None:
        """Make it readable; safe from a signal handler."""
        os.eventfd_write(self._wake, 1)

    def declare(self) -> None:
        """Listen from now on."""

        # Called as messages arrive, by one thread: they are numbered in that order.
        def queries(kind: Kind) -> zenoh.handlers.Callback[zenoh.Query]:
            return zenoh.handlers.Callback(partial(self._on_query, kind), indirect=False)

        on_sample = zenoh.handlers.Callback(self._on_sample, indirect=False)
        key, declare = partial(zenoh_session.key, self._robot), self._session.declare_queryable
        self._declared = [
            declare(key("goal", "*"), queries("goal")),
            declare(key("cmd", "*", "*"), queries("cmd")),
            declare(key("info"), queries("info")),
            declare(key("role", "*"), queries("role")),
            declare(key("poses"), queries("poses")),
            declare(key("teach", "*", "*"), queries("teach")),
            declare(key("forget", "*", "*"), queries("forget")),
            self._session.declare_subscriber(key("goal", "*"), on_sample),
            self._session.liveliness().declare_token(key("alive")),
        ]

    def take(self, at_most: int) -> Iterator[Incoming]:
        """Take what may be read now, user by user in turn, stops first; if that is more, it stays readable."""
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
        """Return how long it is until something of what waits may be read; infinite where nothing waits [s]."""
        with self._lock:
            return self._due(self._clock())

    def _next(self, now: float) -> Incoming | None:
        for queue, pace in self._lanes:
            user = next((user for user in queue.users if not _wait(pace, user, now)), None)
            if user is not None:
                pace.count(user, now)
                incoming = queue.take(user)
                self._bytes -= len(incoming.payload)
                return incoming
        return None

    def _due(self, now: float) -> float:
        return min((_wait(pace, user, now) for queue, pace in self._lanes for user in queue.users), default=math.inf)

    def _on_query(self, kind: Kind, query: zenoh.Query) -> None:
        encoding = str(query.encoding) if query.encoding is not None else ""
        self._keep(kind, str(query.key_expr), query.payload, encoding, query)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self._keep("goal", str(sample.key_expr), sample.payload, str(sample.encoding), None)

    def _keep(
        self, kind: Kind, key: str, payload: zenoh.ZBytes | None, encoding: str, query: zenoh.Query | None
    ) -> None:
        size = len(payload) if payload is not None else 0
        content = payload.to_bytes() if payload is not None and size <= MAX_MESSAGE else b""
        incoming = Incoming(kind, key, size, content, encoding, query, time.monotonic_ns())
        user, room = incoming.user, 2 if kind == "cmd" else 1
        stops = kind == "cmd" and size == 0 and key.rpartition("/")[2] in _STOPS
        with self._lock:
            self._number += 1
            unread, own = len(self._stops) + len(self._others), self._stops.of(user) + self._others.of(user)
            fits = unread < room * UNREAD and own < room * UNREAD_OF_ONE
            fits = fits and self._bytes + len(content) <= room * MAX_UNREAD
            if fits:
                queue = self._stops if stops else self._others
                queue.put(user, incoming._replace(number=self._number))
                self._bytes += len(content)
        if fits:
            self.wake()
        else:
            self._too_much(incoming._replace(payload=b""))


def _wait(pace: Pace, user: str, now: float) -> float:
    """Return how long a user's next message has to wait; what names nobody only asks, and waits for its turn alone."""
    return pace.wait(user, now) if user else 0.0
