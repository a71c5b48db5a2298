"""Where simulated sliders really are: what a rule beside each rail reads, whatever the encoders say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from trirail_drivers.simulated.servo import Servo


class Mounted(NamedTuple):
    """What a drive really moves, whatever its configuration says."""

    slider: int
    """Index of the slider."""
    counts_per_metre: float
    """Of that slider; below 0 where counts fall as it rises."""


class Carriages:
    """The three sliders and what moves them: each drive one slider, unless its wiring or mechanics is wrong."""

    def __init__(self, servos: Sequence[Servo], counts_per_metre: Sequence[float]) -> None:
        """`counts_per_metre`: negative where counts fall as the slider rises."""
        self._servos = tuple(servos)
        self._scales = tuple(counts_per_metre)
        self._moves = [(index, 1.0) for index in range(len(self._servos))]
        self._seen = [servo.driven for servo in self._servos]
        self._places = [0.0] * len(self._servos)

    def couple(self, index: int, slider: int, ratio: float) -> None:
        """From now on a drive moves that slider, `ratio` times as far as it counts; below 0 the other way."""
        self.read()
        self._moves[index] = slider, ratio

    def read(self) -> tuple[float, ...]:
        """What rules read that were put beside the sliders at power-on, at 0, rising as slider positions do [m]."""
        for index, (servo, scale, (slider, ratio)) in enumerate(
            zip(self._servos, self._scales, self._moves, strict=True)
        ):
            self._places[slider] += ratio * (servo.driven - self._seen[index]) / scale
            self._seen[index] = servo.driven
        return tuple(self._places)

    def push(self, slider: int, by: float) -> None:
        """Push a slider by hand [m]: what is coupled to it turns, and its encoder counts that."""
        for servo, scale, (moved, ratio) in zip(self._servos, self._scales, self._moves, strict=True):
            if moved == slider:
                servo.push(by * scale / ratio)
