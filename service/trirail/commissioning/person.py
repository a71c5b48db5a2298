"""Interface to the person at the robot, with lines to show and questions to ask."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from trirail.commissioning.judgement import Judgement
from trirail.wire.units import LENGTH, quantity


class QuitRequest(Exception):
    """Exception raised when the person ends the commissioning."""


class Question(NamedTuple):
    """Question to a person."""

    text: str
    default: str | None = None
    """Answer that replaces an empty answer; None if an empty answer is not allowed."""


class Operator(Protocol):
    """Interface to the person who answers questions. Raises QuitRequest if there can be no more answers."""

    def show(self, line: str) -> None:
        """Show a line."""

    def show_judgement(self, judgement: Judgement) -> None:
        """Show the judgement of a step."""

    def ask(self, question: Question, idle: Callable[[], object]) -> str:
        """Ask a question; return the answer without surrounding blanks, or the default for an empty answer.

        `idle` runs one cycle of the drives, and includes the wait for the next cycle. It must be called repeatedly, at
        least once in each cycle, until the person has answered.
        """


def ask_choice(operator: Operator, idle: Callable[[], object], question: Question, choices: dict[str, str]) -> str:
    """Ask a question until the answer is one of the choices; return this choice.

    `choices` maps each allowed answer to its meaning. Raises QuitRequest if the answer is q or quit.
    """
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
    """Ask a question until the answer is a length from `low` to `high` [m]; return the length [m].

    An answer without a unit is in mm. Raises QuitRequest if the answer is q or quit.
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
