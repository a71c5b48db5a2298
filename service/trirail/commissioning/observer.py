"""What a person beside the robot sees and reads; beside simulated drives, what they would answer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from trirail_drivers.interface import NAMES, Triple
from trirail_drivers.simulated import Carriages

from trirail.commissioning.bench import FOLLOWING
from trirail.commissioning.moves import DISTANCE
from trirail.commissioning.person import Person, Question, choose, length
from trirail.kinematics.arrays import Array
from trirail.naming import Labels

SEEN = 0.00005
"""How far a simulated slider must have gone for somebody to see it [m]."""

Rules = tuple[float, ...]
"""What rules beside the sliders A, B, C read [m]."""


Reading = tuple[float, Triple]
"""What the rule reads at a slider, and where the drives say that theirs are [m]."""


def apart(one: Reading, other: Reading) -> Reading:
    """Return how far it is from one reading to another."""
    a, b, c = (now - was for now, was in zip(other[1], one[1], strict=True))
    return other[0] - one[0], (a, b, c)


class Observer:
    """Asks a person for what no encoder tells."""

    def __init__(
        self, person: Person, simulated: Carriages | None, idle: Callable[[], object], labels: Labels = NAMES
    ) -> None:
        """`idle` is called while the person thinks."""
        self._person = person
        self._simulated = simulated
        self._idle = idle
        self._labels = labels
        self._read_to: float | None = None

    def rules(self) -> Rules | None:
        """Return what rules read; None where only the person can tell."""
        return None if self._simulated is None else self._simulated.read()

    def read_to(self) -> float:
        """Return how finely the rule can be read [m]; asked once."""
        if self._read_to is None:
            text = "To how many mm can you read your rule or indicator? (a steel rule 0.5, a dial indicator 0.01)"
            question = Question(text, None if self._simulated is None else "0.01")
            self._read_to = length(self._person, self._idle, question, 1e-7, 5e-3)
        return self._read_to

    def reading(self, index: int) -> float:
        """Return what the rule beside a slider reads [m]."""
        rules = self.rules()
        text = f"What does the rule at slider {self._labels[index]} read now, in mm?"
        return self.length(text, None if rules is None else rules[index])

    def instrument(self) -> float:
        """Return how finely an instrument beside the platform can be read [m]."""
        text = "To how many mm can you read the instrument? (a dial gauge 0.001, a microscope 0.005)"
        question = Question(text, None if self._simulated is None else "0.001")
        return length(self._person, self._idle, question, 1e-8, 5e-3)

    def mark(self, axis: str, simulated: float | None) -> float:
        """Return what an instrument reads along an axis at a mark on the platform [m]."""
        default = None if simulated is None else f"{simulated * 1e3 + 0.0:.4f}"
        question = Question(f"What does the instrument read along {axis} now, in mm?", default)
        return length(self._person, self._idle, question)

    def length(self, text: str, simulated: float | None) -> float:
        """Return a length that is asked for in mm [m]."""
        default = None if simulated is None else f"{simulated * 1e3 + 0.0:.2f}"
        return length(self._person, self._idle, Question(text, default))

    def gone(self, name: str, slider: str, before: float, was: Rules | None, now: Rules | None, verb: str) -> float:
        """Return how far a slider went [m]: its drive's own since the rule read `before`, another one's as is told."""
        index = NAMES.index(slider)
        if slider == name:
            return self.reading(index) - before
        text = (
            f"How far did slider {self._labels[NAMES.index(slider)]} {verb}, in mm, above 0 in its positive direction?"
        )
        return self.length(text, now[index] - was[index] if now and was else None)

    def which(self, before: Rules | None, now: Rules | None) -> str | None:
        """Ask which slider has moved, from what rules read before to what they read now."""
        default, text = None, f"Which slider moved: {', '.join(self._labels)}, or n for none?"
        if before is not None and now is not None:
            ways = [abs(here - was) for here, was in zip(now, before, strict=True)]
            most = ways.index(max(ways))
            default = self._labels[most] if ways[most] > SEEN else "n"
        choices = {each: f"slider {each}" for each in self._labels} | {"n": "none of them"}
        answer = choose(self._person, self._idle, Question(text, default), choices)
        return None if answer == "n" else NAMES[self._labels.index(answer)]

    def yes(self, text: str) -> bool:
        """Ask what can be answered by yes or no."""
        return self._agrees(text, None if self._simulated is None else "y")

    def square(self, wanted: Array, before: Rules | None, corner: Rules | None) -> bool:
        """Ask whether the platform went around; simulated sliders are compared at its far corner, `wanted` (3,) [m]."""
        default = None
        if before is not None and corner is not None:
            went = np.array(corner) - np.array(before)
            default = "y" if np.abs(went - wanted).max() < FOLLOWING else "n"
        return self._agrees(
            f"Did the platform go {DISTANCE * 1e3:g} mm along x, then along y, then back both?", default
        )

    def _agrees(self, text: str, default: str | None) -> bool:
        question = Question(f"{text} y/n", default)
        return choose(self._person, self._idle, question, {"y": "yes", "n": "no"}) == "y"
