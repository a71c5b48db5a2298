"""Detection of two nodes with the same node id, a mistake that neither CiA 301 nor CANSimple prevents.

Two positions answer each SYNC, or each request for a position.
"""

from __future__ import annotations

from typing import Final

from trirail_drivers.driver.axis_row import AxisRow
from trirail_drivers.driver.row_updates import is_far, turns_back

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


def warning(node: int, by: str) -> str:
    """Return the warning about two nodes, for people."""
    return f"a second node with id {node} on the bus: {by}; give each its own node id"


def far_apart(row: AxisRow) -> float:
    """Return FAR_APART_M in the units of a drive."""
    return abs(row.counts_per_metre) * FAR_APART_M


class AnswersPerSync:
    """Detection of two positions with the same identifier after one SYNC, or one request.

    Two positions may also come from one node: if the bus repeats a frame or a SYNC, the same position arrives again or,
    in motion, a later position. The positions of two sliders alternate, unless the sliders move further in one cycle
    than they are apart.
    """

    __slots__ = ("_counted_from", "_far", "_far_in_a_row", "_row", "_two", "_with_two")

    def __init__(self, row: AxisRow) -> None:
        """`row` contains the newest position and step of the drive."""
        self._row = row
        row.far_apart = far_apart(row)
        self._two = self._far = False
        self._far_in_a_row = self._with_two = 0
        self._counted_from = 0
        """Number of the SYNC at which counting began."""

    def add_position(self, place: float) -> None:
        """Handle a received position in drive units, before it is stored in the row."""
        if self._row.came:
            # The last bits of a float are noise, which turns back.
            self._two = self._two or (not self._row.floats and turns_back(self._row, place))
            self._far = self._far or is_far(self._row, place)

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
