"""Digital outputs 60FEh of a simulated drive, and the objects that a drive needs for digital outputs and inputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from trirail_drivers.simulated.dictionary import Dictionary, ObjectEntry

OUTPUTS = 0x60FE
_NOT_VALID = 1 << 31


class OutputChange(NamedTuple):
    """A change of a drive's outputs."""

    sync: int
    """Number of the SYNC at which it happened, counted from 1."""
    time: float
    """Time by the drive's clock [s]."""
    word: int
    """Physical outputs from then on."""


class DigitalOutputs:
    """Physical outputs: the bits of 60FEh:01 that the mask 60FEh:02 lets through; others keep their state.

    `now` returns the number of SYNCs received and the time [s].
    """

    def __init__(self, objects: Dictionary, now: Callable[[], tuple[int, float]]) -> None:
        self.word = 0
        self.changes: list[OutputChange] = []
        self._now = now
        self.stuck = 0
        """Bits that do not switch: a fault on demand."""
        self._value, self._mask = objects.internal(OUTPUTS, 1), objects.internal(OUTPUTS, 2)
        objects.on_write(OUTPUTS, self._written)

    def _written(self, _entry: ObjectEntry, _old: int) -> None:
        mask = self._mask.value & ~self.stuck
        word = (self.word & ~mask) | (self._value.value & mask)
        if word != self.word:
            self.word = word
            self.changes.append(OutputChange(*self._now(), word))


def add_digital_io(objects: Dictionary, node: int) -> None:
    """Add digital outputs, and a third PDO in each direction, to the objects of a drive that lacks them."""
    objects.add(OUTPUTS, 1, 32, mappable=True)
    objects.add(OUTPUTS, 2, 32)
    for communication, mapping, identifier in ((0x1402, 0x1602, 0x400), (0x1802, 0x1A02, 0x380)):
        objects.add(communication, 1, 32, value=_NOT_VALID | identifier + node)
        objects.add(communication, 2, 8, value=255)
        objects.add(mapping, 0, 8)
        objects.add(mapping, 1, 32)
    objects.add(0x1802, 3, 16)
    objects.add(0x1802, 5, 16)
