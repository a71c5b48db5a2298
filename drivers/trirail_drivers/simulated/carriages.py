"""Actual positions of the simulated sliders, as a scale along each rail would show them; the encoders may differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from trirail_drivers.simulated.servo import Servo


class DriveMounting(NamedTuple):
    """Slider that a drive actually moves, which may differ from the configured slider."""

    slider: int
    """Index of the slider."""
    counts_per_metre: float
    """Scale of that slider; negative if the counts decrease as its position increases."""


class Carriages:
    """Coupling of the three drives to the three sliders. By default, each drive moves its own slider."""

    def __init__(self, servos: Sequence[Servo], counts_per_metre: Sequence[float]) -> None:
        """`counts_per_metre` is negative if the counts decrease as the slider position increases."""
        self._servos = tuple(servos)
        self._scales = tuple(counts_per_metre)
        self._moves = [(index, 1.0) for index in range(len(self._servos))]
        self._seen = [servo.driven for servo in self._servos]
        self._places = [0.0] * len(self._servos)

    def couple(self, index: int, slider: int, ratio: float) -> None:
        """Couple a drive to a slider. The slider moves `ratio` times as far as the drive counts.

        A negative `ratio` reverses the direction.
        """
        self.read()
        self._moves[index] = slider, ratio

    def read(self) -> tuple[float, ...]:
        """Return the slider positions relative to those at power-on [m]."""
        for index, (servo, scale, (slider, ratio)) in enumerate(
            zip(self._servos, self._scales, self._moves, strict=True)
        ):
            self._places[slider] += ratio * (servo.driven - self._seen[index]) / scale
            self._seen[index] = servo.driven
        return tuple(self._places)

    def push(self, slider: int, by: float) -> None:
        """Push a slider by hand by a distance [m]. The motors coupled to the slider turn, and their encoders count."""
        for servo, scale, (moved, ratio) in zip(self._servos, self._scales, self._moves, strict=True):
            if moved == slider:
                servo.push(by * scale / ratio)
