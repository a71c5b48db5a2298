"""What Zenoh hands over to the gateway: kept by user until it is read, bounded in number and in bytes."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial

import zenoh

from trirail.processes.incoming import FairQueue, Incoming, Kind, Pace
from trirail.processes.stop_door import Answer
from trirail.wire import zenoh_session
from trirail.wire.sizes import MAX_MESSAGE, MAX_NAME, MAX_UNREAD
from trirail.wire.stop_protocol import MAX_LINE, STOPS, StopRequest
from trirail.wire.text import is_id

UNREAD = 8192
"""Messages that may wait to be read; beyond that they are refused, commands at twice as many: a flood of goals must not
keep a stop out."""
UNREAD_OF_ONE = 2048
"""Of them those of one user, and likewise."""
ALIKE = 32
"""Stops of one user that are read as one, where they came one behind the other and ask for the same."""


class Inbox:
    """Declares what the gateway listens to, and keeps what comes. `too_much` is given what there is no room for.

    Users take turns, each at his pace, so that one who floods waits for himself. What stops the robot comes before all
    else, known by its key alone: by its number the goals are known that were sent before it, and no goal that was sent
    after it is read before it. `clock` gives seconds.
    """

    def __init__(
        self,
        session: zenoh.Session,
        robot: str,
        too_much: Callable[[Incoming], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._session = session
        self._robot = robot
        self._too_much = too_much
        self._lock = threading.Lock()
        self._stops: FairQueue[list[Incoming]] = FairQueue()
        """Each with those that are alike behind it."""
        self._newest: dict[str, list[Incoming]] = {}
        """Where a user's last message of all is a stop that waits: with what it waits."""
        self._others: FairQueue[Incoming] = FairQueue()
        self._stops_pace, self._others_pace = Pace(), Pace()
        """Who sends many stops has his pace in the rest for himself, and likewise."""
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
            declare(key("alignment", "*"), queries("alignment")),
            self._session.declare_subscriber(key("goal", "*"), on_sample),
            self._session.liveliness().declare_token(key("alive")),
        ]

    def next_messages(self, at_most: int) -> Iterator[Incoming]:
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

    def earlier(self, number: int) -> bool:
        """Whether something that came before a message waits to be read."""
        with self._lock:
            return any(self._others.first(user).number < number for user in self._others.users)

    def _next(self, now: float) -> Incoming | None:
        user = next((user for user in self._stops.users if not _wait(self._stops_pace, user, now)), None)
        if user is not None:
            self._stops_pace.count(user, now)
            stop, *alike = stops = self._stops.pop(user)
            if self._newest.get(user) is stops:
                del self._newest[user]
            self._bytes -= len(stop.payload)
            return stop._replace(alike=tuple(alike))
        user = next((user for user in self._readable() if not _wait(self._others_pace, user, now)), None)
        if user is not None:
            self._others_pace.count(user, now)
            incoming = self._others.pop(user)
            self._bytes -= len(incoming.payload)
            return incoming
        return None

    def _readable(self) -> Iterator[str]:
        """Yield users whose next message is none that a stop has to be read before, in the order of their turns."""
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
        """Keep a request at the door for stops; safe from any thread."""
        content = request.content.encode()
        stop = Incoming("cmd", request.key, len(content), content, "", None, time.monotonic_ns())
        self._keep(_named(stop._replace(at_door=answer), request.id))

    def _on_query(self, kind: Kind, query: zenoh.Query) -> None:
        encoding = str(query.encoding) if query.encoding is not None else ""
        incoming = _incoming(kind, str(query.key_expr), query.payload, encoding, query)
        if _stops(incoming) and query.attachment is not None and len(query.attachment) <= MAX_NAME:
            incoming = _named(incoming, query.attachment.to_bytes().decode(errors="replace"))
        self._keep(incoming)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self._keep(_incoming("goal", str(sample.key_expr), sample.payload, str(sample.encoding), None))

    def _keep(self, incoming: Incoming) -> None:
        user, size, room = incoming.user, len(incoming.payload), 2 if incoming.kind == "cmd" else 1
        with self._lock:
            self._number += 1
            incoming = incoming._replace(number=self._number)
            fits = self._joins(incoming)
            if not fits:
                unread, own = len(self._stops) + len(self._others), self._stops.of(user) + self._others.of(user)
                fits = unread < room * UNREAD and own < room * UNREAD_OF_ONE
                fits = fits and self._bytes + size <= room * MAX_UNREAD
                if fits:
                    self._put(incoming)
        if fits:
            self.wake()
        else:
            self._too_much(incoming._replace(payload=b""))

    def _joins(self, incoming: Incoming) -> bool:
        """Whether a message goes with the one before it of its user: a stop that asks for the same, and waits."""
        stops = self._newest.get(incoming.user)
        if not _stops(incoming) or stops is None or len(stops) >= ALIKE or _asked(stops[0]) != _asked(incoming):
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
        self._bytes += len(incoming.payload)


def _stops(incoming: Incoming) -> bool:
    """Whether it stops the robot, whatever it holds."""
    return incoming.kind == "cmd" and incoming.key.rpartition("/")[2] in STOPS


def _named(stop: Incoming, name: str) -> Incoming:
    """Return a stop with its id, where it is one; what has more content than the door takes has no copy there."""
    return stop._replace(id=name) if is_id(name) and stop.size <= MAX_LINE else stop


def _asked(stop: Incoming) -> tuple[object, ...]:
    """What is asked for; of what is too large to be kept nobody knows."""
    known = stop.size == len(stop.payload)
    return stop.key, stop.payload, stop.encoding, None if known else stop.arrived_ns


def _incoming(kind: Kind, key: str, payload: zenoh.ZBytes | None, encoding: str, query: zenoh.Query | None) -> Incoming:
    size = len(payload) if payload is not None else 0
    content = payload.to_bytes() if payload is not None and size <= MAX_MESSAGE else b""
    return Incoming(kind, key, size, content, encoding, query, time.monotonic_ns())


def _wait(pace: Pace, user: str, now: float) -> float:
    """Return how long a user's next message has to wait; what names nobody only asks, and waits for its turn alone."""
    return pace.wait(user, now) if user else 0.0
