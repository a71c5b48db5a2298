"""Questions to the person at the robot about observations and readings; simulated drives propose the answers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from trirail_drivers.interface import NAMES, Triple
from trirail_drivers.simulated import Carriages

from trirail.commissioning.bench import MAX_FOLLOWING_ERROR_M
from trirail.commissioning.moves import TEST_DISTANCE_M
from trirail.commissioning.person import Operator, Question, ask_choice, ask_length
from trirail.kinematics.arrays import Array
from trirail.naming import Labels

MIN_VISIBLE_TRAVEL_M = 0.00005
"""Travel of a simulated slider above which a person would see that the slider moves [m]."""

RuleReadings = tuple[float, ...]
"""Readings of the rules at the sliders A, B, C [m]."""


Reading = tuple[float, Triple]
"""Reading of the rule at one slider, and the positions that all drives measure [m]."""


def subtract(after: Reading, before: Reading) -> Reading:
    """Return the differences of two readings, `after` minus `before`."""
    a, b, c = (now - was for now, was in zip(after[1], before[1], strict=True))
    return after[0] - before[0], (a, b, c)


class Observer:
    """Asker of questions to a person about quantities that no encoder measures."""

    def __init__(
        self, operator: Operator, simulated: Carriages | None, idle: Callable[[], object], labels: Labels = NAMES
    ) -> None:
        """Create the observer. `idle` is called repeatedly while the program waits for an answer."""
        self._operator = operator
        self._simulated = simulated
        self._idle = idle
        self._labels = labels
        self._rule_resolution: float | None = None

    def read_rules(self) -> RuleReadings | None:
        """Return the readings of the simulated rules; None if the drives are real."""
        return None if self._simulated is None else self._simulated.read()

    def ask_rule_resolution(self) -> float:
        """Return the resolution of the rule [m]; ask the person only in the first call."""
        if self._rule_resolution is None:
            text = "To how many mm can you read your rule or dial gauge? (steel rule 0.5, dial gauge 0.01)"
            question = Question(text, None if self._simulated is None else "0.01")
            self._rule_resolution = ask_length(self._operator, self._idle, question, 1e-7, 5e-3)
        return self._rule_resolution

    def ask_rule(self, index: int) -> float:
        """Ask for the reading of the rule at a slider [m]."""
        rules = self.read_rules()
        text = f"What does the rule at slider {self._labels[index]} read now, in mm?"
        return self._ask_mm(text, None if rules is None else rules[index])

    def ask_instrument_resolution(self) -> float:
        """Ask for the resolution of the instrument that measures the mark on the platform [m]."""
        text = "To how many mm can you read the instrument? (dial gauge 0.001, microscope 0.005)"
        question = Question(text, None if self._simulated is None else "0.001")
        return ask_length(self._operator, self._idle, question, 1e-8, 5e-3)

    def ask_ready(self, text: str) -> None:
        """Ask until the person confirms that a motion may start. Raises QuitRequest if the person quits."""
        question = Question(f"{text} Enter starts the motion, q quits:", "y")
        ask_choice(self._operator, self._idle, question, {"y": "start the motion"})

    def ask_mark(self, axis: str, simulated: float | None) -> float:
        """Ask for the reading of the instrument along `axis` [m]. `simulated` is the proposed answer, if any [m]."""
        default = None if simulated is None else f"{simulated * 1e3 + 0.0:.4f}"
        question = Question(f"What does the instrument read along {axis} now, in mm?", default)
        return ask_length(self._operator, self._idle, question)

    def _ask_mm(self, text: str, simulated: float | None) -> float:
        """Ask for a length in mm; return it in metres. `simulated` is the proposed answer, if any [m]."""
        default = None if simulated is None else f"{simulated * 1e3 + 0.0:.2f}"
        return ask_length(self._operator, self._idle, Question(text, default))

    def ask_travel(
        self, name: str, slider: str, before: float, was: RuleReadings | None, now: RuleReadings | None, verb: str
    ) -> float:
        """Ask for the travel of `slider` [m].

        The rule is at the slider of the drive `name`, and read `before` [m] before the motion. If another slider has
        moved, the person estimates the travel. `was` and `now` are the readings of simulated rules before and after the
        motion, which propose the answer. `verb` describes the motion in the question.
        """
        index = NAMES.index(slider)
        if slider == name:
            return self.ask_rule(index) - before
        label = self._labels[NAMES.index(slider)]
        text = f"How far did slider {label} {verb}, in mm, above 0 in its positive direction?"
        return self._ask_mm(text, now[index] - was[index] if now and was else None)

    def ask_moved_slider(self, before: RuleReadings | None, now: RuleReadings | None) -> str | None:
        """Ask which slider has moved; return A, B or C, or None if no slider has moved.

        `before` and `now` are the readings of simulated rules before and after the motion, which propose the answer.
        """
        default, text = None, f"Which slider moved: {', '.join(self._labels)}, or n for none?"
        if before is not None and now is not None:
            travels = [abs(after - was) for after, was in zip(now, before, strict=True)]
            largest = travels.index(max(travels))
            default = self._labels[largest] if travels[largest] > MIN_VISIBLE_TRAVEL_M else "n"
        choices = {each: f"slider {each}" for each in self._labels} | {"n": "none of them"}
        answer = ask_choice(self._operator, self._idle, Question(text, default), choices)
        return None if answer == "n" else NAMES[self._labels.index(answer)]

    def ask_yes_no(self, text: str) -> bool:
        """Ask a question; return True if the answer is yes. Simulated drives propose yes."""
        return self._ask_yes_no(text, None if self._simulated is None else "y")

    def ask_square(self, expected: Array, before: RuleReadings | None, corner: RuleReadings | None) -> bool:
        """Ask whether the platform moved around its square. Return True if the answer is yes.

        `before` and `corner` are the readings of simulated rules at the start and at the opposite corner, which propose
        the answer. `expected` is the expected difference of these readings, (3,) [m].
        """
        default = None
        if before is not None and corner is not None:
            moved = np.array(corner) - np.array(before)
            default = "y" if np.abs(moved - expected).max() < MAX_FOLLOWING_ERROR_M else "n"
        return self._ask_yes_no(
            f"Did the platform move {TEST_DISTANCE_M * 1e3:g} mm along x, then along y, then back both?", default
        )

    def _ask_yes_no(self, text: str, default: str | None) -> bool:
        question = Question(f"{text} y/n", default)
        return ask_choice(self._operator, self._idle, question, {"y": "yes", "n": "no"}) == "y"
