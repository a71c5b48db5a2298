"""How fast each user's messages are read: so many at once, and then so many a second."""

from __future__ import annotations

import math

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
