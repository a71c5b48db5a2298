"""Whether a drive shows the mode that it is to follow setpoints in: some do so only with power (6061h, CiA 402-2)."""

from __future__ import annotations

import math


class ShownMode:
    """What is known of 6061h of one drive, in the cycle."""

    __slots__ = ("_asked", "_since", "_timeout", "shown")

    def __init__(self, timeout: float) -> None:
        self.shown = True
        """It shows the wanted mode; until then it is held where it is."""
        self._timeout = timeout
        self._since = math.inf
        self._asked = False

    def is_next(self, *, alone: bool) -> bool:
        """Whether it is to be asked for next: every time where it is asked for `alone`, else in turn."""
        self._asked = alone or not self._asked
        return self._asked

    def waited(self, now: float, *, awaited: bool) -> float | None:
        """How long the drive has had power without it [s], where that is too long."""
        if not awaited:
            self._since = math.inf
            return None
        self._since = min(now, self._since)
        return now - self._since if now - self._since > self._timeout else None
