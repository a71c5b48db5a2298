"""Interface to the person beside the robot: lines to show and questions to ask."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from trirail.commissioning.judgement import Judgement
from trirail.wire.units import LENGTH, quantity


class QuitRequest(Exception):
    """Raised when the person ends the commissioning."""


class Question(NamedTuple):
    """Question to a person."""

    text: str
    default: str | None = None
    """Meaning of an empty answer; None if an answer is required."""


class Operator(Protocol):
    """Person who answers. Raises QuitRequest when there are no more answers."""

    def show(self, line: str) -> None:
        """Show a line."""

    def show_judgement(self, judgement: Judgement) -> None:
        """Show the judgement of a step."""

    def ask(self, question: Question, idle: Callable[[], object]) -> str:
        """Return the answer, stripped; never empty if there is a default.

        `idle` keeps the drives alive: it must be called at least once per cycle, and waits for the next one itself.
        """


def ask_choice(operator: Operator, idle: Callable[[], object], question: Question, choices: dict[str, str]) -> str:
    """Return one of the choices, which map an answer to its meaning; ask until it is one. Raises QuitRequest."""
    while True:
        answer = operator.ask(question, idle).lower()
        if answer in ("q", "quit"):
            raise QuitRequest
        matches = [choice for choice in choices if choice.lower() == answer]
        if matches:
            return matches[0]
        meanings = ", ".join(f"{choice} ({meaning})" for choice, meaning in choices.items())
        operator.show(f'  "{answer}" is not an answer; expected: {meanings}, or q to quit')


def ask_length(
    operator: Operator, idle: Callable[[], object], question: Question, low: float = -10.0, high: float = 10.0
) -> float:
    """Return a length [m] between both bounds, typed in mm unless it has a unit; ask until it is valid.

    Raises QuitRequest.
    """
    while True:
        answer = operator.ask(question, idle)
        if answer.lower() in ("q", "quit"):
            raise QuitRequest
        try:
            value = quantity(answer.replace(",", "."), LENGTH, "mm")
        except ValueError:
            value = float("nan")
        if low <= value <= high:
            return value
        bounds = f"from {low * 1e3:g} to {high * 1e3:g} mm"
        operator.show(f'  "{answer}" is no length {bounds}; examples: 12.35, 350um, 0.01in (or q to quit)')
