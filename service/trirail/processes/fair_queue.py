"""A queue in which users take turns: what one of them has in it is first in, first out, and holds up nobody else's."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, KeysView
from typing import Generic, TypeVar

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
