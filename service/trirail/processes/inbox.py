"""What Zenoh hands over to the gateway: kept in its order until it is read, bounded in number and in bytes."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Literal, NamedTuple

import zenoh

from trirail.wire import zenoh_session
from trirail.wire.sizes import MAX_MESSAGE, MAX_UNREAD

UNREAD = 8192
"""Messages that may wait to be read; beyond that they are refused, commands at twice as many: a flood of goals must not
keep a stop out."""

Kind = Literal["goal", "cmd", "info", "role", "poses", "teach", "forget"]


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


class Inbox:
    """Declares what the gateway listens to, and keeps what comes. `too_much` is given what there is no room for."""

    def __init__(self, opened: zenoh.Session, robot: str, too_much: Callable[[Incoming], None]) -> None:
        self._session = opened
        self._robot = robot
        self._too_much = too_much
        self._lock = threading.Lock()
        self._waiting: deque[Incoming] = deque()
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

        # Called as messages arrive, by one thread: else a stop could overtake the goals that were put before it.
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
        """Take what waits, the oldest first; if that is more, it stays readable."""
        for _ in range(at_most):
            with self._lock:
                if not self._waiting:
                    break
                incoming = self._waiting.popleft()
                self._bytes -= len(incoming.payload)
            yield incoming
        with self._lock:
            if not self._waiting:
                try:
                    os.eventfd_read(self._wake)
                except BlockingIOError:
                    return

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
        incoming = Incoming(kind, key, size, content, encoding, query)
        with self._lock:
            room = 2 if kind == "cmd" else 1
            fits = len(self._waiting) < room * UNREAD and self._bytes + len(content) <= room * MAX_UNREAD
            if fits:
                self._waiting.append(incoming)
                self._bytes += len(content)
        if fits:
            self.wake()
        else:
            self._too_much(incoming._replace(payload=b""))
