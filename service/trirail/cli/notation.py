"""Parsing and formatting of quantities on the command line; trirail.wire.units does the parsing.

`quantity` accepts the output of `written` and returns the value to its printed digits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Final

import msgspec
from cyclopts import Parameter, Token

from trirail.naming import Labels
from trirail.wire.decoding import converted, prepare
from trirail.wire.state import CorrectionInfo, State
from trirail.wire.text import NAME_RULE, comma_hint, is_name, quoted
from trirail.wire.units import (
    ACCELERATION,
    ANGLE,
    ANGULAR_ACCELERATION,
    ANGULAR_VELOCITY,
    LENGTH,
    PERCENTAGE,
    SIZES,
    TIME,
    VELOCITY,
    Dimension,
    quantity,
)
from trirail.wire.vocabulary import LOWEST_OVERRIDE, Override

prepare(Override)

_NEGATIVE: Final = re.compile(r"-[0-9.]")
LOWEST_SHARE: Final = 1e-3
"""Lowest `speed` of a goal."""
TOOL: Final = "--tool"
"""Option that accepts a point of the platform or its name."""


def written(value: float, unit: str, digits: int, width: int = 0) -> str:
    """Format an SI value in a unit, with `digits` decimals, in a column of width `width`."""
    space = "" if unit == "°" else " "
    return f"{number(value / float(SIZES[unit]), digits):>{width}}{space}{unit}"


def number(value: float, digits: int) -> str:
    """Format a number; a value that rounds to zero has no sign."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def pose(values: Sequence[float], width: int = 0) -> str:
    """Format a pose [m, m, rad] on one line, with its numbers in columns of width `width`."""
    x, y, phi = values
    return f"x {written(x, 'mm', 3, width)}   y {written(y, 'mm', 3, width)}   φ {written(phi, '°', 4, width)}"


def measured_pose(state: State, width: int = 0) -> str:
    """Format the measured pose of a state as `pose` does, or say why it is unknown."""
    measured = state.measured_pose
    return "unknown: not homed" if measured is None else pose(measured, width)


def correction(info: CorrectionInfo, labels: Labels) -> str:
    """Describe the correction of as-built errors on one line."""
    words = []
    if info.file:
        x, y, phi = info.greatest
        most = f"{written(x, 'µm', 1)} in x, {written(y, 'µm', 1)} in y, {written(phi, 'mrad', 3)}"
        words.append(f"{info.file}, measured {info.made}: up to {most}")
    if any(info.backlash):
        each = [f"{name} {written(width, 'µm', 1)}" for name, width in zip(labels, info.backlash, strict=True)]
        words.append(f"backlash of {', '.join(each)}")
    return "; ".join(words)


def numbers(words: Sequence[str]) -> list[str]:
    """Return the words of a command line, prepared for parsing.

    A negative number with a unit, such as -5mm, is not an option, because no option begins with a digit. The two
    lengths of a point after --tool are joined to one word, U,V. Words after -- are not changed.
    """
    end = words.index("--") if "--" in words else len(words)
    read: list[str] = []
    for word in words[:end]:
        point = len(read) >= 2 and read[-2] == TOOL and is_length(read[-1]) and is_length(word)
        if point:
            read[-1] += f",{word}"
        else:
            read.append(f" {word}" if _NEGATIVE.match(word) else word)
    return read + list(words[end:])


def is_length(word: str) -> bool:
    """Return whether a word of the command line is a length."""
    try:
        quantity(word, LENGTH)
    except ValueError:
        return False
    return True


def share(text: str) -> float:
    """Parse a share of full speed from a number or a percentage. Raises ValueError with the allowed values."""
    try:
        value = quantity(text, PERCENTAGE) / (100.0 if text.strip().endswith("%") else 1.0)
    except ValueError:
        value = math.nan
    if not LOWEST_SHARE <= value <= 1.0:
        raise ValueError(
            f"{quoted(text.strip())!r} is not a share of the limits: use {LOWEST_SHARE} to 1, or {LOWEST_SHARE:.1%} to "
            "100%" + comma_hint(text)
        )
    return value


def percent(text: str) -> float:
    """Parse an override [%] from a number or a percentage. Raises ValueError with the allowed values."""
    try:
        value = quantity(text, PERCENTAGE)
        converted({"percent": value}, Override)
    except (ValueError, msgspec.ValidationError):
        raise ValueError(
            f"{quoted(text.strip())!r} is not an override: use 0, or {LOWEST_OVERRIDE:g} to 200 %{comma_hint(text)}"
        ) from None
    return value


def positive(text: str, dimension: Dimension) -> float:
    """Parse a quantity that must not be negative. Raises ValueError with examples of allowed values."""
    value = quantity(text, dimension)
    if value < 0.0:
        raise ValueError(f"{quoted(text.strip())!r} is negative: use {dimension.name} such as {dimension.examples}")
    return value


def radians(text: str, deg: bool, dimension: Dimension = ANGLE) -> float:
    """Return an angle or its rate in radians; a bare number is in degrees if `deg` is set."""
    return quantity(text, dimension, next(iter(dimension.units)).replace("rad", "deg") if deg else None)


AT_REST: Final = (0.0, 0.0, "0")


def _one(read: Callable[[str], object]) -> Parameter:
    """Return a parameter that converts one word of the command line with `read`."""

    def convert(_: Any, tokens: Sequence[Token]) -> object:
        return read(tokens[0].value)

    return Parameter(converter=convert, n_tokens=1, negative="")


def _angle(text: str, dimension: Dimension = ANGLE) -> str:
    """Return the text of an angle after checking it; --deg determines the unit of a bare number later."""
    quantity(text, dimension)
    return text


def _angles(_: Any, tokens: Sequence[Token]) -> tuple[str, ...]:
    return tuple(_angle(token.value) for token in tokens)


def _tool(text: str) -> tuple[float, float] | str:
    """Parse a point of the platform from U,V, or return its name."""
    u, comma, v = text.partition(",")
    if comma:
        return quantity(u, LENGTH), quantity(v, LENGTH)
    if is_length(text) and not is_name(text):
        raise ValueError(
            f"{quoted(text.strip())!r} is only half a point: give U V, such as 20mm 0, or a name of [frames.tool]"
        )
    if not is_name(text):
        raise ValueError(f"{quoted(text.strip())!r} is neither a point, such as 20mm 0, nor a name: {NAME_RULE}")
    return text


def _three(along: Dimension, turning: Dimension) -> Parameter:
    """Return a parameter that converts three words: two along x and y, and one about φ."""

    def convert(_: Any, tokens: Sequence[Token]) -> tuple[float, float, str]:
        x, y, phi = (token.value for token in tokens)
        return quantity(x, along), quantity(y, along), _angle(phi, turning)

    return Parameter(converter=convert, negative="", show_default=False)


Length = Annotated[float, _one(lambda text: quantity(text, LENGTH))]
"""Length on the command line [m]."""
Velocity = Annotated[float, _one(lambda text: quantity(text, VELOCITY))]
"""Velocity on the command line [m/s]."""
AngularVelocity = Annotated[float, _one(lambda text: quantity(text, ANGULAR_VELOCITY))]
"""Angular velocity on the command line [rad/s]."""
Distance = Annotated[float, _one(lambda text: positive(text, LENGTH))]
"""Non-negative length [m]."""
Time = Annotated[float, _one(lambda text: positive(text, TIME))]
"""Non-negative time [s]."""
Percent = Annotated[float, _one(percent)]
"""An override [%]."""
Share = Annotated[float, _one(share)]
"""A share of full speed."""
ToolPoint = Annotated[tuple[float, float] | str, _one(_tool)]
"""Point of the platform in the platform's frame [m], or the name of a point in [frames.tool]."""
Angle = Annotated[str, _one(_angle)]
"""Angle on the command line; `radians` converts it."""
Angles = Annotated[
    tuple[str, ...], Parameter(converter=_angles, consume_multiple=True, negative="", show_default=False)
]
"""Any number of angles."""
PoseWay = Annotated[tuple[float, float, str], _three(LENGTH, ANGLE)]
"""A displacement in x, y [m] and φ."""
PoseVelocity = Annotated[tuple[float, float, str], _three(VELOCITY, ANGULAR_VELOCITY)]
"""A velocity in x, y [m/s] and φ."""
PoseAcceleration = Annotated[tuple[float, float, str], _three(ACCELERATION, ANGULAR_ACCELERATION)]
"""An acceleration in x, y [m/s²] and φ."""


OF_THREE: Final = ("goto", "move", "sliders", "jog", "ik", "fk")
"""Commands that take three numbers, or poses of three numbers."""
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?[^\d,;]*", re.IGNORECASE)


def spread(words: Sequence[str]) -> list[str]:
    """Split words such as 10mm,20mm,5deg into three, and remove commas after numbers.

    A word with two numbers, such as 10,5, is not split, because the comma may be meant as a decimal comma. The parser
    of the word reports this.
    """
    if not words or words[0] not in OF_THREE:
        return list(words)
    return [part for place, word in enumerate(words) for part in _parts(word, words[place - 1])]


def _parts(word: str, before: str) -> Iterator[str]:
    parts = [part.strip() for part in word.rstrip(",;").replace(";", ",").split(",")]
    if before != TOOL and len(parts) in (1, 3) and all(map(_NUMBER.fullmatch, parts)):
        yield from parts
    else:
        yield word
