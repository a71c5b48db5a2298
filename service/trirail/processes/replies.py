"""Answers to queries, sent by threads of their own: whoever does not take an answer holds up nobody else."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque

import msgspec
import zenoh

from trirail.errors import RefusedError
from trirail.processes.copies import Copies
from trirail.processes.incoming import Incoming
from trirail.wire import boundary, zenoh_session
from trirail.wire.messages import ErrorReply

THREADS = 32
"""So many askers that take no answer hold up nobody else."""
CLOSE_WITHIN = 2.0
"""How long the last answers may take [s]."""


class Replies:
    """Sends answers, to each asker in their order. One is never dropped before the transport gives its asker up."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self.copies = Copies()
        self._changed = threading.Condition()
        # Not bounded: a query that is let go says so to its asker, and that may wait as long as an answer.
        self._of: dict[str, deque[tuple[Incoming, msgspec.Struct]]] = {}
        self._idle: deque[str] = deque()
        """Askers with answers of which none is being sent, in the order of their turns."""
        self._closed = False
        self._threads = [threading.Thread(target=self._run, name="replies", daemon=True) for _ in range(THREADS)]
        for thread in self._threads:
            thread.start()

    @property
    def waiting(self) -> int:
        """How many answers wait for their turn."""
        with self._changed:
            return sum(map(len, self._of.values()))

    def send(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Answer a message alone; nothing for a put. Safe from any thread."""
        if incoming.at_door is not None:
            incoming.at_door(content)
        if incoming.query is None:
            return
        # Of a command the user decides and not its name: who asks for one thing and does not listen is the same.
        asker = "/".join(incoming.key.split("/")[:4])
        with self._changed:
            if asker not in self._of:
                self._of[asker] = deque()
                self._idle.append(asker)
                self._changed.notify()
            self._of[asker].append((incoming, content))

    def answer(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Answer what was carried out, or refused, and all that were read as one with it, and the copies of each."""
        for each in (incoming, *incoming.alike):
            self.send(each, content)
            for copy in self.copies.answered(each, content):
                self.send(copy, content)

    def fresh(self, incoming: Incoming) -> Incoming | None:
        """Return a stop, and those read as one with it, without the copies of others: these get the answer of those.

        Its number is the newest. None where there are but copies.
        """
        fresh = []
        for each in (incoming, *incoming.alike):
            if self.copies.first(each):
                fresh.append(each)
            elif (known := self.copies.known(each)) is not None:
                self.send(each, known)
        if not fresh:
            return None
        return fresh[0]._replace(number=fresh[-1].number, alike=tuple(fresh[1:]))

    def close(self) -> None:
        """Send what waits, for a while at most."""
        deadline = time.monotonic() + CLOSE_WITHIN
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._idle or self._closed)
                if not self._idle:
                    return
                asker = self._idle.popleft()
                incoming, content = self._of[asker].popleft()
            if incoming.query is not None:
                with contextlib.suppress(zenoh.ZError):  # the asker has gone
                    self._answer(incoming, incoming.query, content)
            del incoming, content  # for a query ends when nobody has it any more
            with self._changed:
                if self._of[asker]:
                    self._idle.append(asker)
                    self._changed.notify()
                else:
                    del self._of[asker]

    def _answer(self, incoming: Incoming, query: zenoh.Query, content: msgspec.Struct) -> None:
        try:
            encoding = boundary.encoding(incoming.encoding)
        except RefusedError:
            encoding = boundary.JSON
        payload = boundary.encode(content, encoding)
        with query:  # dropped afterwards: else the caller waits for more until its time-out
            if isinstance(content, ErrorReply):
                query.reply_err(payload, encoding=encoding)
            else:
                of_robot = incoming.kind in ("info", "poses")  # what was asked may have wildcards
                key = zenoh_session.key(self._robot, incoming.kind) if of_robot else incoming.key
                query.reply(key, payload, encoding=encoding)
