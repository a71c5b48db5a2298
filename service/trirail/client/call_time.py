"""Time at which a program called the client, which shows if a stop was called later than a request."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from contextvars import ContextVar

_called_at: ContextVar[float | None] = ContextVar("called_at", default=None)


def called_at() -> float:
    """Return the time of the enclosing context `called` on the monotonic clock [s]; the present time if there is none.

    The tasks that are created within the context keep the time.
    """
    at = _called_at.get()
    return time.monotonic() if at is None else at


@contextlib.contextmanager
def called(at: float | None = None) -> Iterator[None]:
    """Make `at` the time of all requests within the context [s]; by default, the time that `called_at` returns."""
    token = _called_at.set(called_at() if at is None else at)
    try:
        yield
    finally:
        _called_at.reset(token)
