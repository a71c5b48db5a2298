"""Budget for the memory that messages occupy in the gateway, and trimming of the heap after a burst of messages."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

from trirail.processes.realtime import return_free_memory

OVERHEAD: Final = 1024
"""Memory that a message needs in addition to its content, for Zenoh's query and for Python's objects [bytes]."""


class Reservation:
    """Reservation of memory for a message. Copies of the message share it.

    The memory is released when the object is garbage-collected.
    """

    __slots__ = ("_release",)

    def __init__(self, release: Callable[[], None]) -> None:
        self._release = release

    def __del__(self) -> None:
        self._release()


class Budget:
    """Limit on the bytes that may be reserved at one time, in total and per user."""

    def __init__(self, total: int, of_one: int) -> None:
        self._total, self._of_one = total, of_one
        self._held: Counter[str] = Counter()
        self._all = 0
        # Reentrant, because garbage collection may release a reservation in a thread that already holds the lock.
        self._lock = threading.RLock()

    @property
    def held(self) -> int:
        """Number of bytes that are currently reserved, in total."""
        return self._all

    def hold(self, user: str, size: int, room: int = 1) -> Reservation | None:
        """Reserve `size` bytes for a message of a user. Return None if that would exceed `room` times the budget."""
        with self._lock:
            if self._all + size > room * self._total or self._held[user] + size > room * self._of_one:
                self._forget(user)
                return None
            self._all += size
            self._held[user] += size
        return Reservation(lambda: self._release(user, size))

    def _release(self, user: str, size: int) -> None:
        with self._lock:
            self._all -= size
            self._held[user] -= size
            self._forget(user)

    def _forget(self, user: str) -> None:
        if not self._held[user]:
            del self._held[user]


TRIM_EVERY: Final = 1.0
"""Interval between two checks of this process's memory [s]."""
TRIM_ABOVE: Final = 8_000_000
"""Growth of the resident memory above which the heap is trimmed [bytes]."""


class HeapTrim:
    """Periodic check that trims the heap after a burst of messages. Otherwise malloc would not return free memory."""

    def __init__(self) -> None:
        self._least = _resident()
        self._due = time.monotonic()

    def poll(self) -> None:
        """Trim the heap if the resident memory is TRIM_ABOVE larger than its smallest value; check every TRIM_EVERY."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + TRIM_EVERY
        try:
            resident = _resident()
        except OSError:  # no descriptor is free, for example in a flood of connections
            return
        self._least = min(self._least, resident)
        if resident > self._least + TRIM_ABOVE:
            return_free_memory()


def _resident() -> int:
    """Return the resident memory of this process [bytes], from /proc/self/statm, proc(5). Raises OSError."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
