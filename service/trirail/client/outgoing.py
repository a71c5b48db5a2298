"""Encoding of a program's values as messages, with the checks that the service applies to the messages.

Numbers and arrays of any library are accepted. A number is any object with `__float__` or `__index__`, such as the
numbers of numpy and fractions; booleans and strings are not numbers.
"""

from __future__ import annotations

import math
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
from trirail.wire.plain_values import finite, plain_value
from trirail.wire.sizes import MAX_POINTS
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Command, CommandContent, Stop


def message(make: Callable[[], msgspec.Struct], kind: Any, what: str) -> bytes:
    """Return the message that `make` returns, as JSON.

    Raises RefusedError if the message is not a valid message of `kind`; the error message begins with `what`.
    """
    try:
        payload = _ENCODER.encode(make())
    except (TypeError, ValueError, ArithmeticError) as error:
        raise RefusedError(RefusalCode.MALFORMED, f"{what}: {quoted(str(error))}") from error
    boundary.decode(payload, kind, what)
    return payload


def id_of(goal: Goal | Callable[[str], Goal]) -> str:
    """Return the id of a goal; a new id if the goal has none."""
    return (goal.id if isinstance(goal, Goal) else None) or uuid.uuid4().hex[:12]


def goal_message(make: Callable[[str], Goal], goal_id: str) -> bytes:
    """Return the goal that `make` returns for an id, as JSON. Raises RefusedError if the goal is invalid."""
    return message(lambda: make(goal_id), Goal, "not a goal")


def goal_messages(make: Goal | Callable[[str], Goal], goal_id: str) -> list[bytes]:
    """Return a goal as JSON, split into as many messages as needed.

    `make` is the goal, or a function that returns the goal for an id. Raises RefusedError if the goal is invalid.
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
    """Return a goal to be checked, as JSON. Raises RefusedError if the goal is invalid or has no path."""
    return message(partial(_itself, goal), PathGoal, "not a goal to check")


def _itself(goal: Goal) -> Goal:
    return goal


def too_many(number: int) -> str:
    """Return an error message with a remedy if a trajectory has too many points to be sent; otherwise ""."""
    if number <= MAX_POINTS:
        return ""
    step = -(-(number - 1) // (MAX_POINTS - 1))
    return (
        f"{number} points exceed the maximum of {MAX_POINTS}: send one in {step} points and the last, since paths "
        "are quintic between points, or send parts that each end at rest"
    )


def content_message(name: str, content: CommandContent | bytes | None) -> bytes | None:
    """Return the content of a command as JSON; None if `content` is None.

    Raises RefusedError for an unknown command, or if the command does not accept this content. Content that is already
    JSON is not checked.
    """
    command = boundary.command_named(name)
    if content is None or isinstance(content, bytes):
        return content
    return made_content(command, lambda: content)


def stops_everything(command: Command, payload: bytes | None) -> bool:
    """Return False if the content of a command that stops the robot restricts it to a single goal."""
    try:
        content = boundary.decode(payload or b"", command.accepts, command)
    except RefusedError:
        return True  # the service carries out a stop with any content
    return not isinstance(content, Stop) or content.goal is None


def made_content(command: Command, make: Callable[[], CommandContent]) -> bytes:
    """Return the command content that `make` returns, as JSON. Raises RefusedError if the content is invalid."""
    return message(make, command.accepts, f"not for {command}")


def number(value: object, what: str) -> float:
    """Return a number as a Python float.

    Raises RefusedError if the value is not a finite number; the error message calls the value `what`.
    """
    try:
        plain = value if isinstance(value, bool) else plain_value(value)
        if isinstance(plain, (int, float)) and not isinstance(plain, bool):
            return finite(float(plain))
    except (TypeError, ValueError, ArithmeticError):
        pass
    raise RefusedError(RefusalCode.MALFORMED, f"{what} is {quoted(repr(value))}: expected a finite number")


def seconds(value: object) -> float | None:
    """Return a time-out [s]; None if there is no time-out or it is longer than threading.TIMEOUT_MAX.

    Raises RefusedError if the value is not a number or is negative.
    """
    if value is None or (isinstance(value, float) and value == math.inf):
        return None
    wait = number(value, "timeout")
    if wait < 0.0:
        raise RefusedError(
            RefusalCode.MALFORMED, f"timeout is {wait:g} s: expected 0 or more, or None to wait without limit"
        )
    return wait if wait < threading.TIMEOUT_MAX else None


_ENCODER = msgspec.json.Encoder(enc_hook=plain_value, decimal_format="number")
