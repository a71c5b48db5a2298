"""Decisions that take longer than a cycle has time for: taken in steps, so that the loop never waits for one."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")

Steps = Generator[None, None, T]
"""Yields where it has cost as much as a cycle may spend on it: one plan, looked at once along its path."""


def finish(steps: Steps[T]) -> T:
    """Take all the steps at once, where nothing is waiting."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]  # typeshed has it untyped
