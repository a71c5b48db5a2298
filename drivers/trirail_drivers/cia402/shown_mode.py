"""Check that a drive shows its setpoint mode, which some drives do only with power (6061h, CiA 402-2)."""

from __future__ import annotations

import math


class ShownMode:
    """State of one drive's mode display 6061h in the cycle."""

    __slots__ = ("_asked", "_since", "_timeout", "shown")

    def __init__(self, timeout: float) -> None:
        self.shown = True
        """Whether the drive shows the setpoint mode; until then, its own position is sent to it as setpoint."""
        self._timeout = timeout
        self._since = math.inf
        self._asked = False

    def is_next(self, *, alone: bool) -> bool:
        """Whether the mode display is requested next: always if it is requested `alone`, otherwise every other time."""
        self._asked = alone or not self._asked
        return self._asked

    def waited(self, now: float, *, awaited: bool) -> float | None:
        """Return the time for which the drive has had power without showing the mode [s] if it is too long; otherwise
        None.
        """
        if not awaited:
            self._since = math.inf
            return None
        self._since = min(now, self._since)
        return now - self._since if now - self._since > self._timeout else None
