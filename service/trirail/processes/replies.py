"""Answers to queries, sent by threads of their own: whoever does not take an answer holds up nobody else."""

from __future__ import annotations

import contextlib
import queue
import threading
import time

import msgspec
import zenoh

from trirail.errors import RefusedError
from trirail.processes.inbox import Incoming
from trirail.wire import boundary, zenoh_session
from trirail.wire.messages import ErrorReply

LANES = 32
"""Threads, and queues before them: an asker's answers go all through one, chosen by the key that was asked."""
CLOSE_WITHIN = 2.0
"""How long the last answers may take [s]."""


_Lane = queue.SimpleQueue[tuple[Incoming, msgspec.Struct] | None]


class Replies:
    """Sends answers. An answer is never dropped: it waits for its asker, until the transport gives that up."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._lanes: list[_Lane] = [queue.SimpleQueue() for _ in range(LANES)]
        self._threads = [
            threading.Thread(target=self._run, args=(lane,), name="replies", daemon=True) for lane in self._lanes
        ]
        for thread in self._threads:
            thread.start()

    @property
    def waiting(self) -> int:
        """How many answers wait for their turn."""
        return sum(lane.qsize() for lane in self._lanes)

    def send(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Answer a query; nothing for a put."""
        if incoming.query is not None:
            # Of a command the user decides and not its name: who asks for one thing and does not listen is the same.
            asker = "/".join(incoming.key.split("/")[:4])
            # Not bounded: a query that is let go says so to its asker, and that may wait as long as an answer.
            self._lanes[hash(asker) % LANES].put((incoming, content))

    def close(self) -> None:
        """Send what waits, for a while at most."""
        deadline = time.monotonic() + CLOSE_WITHIN
        for lane in self._lanes:
            lane.put(None)
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _run(self, lane: _Lane) -> None:
        while (item := lane.get()) is not None:
            incoming, content = item
            if incoming.query is not None:
                with contextlib.suppress(zenoh.ZError):  # the asker has gone
                    self._answer(incoming, incoming.query, content)
            del item, incoming  # for a query ends when nobody has it any more

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
