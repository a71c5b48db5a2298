"""The person beside the robot, as the guide needs one: hears lines, answers questions, may refuse or leave."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from trirail.commissioning.judgement import Judged
from trirail.wire.units import LENGTH, quantity


class Quit(Exception):
    """The person wants to go no further."""


class Question(NamedTuple):
    """What a person is asked."""

    text: str
    default: str | None = None
    """What an empty answer means; None where there is no such thing."""


class Person(Protocol):
    """Who answers. Raises Quit where there are no answers left."""

    def show(self, line: str) -> None:
        """Show a line."""

    def judged(self, judged: Judged) -> None:
        """Show what is thought of a step."""

    def ask(self, question: Question, idle: Callable[[], object]) -> str:
        """Return the answer, stripped and never empty where there is a default; `idle` is called all the while.

        It keeps the drives alive: it must be called at least once a cycle, and itself waits for the next.
        """


def choose(person: Person, idle: Callable[[], object], question: Question, choices: dict[str, str]) -> str:
    """Return which of the choices, each with what it means, is taken; asks until it is one of them. Raises Quit."""
    while True:
        answer = person.ask(question, idle).lower()
        if answer in ("q", "quit"):
            raise Quit
        found = [choice for choice in choices if choice.lower() == answer]
        if found:
            return found[0]
        told = ", ".join(f"{choice} ({means})" for choice, means in choices.items())
        person.show(f'  "{answer}" is no answer here; wanted: {told}, or q to leave')


def length(
    person: Person, idle: Callable[[], object], question: Question, low: float = -10.0, high: float = 10.0
) -> float:
    """Return the length that is answered [m], a bare number in mm; asks until one is within both [m]. Raises Quit."""
    while True:
        answer = person.ask(question, idle)
        if answer.lower() in ("q", "quit"):
            raise Quit
        try:
            value = quantity(answer.replace(",", "."), LENGTH, "mm")
        except ValueError:
            value = float("nan")
        if low <= value <= high:
            return value
        between = f"from {low * 1e3:g} to {high * 1e3:g} mm"
        person.show(f'  "{answer}" is no length {between}; as in: 12.35, 350um, 0.01in (or q to leave)')
