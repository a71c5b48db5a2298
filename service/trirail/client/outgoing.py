"""What a program hands to a client becomes a message: any library's numbers and arrays, checked as the service does.

A number is what has `__float__` or `__index__`, as numpy's and fractions have; truth values and texts are none.
"""

from __future__ import annotations

import contextlib
import math
import operator
import sys
import threading
import uuid
from collections.abc import Callable
from typing import Any

import msgspec
from msgspec import structs

from trirail.errors import RefusalCode, RefusedError
from trirail.wire import boundary
from trirail.wire.goals import Goal
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Command, CommandContent


def message(make: Callable[[], msgspec.Struct], kind: Any, what: str) -> bytes:
    """Return what `make` makes, of a kind, as JSON that the service can read. Raises RefusedError, with `what`."""
    try:
        payload = _ENCODER.encode(make())
    except (TypeError, ValueError, ArithmeticError) as error:
        raise RefusedError(RefusalCode.MALFORMED, f"{what}: {quoted(str(error))}") from error
    boundary.decode(payload, kind, what)
    return payload


def id_of(goal: Goal | Callable[[str], Goal]) -> str:
    """Return the id that a goal has, or a new one."""
    return (goal.id if isinstance(goal, Goal) else None) or uuid.uuid4().hex[:12]


def goal_message(make: Goal | Callable[[str], Goal], goal_id: str) -> bytes:
    """Return a goal with an id, or the one that `make` makes for it, as JSON. RefusedError for one that cannot be."""
    with_id = (lambda: structs.replace(make, id=goal_id)) if isinstance(make, Goal) else (lambda: make(goal_id))
    return message(with_id, Goal, "not a goal")


def content_message(name: str, content: CommandContent | bytes | None) -> bytes | None:
    """Return what a command carries, as JSON; None for nothing. Raises RefusedError for what it cannot."""
    if content is None or isinstance(content, bytes):
        return content
    return made_content(Command(name), lambda: content)


def made_content(command: Command, make: Callable[[], CommandContent]) -> bytes:
    """Return what a command carries, as JSON, once it can be made. Raises RefusedError for what it cannot."""
    return message(make, command.accepts, f"not for {command}")


def number(value: object, what: str) -> float:
    """Return a number as Python's own. Raises RefusedError, with `what` it is."""
    try:
        plain = value if isinstance(value, bool) else _plain(value)
        if isinstance(plain, (int, float)) and not isinstance(plain, bool):
            return _finite(float(plain))
    except (TypeError, ValueError, ArithmeticError):
        pass
    raise RefusedError(RefusalCode.MALFORMED, f"{what} is {quoted(repr(value))}: a finite number is wanted")


def seconds(value: object) -> float | None:
    """Return a time-out [s], None for none and for one that is longer than can be waited. Raises RefusedError."""
    if value is None or (isinstance(value, float) and value == math.inf):
        return None
    wait = number(value, "timeout")
    if wait < 0.0:
        raise RefusedError(RefusalCode.MALFORMED, f"timeout is {wait:g} s: 0 or more is wanted, or None for no end")
    return wait if wait < threading.TIMEOUT_MAX else None


def _plain(value: Any) -> Any:
    """Return what a message has for it. Raises TypeError where it has nothing, ValueError for no finite one."""
    numpy = sys.modules.get("numpy")  # who hands over its numbers has imported it
    if numpy is not None and isinstance(value, (numpy.ndarray, numpy.generic)):
        if value.dtype.kind == "f" and not numpy.isfinite(value).all():
            raise ValueError(f"{value!r} is not finite")
        value = value.tolist()  # Python's own numbers, truth values and texts
        if isinstance(value, list | str | bool):
            return value
    for name, convert in (("__index__", operator.index), ("__float__", float)):
        if hasattr(type(value), name):  # float() takes texts as well
            with contextlib.suppress(TypeError):
                return _finite(convert(value))
    raise TypeError(f"{value!r}, of type {type(value).__name__}, is no number")


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"{value} is no finite number")
    return value


_ENCODER = msgspec.json.Encoder(enc_hook=_plain, decimal_format="number")
