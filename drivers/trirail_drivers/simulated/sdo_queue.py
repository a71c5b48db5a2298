"""Requests that wait for the SDO server of a simulated device, which needs time for each of them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable


class SdoQueue:
    """Requests to an SDO server. The server handles one request at a time (CiA 301)."""

    def __init__(self, serve: Callable[[bytes], None]) -> None:
        """`serve` handles a request and sends its answer."""
        self.answer_time = 0.0
        """Time from the start of a request to its effect and its answer [s]. With 0, requests do not wait."""
        self.room = 1
        """Maximum number of requests, including the one that is being handled."""
        self.replaces = False
        """Whether a request that finds no room replaces the request before it; otherwise it is lost itself."""
        self._serve = serve
        self._waiting: deque[bytes] = deque()
        self._due = math.inf

    def __len__(self) -> int:
        return len(self._waiting)

    def receive(self, data: bytes, now: float) -> None:
        """Receive a request at time `now` [s]."""
        if not self.answer_time:
            self._serve(data)
            return
        if not self._waiting:
            self._due = now + self.answer_time
        if len(self._waiting) < self.room:
            self._waiting.append(bytes(data))
        elif self.replaces:
            self._waiting[-1] = bytes(data)

    def poll(self, now: float) -> bool:
        """Answer the requests due at time `now` [s]; return whether there were any."""
        answered = False
        while self._waiting and now >= self._due:
            self._due += self.answer_time
            self._serve(self._waiting.popleft())
            answered = True
        return answered

    def clear(self) -> None:
        """Discard the waiting requests."""
        self._waiting.clear()
