"""Messages from a program's values: numbers and arrays of any library, checked as the service checks them.

A number has `__float__` or `__index__`, as do those of numpy and fractions; booleans and strings are not numbers.
"""

from __future__ import annotations

import contextlib
import math
import operator
import sys
import threading
import uuid
from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec
from msgspec import structs

from trirail.errors import RefusalCode, RefusedError
from trirail.wire import boundary
from trirail.wire.goals import Goal, PathGoal, TrajectoryGoal
from trirail.wire.kinds.trajectory import parts
from trirail.wire.sizes import MAX_POINTS
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Command, CommandContent


def message(make: Callable[[], msgspec.Struct], kind: Any, what: str) -> bytes:
    """Return the message of a kind that `make` returns, as JSON for the service. Raises RefusedError, with `what`."""
    try:
        payload = _ENCODER.encode(make())
    except (TypeError, ValueError, ArithmeticError) as error:
        raise RefusedError(RefusalCode.MALFORMED, f"{what}: {quoted(str(error))}") from error
    boundary.decode(payload, kind, what)
    return payload


def id_of(goal: Goal | Callable[[str], Goal]) -> str:
    """Return the id of a goal, or a new one."""
    return (goal.id if isinstance(goal, Goal) else None) or uuid.uuid4().hex[:12]


def goal_message(make: Callable[[str], Goal], goal_id: str) -> bytes:
    """Return the goal that `make` returns for an id, as JSON. Raises RefusedError for an invalid one."""
    return message(lambda: make(goal_id), Goal, "not a goal")


def goal_messages(make: Goal | Callable[[str], Goal], goal_id: str) -> list[bytes]:
    """Return a goal with an id, or the one that `make` returns for it, as JSON in as many messages as needed.

    Raises RefusedError for an invalid goal.
    """
    try:
        goal = structs.replace(make, id=goal_id) if isinstance(make, Goal) else make(goal_id)
        sent = parts(goal) if isinstance(goal, TrajectoryGoal) else [goal]
    except (TypeError, ValueError, ArithmeticError) as error:
        raise RefusedError(RefusalCode.MALFORMED, f"not a goal: {quoted(str(error))}") from error
    if isinstance(goal, TrajectoryGoal) and (why := too_many(len(goal.points))):
        raise RefusedError(RefusalCode.MALFORMED, f"not a goal: points: {why}")
    return [message(partial(_itself, part), Goal, "not a goal") for part in sent]


def check_message(goal: Goal) -> bytes:
    """Return a goal to be checked, as JSON. Raises RefusedError for an invalid one, or one without a path."""
    return message(partial(_itself, goal), PathGoal, "not a goal to check")


def _itself(goal: Goal) -> Goal:
    return goal


def too_many(number: int) -> str:
    """Return why a trajectory with this many points cannot be sent and what to do; "" if it can be sent."""
    if number <= MAX_POINTS:
        return ""
    step = -(-number // MAX_POINTS)
    return (
        f"{number} points exceed the maximum of {MAX_POINTS}: send every {step}th point and the last, since paths are "
        "quintic between points, or send parts that each end at rest"
    )


def content_message(name: str, content: CommandContent | bytes | None) -> bytes | None:
    """Return the content of a command as JSON; None without content. Raises RefusedError for a wrong type."""
    if content is None or isinstance(content, bytes):
        return content
    return made_content(Command(name), lambda: content)


def made_content(command: Command, make: Callable[[], CommandContent]) -> bytes:
    """Return the content of a command that `make` returns, as JSON. Raises RefusedError for an invalid one."""
    return message(make, command.accepts, f"not for {command}")


def number(value: object, what: str) -> float:
    """Return a number as a Python float. Raises RefusedError, with `what` as its name."""
    try:
        plain = value if isinstance(value, bool) else _plain(value)
        if isinstance(plain, (int, float)) and not isinstance(plain, bool):
            return _finite(float(plain))
    except (TypeError, ValueError, ArithmeticError):
        pass
    raise RefusedError(RefusalCode.MALFORMED, f"{what} is {quoted(repr(value))}: expected a finite number")


def seconds(value: object) -> float | None:
    """Return a time-out [s]; None for none, and for one beyond threading.TIMEOUT_MAX. Raises RefusedError."""
    if value is None or (isinstance(value, float) and value == math.inf):
        return None
    wait = number(value, "timeout")
    if wait < 0.0:
        raise RefusedError(
            RefusalCode.MALFORMED, f"timeout is {wait:g} s: expected 0 or more, or None to wait without limit"
        )
    return wait if wait < threading.TIMEOUT_MAX else None


def _plain(value: Any) -> Any:
    """Return a value as a message's type. Raises TypeError if there is none, ValueError if it is not finite."""
    numpy = sys.modules.get("numpy")  # a program with numbers of numpy has imported it
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
