"""Whether two nodes have one node id, which CiA 301 has no means against.

Then each SYNC has two positions; or one node boots, or is not operational, and the other goes on with its positions.
"""

from __future__ import annotations

from typing import Final

from trirail_drivers.driver.axis_row import AxisRow
from trirail_drivers.interface import DriveFault

FAR: Final = 0.005
"""Positions that answer one SYNC and are so far apart [m] are those of two sliders."""
FAR_IN_A_ROW: Final = 3
"""So many SYNCs in a row that have such positions are answered by two nodes."""
COUNTED: Final = 20
"""SYNCs over which those with two positions are counted, however near these are."""
MOST: Final = 15
"""Of them one node's may be so many: where every other answer comes a cycle late, every other SYNC has two."""
ANSWERS_AFTER: Final = 3
"""So many SYNCs that are answered after a node was heard to be not operational are answered by another: the PDOs of the
one have ended, but for one that was on its way."""


def warning(node: int, by: str) -> str:
    """What people are to know of it."""
    return f"a second node with id {node} on the bus: {by}; give each its own node id"


class AnswersAfter:
    """Whether positions go on after a boot-up message, or a heartbeat of a node that sends none (CiA 301, NMT)."""

    __slots__ = ("_answers", "_said")

    def __init__(self) -> None:
        self._said: DriveFault | None = None
        self._answers = 0

    @property
    def idle(self) -> bool:
        """Whether nothing is looked for."""
        return self._said is None

    def begin(self, said: DriveFault | None) -> None:
        """Count from now on; `said` is what was told of the node."""
        if self._said is None:
            self._said, self._answers = said, 0

    def forget(self) -> None:
        """Look no more: the node may be started again."""
        self._said = None

    def of_another(self, *, came: bool) -> DriveFault | None:
        """After a cycle in which a position came or not: what was told of a node, where another one has gone on."""
        said = self._said
        if said is None:
            return None
        self._answers += came
        if self._answers < ANSWERS_AFTER:
            return None
        self._said = None
        return said


class AnswersPerSync:
    """Looks at the positions that come with one identifier, cycle by cycle.

    A frame, or a SYNC, that the bus doubles brings the same position again or, in motion, one further on. Two sliders'
    positions go to and fro, but for motion that is faster than they are apart.
    """

    __slots__ = ("_counted_from", "_counts_far", "_far", "_far_in_a_row", "_row", "_two", "_with_two")

    def __init__(self, row: AxisRow) -> None:
        """`row` is where the positions that come are noted."""
        self._row = row
        self._counts_far = abs(row.counts_per_metre) * FAR
        self._two = self._far = False
        self._far_in_a_row = self._with_two = 0
        self._counted_from = 0
        """The number of a SYNC."""

    def come(self, counts: int) -> None:
        """A position comes."""
        row = self._row
        step, before = counts - row.newest, row.step
        if row.came:
            self._two = self._two or step * before < 0
            self._far = self._far or abs(step) > self._counts_far
        row.newest, row.step = counts, step or before

    @property
    def calm(self) -> bool:
        """Whether no SYNC has had two positions lately."""
        return not (self._far_in_a_row or self._with_two or self._two or self._far)

    def from_two_nodes(self) -> bool:
        """Whether the positions of the cycle that is over, with those before it, are two nodes'."""
        self._far_in_a_row = self._far_in_a_row + 1 if self._far else 0
        self._with_two += self._two
        found = self._far_in_a_row >= FAR_IN_A_ROW or self._with_two > MOST
        if found:
            self._far_in_a_row = 0
        if found or (self._row.syncs - self._counted_from) % COUNTED == 0:
            self._counted_from, self._with_two = self._row.syncs, 0
        self._two = self._far = False
        return found
