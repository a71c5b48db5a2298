"""Users take turns: how fast each one's messages are read, and a queue in which none holds up another."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, KeysView
from typing import Generic, TypeVar

BURST = 400
"""Messages of one user that are read as soon as it is his turn."""
RATE = 200.0
"""Messages of one user that are read a second beyond that: ten times what a stream of goals or a held jog sends."""
_FORGOTTEN = 1000
"""With so many users those are forgotten who have their whole burst again."""


class Pace:
    """A token bucket for each user, as the generic cell rate algorithm keeps it: one moment instead of a count."""

    def __init__(self, burst: int = BURST, rate: float = RATE) -> None:
        self._burst, self._rate = burst, rate
        self._full_at: dict[str, float] = {}
        """When each user's bucket is full again, in seconds of the caller's clock."""

    def wait(self, user: str, now: float) -> float:
        """Return how long it is until a user's next message may be read; 0 where it may be now [s]."""
        # Half a message less than the burst: a sum of so many fractions does not end at a whole one.
        return max(0.0, self._full_at.get(user, -math.inf) - now - (self._burst - 0.5) / self._rate)

    def count(self, user: str, now: float) -> None:
        """Note that a message of a user has been read."""
        self._full_at[user] = max(self._full_at.get(user, now), now) + 1.0 / self._rate
        if len(self._full_at) > _FORGOTTEN:
            self._full_at = {user: full for user, full in self._full_at.items() if full > now}


T = TypeVar("T")


class FairQueue(Generic[T]):
    """Round robin: who has been served goes behind the others; who comes anew begins behind them."""

    def __init__(self) -> None:
        self._of: dict[str, deque[T]] = {}  # the users in the order of their turns, none without anything
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[T]:
        for waiting in self._of.values():
            yield from waiting

    @property
    def users(self) -> KeysView[str]:
        """Who has something in it, in the order of their turns; not to be looked through while it changes."""
        return self._of.keys()

    def of(self, user: str) -> int:
        """Return how much of it is a user's."""
        return len(self._of.get(user, ()))

    def put(self, user: str, item: T) -> None:
        """Put something behind the user's own."""
        self._of.setdefault(user, deque()).append(item)
        self._length += 1

    def first(self, user: str) -> T:
        """Return the user's first; KeyError where there is none."""
        return self._of[user][0]

    def pop(self, user: str) -> T:
        """Take the first of a user, who goes behind the others; KeyError where there is none."""
        waiting = self._of.pop(user)
        item = waiting.popleft()
        self._length -= 1
        if waiting:
            self._of[user] = waiting
        return item

    def change(self, make: Callable[[T], T]) -> None:
        """Put something else in the place of each."""
        self._of = {user: deque(map(make, waiting)) for user, waiting in self._of.items()}
