"""Newest SDO request of the cycle to one drive, whose server handles one request at a time (CiA 301)."""

from __future__ import annotations

import math


class PendingRequest:
    """Newest SDO request, and whether the drive has answered it."""

    __slots__ = ("_due", "_object", "_overlaps", "unanswered")

    def __init__(self) -> None:
        self._object = b""
        """Object of the request: index, little-endian, and subindex."""
        self._due = -math.inf
        self.forget()

    def forget(self) -> None:
        """Await no answer."""
        self.unanswered = self._overlaps = False

    def begin(self, now: float, request: bytes, timeout: float) -> None:
        """Record a request that is sent at time `now`, and lost if it is unanswered after `timeout` [s]."""
        self._overlaps, self.unanswered = self.unanswered, True
        self._object, self._due = request[1:4], now + timeout

    def is_lost(self, now: float) -> bool:
        """Whether the request or its answer has been lost."""
        return self.unanswered and now >= self._due

    def end(self, answer: bytes | bytearray) -> bool:
        """Handle an answer; return whether the request may have been lost.

        An answer to the request before it shows that the drive was busy. Some drives then lose the later request.
        """
        if answer[1:4] == self._object:
            self.forget()
        return self._overlaps
