"""Check that a drive shows its setpoint mode (6061h, CiA 402-2). Some drives show it only when they have power."""

from __future__ import annotations

import math


class ShownMode:
    """State of one drive's mode display 6061h in the cycle."""

    __slots__ = ("_asked", "_since", "_timeout", "shown")

    def __init__(self, timeout: float) -> None:
        self.shown = True
        """Whether the drive shows the setpoint mode. Until it does, its own position is sent to it as the setpoint."""
        self._timeout = timeout
        self._since = math.inf
        self._asked = False

    def is_next(self, *, alone: bool) -> bool:
        """Whether to request the mode display next: always if nothing else is requested, otherwise every other time."""
        self._asked = alone or not self._asked
        return self._asked

    def waited(self, now: float, *, awaited: bool) -> float | None:
        """Return how long the drive has had power without showing its mode [s] if that is too long, otherwise None.

        `awaited` is True while the drive has power and does not show its mode.
        """
        if not awaited:
            self._since = math.inf
            return None
        self._since = min(now, self._since)
        return now - self._since if now - self._since > self._timeout else None
