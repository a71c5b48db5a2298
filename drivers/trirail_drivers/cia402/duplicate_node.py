"""Detection of another node with a drive's node id by positions that arrive after the drive has stopped."""

from __future__ import annotations

from typing import Final

from trirail_drivers.interface import DriveFault

ANSWERS_AFTER: Final = 3
"""Number of positions that prove that there is another node, after a node has reported that it is not operational.

That node itself sends no PDOs any more, except for one that may have been waiting for the bus.
"""


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
