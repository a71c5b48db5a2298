"""Whether two nodes have one node id, which CiA 301 has no means against: then each SYNC has two positions."""

from __future__ import annotations

from typing import Final

FAR: Final = 0.005
"""Positions that answer one SYNC and are so far apart [m] are those of two sliders."""
FAR_IN_A_ROW: Final = 3
"""So many SYNCs in a row that have such positions are answered by two nodes."""
COUNTED: Final = 20
"""SYNCs over which those with two positions are counted, however near these are."""
MOST: Final = 15
"""Of them one node's may be so many: where every other answer comes a cycle late, every other SYNC has two."""


class AnswersPerSync:
    """Looks at the positions that come with one identifier, cycle by cycle.

    A frame, or a SYNC, that the bus doubles brings the same position again or, in motion, one further on. Two sliders'
    positions go to and fro, but for motion that is faster than they are apart.
    """

    __slots__ = ("_came", "_counts_far", "_cycles", "_far", "_far_in_a_row", "_newest", "_step", "_two", "_with_two")

    def __init__(self, counts_per_metre: float) -> None:
        self._counts_far = abs(counts_per_metre) * FAR
        self._newest = self._step = 0
        self._came = self._two = self._far = False
        self._far_in_a_row = self._cycles = self._with_two = 0

    def come(self, counts: int) -> None:
        """A position has come."""
        step = counts - self._newest
        if self._came:
            self._two = self._two or step * self._step < 0
            self._far = self._far or abs(step) > self._counts_far
        self._newest, self._step, self._came = counts, step or self._step, True

    def from_two_nodes(self) -> bool:
        """Whether the positions of the cycle that is over, with those before it, are two nodes'."""
        self._far_in_a_row = self._far_in_a_row + 1 if self._far else 0
        self._with_two += self._two
        self._cycles += 1
        found = self._far_in_a_row >= FAR_IN_A_ROW or self._with_two > MOST
        if found:
            self._far_in_a_row = 0
        if found or self._cycles == COUNTED:
            self._cycles = self._with_two = 0
        self._came = self._two = self._far = False
        return found
