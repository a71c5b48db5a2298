"""Detection of two nodes with the same node id, a mistake that CiA 301 does not prevent.

There are two signs: two positions answer each SYNC, or one node boots or reports that it is not operational while the
other node still sends positions.
"""

from __future__ import annotations

from typing import Final

from trirail_drivers.driver.axis_row import AxisRow
from trirail_drivers.driver.row_updates import is_far, turns_back
from trirail_drivers.interface import DriveFault

FAR_APART_M: Final = 0.005
"""Distance between two positions after one SYNC above which they must belong to two sliders [m]."""
FAR_SYNCS: Final = 3
"""Number of consecutive SYNCs, each with positions FAR_APART_M apart, that proves that there are two nodes."""
COUNT_WINDOW_SYNCS: Final = 20
"""Number of SYNCs over which SYNCs with two positions are counted, whatever the distance of the positions."""
MAX_DOUBLE_ANSWERS: Final = 15
"""Maximum number of SYNCs, in this window, to which a single node gives two positions.

If every other answer of a node is one cycle late, two positions arrive after every other SYNC.
"""
ANSWERS_AFTER: Final = 3
"""Number of positions that prove that there is another node, after a node has reported that it is not operational.

That node itself sends no PDOs any more, except for one that may have been waiting for the bus.
"""


def warning(node: int, by: str) -> str:
    """Return the warning about two nodes, for people."""
    return f"a second node with id {node} on the bus: {by}; give each its own node id"


class AnswersAfterStop:
    """Detection of positions after a node's boot-up message or heartbeat in a state without PDOs (CiA 301, NMT)."""

    __slots__ = ("_answers", "_fault")

    def __init__(self) -> None:
        self._fault: DriveFault | None = None
        self._answers = 0

    @property
    def idle(self) -> bool:
        """Whether no positions are being counted."""
        return self._fault is None

    def begin(self, fault: DriveFault | None) -> None:
        """Begin to count the positions that arrive with the node's identifier.

        `fault` is the fault to return if the positions prove that there is a second node; None counts nothing.
        """
        if self._fault is None:
            self._fault, self._answers = fault, 0

    def forget(self) -> None:
        """Stop counting, because the node may be started again."""
        self._fault = None

    def end_cycle(self, *, came: bool) -> DriveFault | None:
        """Count a position if `came` says that one arrived in this cycle.

        Return the fault given to `begin` once ANSWERS_AFTER positions prove that there is another node, otherwise None.
        """
        fault = self._fault
        if fault is None:
            return None
        self._answers += came
        if self._answers < ANSWERS_AFTER:
            return None
        self._fault = None
        return fault


class AnswersPerSync:
    """Detection of two positions with the same identifier after one SYNC.

    Two positions may also come from one node: if the bus repeats a frame or a SYNC, the same position arrives again or,
    in motion, a later position. The positions of two sliders alternate, unless the sliders move further in one cycle
    than they are apart.
    """

    __slots__ = ("_counted_from", "_far", "_far_in_a_row", "_row", "_two", "_with_two")

    def __init__(self, row: AxisRow) -> None:
        """`row` contains the newest position and step of the drive."""
        self._row = row
        row.far_apart = abs(row.counts_per_metre) * FAR_APART_M
        self._two = self._far = False
        self._far_in_a_row = self._with_two = 0
        self._counted_from = 0
        """Number of the SYNC at which counting began."""

    def add_position(self, counts: int) -> None:
        """Handle a received position [counts], before it is stored in the row."""
        if self._row.came:
            self._two = self._two or turns_back(self._row, counts)
            self._far = self._far or is_far(self._row, counts)

    @property
    def is_clear(self) -> bool:
        """Whether no recent SYNC had two positions."""
        return not (self._far_in_a_row or self._with_two or self._two or self._far)

    def from_two_nodes(self) -> bool:
        """End a cycle; return whether the positions up to now prove that there are two nodes."""
        self._far_in_a_row = self._far_in_a_row + 1 if self._far else 0
        self._with_two += self._two
        two_nodes = self._far_in_a_row >= FAR_SYNCS or self._with_two > MAX_DOUBLE_ANSWERS
        if two_nodes:
            self._far_in_a_row = 0
        if two_nodes or (self._row.syncs - self._counted_from) % COUNT_WINDOW_SYNCS == 0:
            self._counted_from, self._with_two = self._row.syncs, 0
        self._two = self._far = False
        return two_nodes
