"""Waiting for what becomes true in its own time."""

from __future__ import annotations

import time
from collections.abc import Callable

WITHIN = 60.0
"""How long a busy machine may take for anything [s]."""


def wait_until(condition: Callable[[], bool], what: str = "", pause: float = 0.002, within: float = WITHIN) -> None:
    """Return as soon as something holds; fail, with `what` it is, where it never does."""
    deadline = time.monotonic() + within
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(pause)
