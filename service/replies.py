"""Answers to queries, sent by threads of their own: whoever does not take an answer holds up nobody else."""

from __future__ import annotations

import contextlib
import queue
import threading
import time

import msgspec
import zenoh

from service import boundary, session
from service.errors import RefusedError
from service.inbox import Incoming
from service.messages import ErrorReply

SENDERS = 8
"""Threads: so many askers may be frozen before the others' answers wait for one of them to be given up."""
UNSENT = 65_536
"""Answers that may wait to be sent; beyond that they are lost."""
CLOSE_WITHIN = 2.0
"""How long the last answers may take [s]."""


class Replies:
    """Sends answers. An answer is never dropped: it waits for its asker, until the transport gives that up."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._queue: queue.Queue[tuple[Incoming, msgspec.Struct] | None] = queue.Queue(UNSENT)
        self._threads = [threading.Thread(target=self._run, name="replies", daemon=True) for _ in range(SENDERS)]
        for thread in self._threads:
            thread.start()

    def send(self, incoming: Incoming, content: msgspec.Struct) -> None:
        """Answer a query; nothing for a put."""
        if incoming.query is not None:
            with contextlib.suppress(queue.Full):
                self._queue.put_nowait((incoming, content))

    def close(self) -> None:
        """Send what waits, for a while at most."""
        deadline = time.monotonic() + CLOSE_WITHIN
        for _ in self._threads:
            with contextlib.suppress(queue.Full):
                self._queue.put(None, timeout=max(0.0, deadline - time.monotonic()))
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
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
                key = session.key(self._robot, "info") if incoming.kind == "info" else incoming.key
                query.reply(key, payload, encoding=encoding)
