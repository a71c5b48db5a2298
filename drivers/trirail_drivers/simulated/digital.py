"""Digital outputs and inputs of a simulated drive (CiA 402-2, 60FEh and 60FDh), and their faults."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from trirail_drivers.simulated.dictionary import Dictionary, ObjectEntry

MAX_CHANGES: Final = 100_000
"""Maximum number of output changes that are kept."""
BOUNCE_TIME_S: Final = 0.005
"""Time for which a bouncing input bounces after an edge [s]."""
BOUNCE_PERIOD_S: Final = 0.0007
"""Interval between the changes of a bouncing input [s]."""
_ALL_BITS: Final = 0xFFFF_FFFF


class OutputChange(NamedTuple):
    """Change of a drive's outputs."""

    time: float
    """Time of the change [s]."""
    sync: int
    """Number of SYNCs received since power-on, including the SYNC at which the change happened."""
    bits: int
    """New state of all outputs, as bits of 60FEh."""
    position: float
    """Position of the drive's axis at the change [counts]."""


class AxisSample(NamedTuple):
    """Present state of the drive, stored with a change of its outputs."""

    time: float
    sync: int
    position: float


class DigitalPins:
    """Digital outputs and inputs of a drive.

    An output has the value of its bit in 60FEh:01 if this bit is set in the mask 60FEh:02, otherwise 0. A drive without
    a mask applies every bit. Values arrive by SDO, or by an RPDO that takes effect at the SYNC.
    """

    def __init__(self, objects: Dictionary, sample: Callable[[], AxisSample]) -> None:
        """`sample` returns the present state of the drive."""
        self._sample = sample
        self._values = objects.internal(0x60FE, 1)
        self._mask = objects.internal(0x60FE, 2, 0 if (0x60FE, 2) in objects else _ALL_BITS)
        self._inputs = objects.internal(0x60FD, 0)
        self.bits = 0
        """Present state of the outputs, as bits of 60FEh."""
        self.history: deque[OutputChange] = deque(maxlen=MAX_CHANGES)
        """Changes of the outputs, the newest last."""
        self._stuck = self._bouncing = self._reserved = 0
        self._pressed = self._before = 0
        self._pressed_at = -BOUNCE_TIME_S
        objects.on_write(0x60FE, self._written)

    def restarted(self) -> None:
        """Set the outputs to their values after power-on. The inputs still show which switches are pressed."""
        self._update()
        self._inputs.value = self._pressed

    def press(self, inputs: int, now: float) -> None:
        """Set all inputs, as bits of 60FDh, at time `now` [s]."""
        self._before, self._pressed, self._pressed_at = self._inputs.value, inputs, now
        self.poll(now)

    def poll(self, now: float) -> None:
        """Let the inputs bounce until time `now` [s]."""
        since = now - self._pressed_at
        value = self._pressed
        if since < BOUNCE_TIME_S and int(since / BOUNCE_PERIOD_S) % 2:
            value ^= (self._before ^ self._pressed) & self._bouncing
        self._inputs.value = value

    def apply_faults(self, *, stuck: int, bouncing: int, reserved: int) -> None:
        """Set the bits that have faults: stuck outputs, bouncing inputs, and outputs that the manufacturer reserves."""
        self._stuck, self._bouncing, self._reserved = stuck, bouncing, reserved
        self._update()

    def _written(self, entry: ObjectEntry, _old: int) -> None:
        entry.value &= ~self._reserved
        self._update()

    def _update(self) -> None:
        wanted = self._values.value & self._mask.value & ~self._reserved
        bits = (wanted & ~self._stuck) | (self.bits & self._stuck)
        if bits != self.bits:
            self.bits = bits
            sample = self._sample()
            self.history.append(OutputChange(sample.time, sample.sync, bits, sample.position))
