"""Whether two nodes have one node id, which CiA 301 has no means against: then each SYNC is answered twice."""

from __future__ import annotations

from typing import Final

APART: Final = 0.005
"""Positions that answer one SYNC and are so far apart [m] are those of two sliders."""
IN_A_ROW: Final = 3
"""So many SYNCs in a row that get such answers are answered by two nodes."""
COUNTED: Final = 20
"""SYNCs over which answers are counted: frames that the bus doubled, or that came a cycle late, are few among them."""


class AnswersPerSync:
    """Counts the positions that come with one identifier, cycle by cycle."""

    __slots__ = ("_apart", "_came", "_cycles", "_newest", "_sliders", "_twice")

    def __init__(self, counts_per_metre: float) -> None:
        self._apart = abs(counts_per_metre) * APART
        self._newest = 0
        self._sliders = self._twice = self._came = self._cycles = 0

    def come(self, counts: int) -> None:
        """A position has come."""
        self._sliders += not self._sliders or abs(counts - self._newest) > self._apart
        self._newest = counts
        self._came += 1

    def from_two_nodes(self) -> bool:
        """Whether the answers of the cycle that is over, with those before it, are two nodes'."""
        self._twice = self._twice + 1 if self._sliders > 1 else 0
        self._sliders = 0
        self._cycles += 1
        found = self._twice >= IN_A_ROW
        if self._cycles == COUNTED:
            found = found or self._came > 1.5 * COUNTED
            self._cycles = self._came = 0
        if found:
            self._twice = 0
        return found
