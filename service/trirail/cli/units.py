"""Quantities as people write and read them: 5mm, -0.2in, 1.5deg, 10mrad, 20mm/s. Bare numbers are SI.

What `written` prints is taken by `quantity` again, to its printed digits. Units are decimal numbers, so that 5mm is the
same number as 0.005.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal
from typing import Annotated, Any, Final, NamedTuple

import msgspec
from cyclopts import Parameter, Token

from trirail.naming import Labels
from trirail.wire.decoding import converted, prepare
from trirail.wire.state import CorrectionTold
from trirail.wire.text import NAME_RULE, NUMBER, comma_hint, is_name, quoted
from trirail.wire.vocabulary import LOWEST_OVERRIDE, Override

prepare(Override)

_DEGREE: Final = Decimal("0.0174532925199432957692369076848861271344")
"""π / 180, to more digits than a float has."""
_WRITTEN: Final = re.compile(rf"\s*({NUMBER})\s*(.*?)\s*")
_NEGATIVE: Final = re.compile(r"-[0-9.]")
LOWEST_SHARE: Final = 1e-3
"""Least `speed` of a goal."""
TOOL: Final = "--tool"
"""The option that takes a point of the platform, or its name."""


class Dimension(NamedTuple):
    """What a quantity is of."""

    name: str
    """With its article, for people."""
    units: Mapping[str, Decimal]
    """Every unit by its symbol, in SI; a bare number has the first one."""
    examples: str


def _per(units: Mapping[str, Decimal], *times: str) -> dict[str, Decimal]:
    return {unit + time: size for unit, size in units.items() for time in times}


_METRES: Final = {
    "m": Decimal(1),
    "cm": Decimal("0.01"),
    "mm": Decimal("0.001"),
    "µm": Decimal("1e-6"),  # the micro sign of keyboards
    "μm": Decimal("1e-6"),  # the Greek letter
    "um": Decimal("1e-6"),
    "nm": Decimal("1e-9"),
    "in": Decimal("0.0254"),
}
_RADIANS: Final = {
    "rad": Decimal(1),
    "mrad": Decimal("0.001"),
    "µrad": Decimal("1e-6"),
    "μrad": Decimal("1e-6"),
    "urad": Decimal("1e-6"),
    "deg": _DEGREE,
    "°": _DEGREE,
    "arcmin": _DEGREE / 60,
    "arcsec": _DEGREE / 3600,
}
_SECONDS: Final = {
    "s": Decimal(1),
    "ms": Decimal("0.001"),
    "µs": Decimal("1e-6"),
    "μs": Decimal("1e-6"),
    "us": Decimal("1e-6"),
    "min": Decimal(60),
}

LENGTH: Final = Dimension("a length", _METRES, "5mm, 0.5um, -0.2in, 0.005")
ANGLE: Final = Dimension("an angle", _RADIANS, "1.5deg, 5arcsec, 10mrad, 0.01")
VELOCITY: Final = Dimension("a velocity", _per(_METRES, "/s"), "5mm/s, -0.2in/s, 0.005")
ANGULAR_VELOCITY: Final = Dimension("an angular velocity", _per(_RADIANS, "/s"), "1.5deg/s, 10mrad/s, 0.01")
ACCELERATION: Final = Dimension("an acceleration", _per(_METRES, "/s²", "/s2", "/s^2"), "50mm/s², 0.05")
ANGULAR_ACCELERATION: Final = Dimension(
    "an angular acceleration", _per(_RADIANS, "/s²", "/s2", "/s^2"), "15deg/s², 0.1"
)
TIME: Final = Dimension("a time", _SECONDS, "2s, 500ms, 0.5")
PERCENTAGE: Final = Dimension("a percentage", {"%": Decimal(1)}, "50%, 50")
DIMENSIONS: Final = (
    LENGTH,
    ANGLE,
    VELOCITY,
    ANGULAR_VELOCITY,
    ACCELERATION,
    ANGULAR_ACCELERATION,
    TIME,
    PERCENTAGE,
)
_SIZES: Final = {unit: size for dimension in DIMENSIONS for unit, size in dimension.units.items()}


def quantity(text: str, dimension: Dimension, bare: str | None = None) -> float:
    """Return what a number with a unit is in SI, a percentage in %; one without has the unit `bare`, SI if absent.

    Raises ValueError with what would be right. It is rounded once: 5mm is the float 0.005.
    """
    match = _WRITTEN.fullmatch(text)
    unit = (match[2] or bare or next(iter(dimension.units))) if match else ""
    size = dimension.units.get(unit)
    if match is None or size is None or not math.isfinite(float(match[1])):
        alone = bare or next(iter(dimension.units))
        units = ", ".join(name for name in dimension.units if "μ" not in name and "^" not in name)
        raise ValueError(
            f"{quoted(text.strip())!r} is not {dimension.name} such as {dimension.examples}; "
            f"units are {units}, a bare number is in {alone}{comma_hint(text)}"
        )
    return float(Decimal(match[1]) * size)


def written(value: float, unit: str, digits: int, width: int = 0) -> str:
    """Write a value, given in SI, in a unit: so many digits after the point, the number in a column of a `width`."""
    space = "" if unit == "°" else " "
    return f"{number(value / float(_SIZES[unit]), digits):>{width}}{space}{unit}"


def number(value: float, digits: int) -> str:
    """Write a number without the sign of a rounded zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def pose(values: Sequence[float], width: int = 0) -> str:
    """Write a pose, [m, m, rad], on a line, its numbers in columns of a `width`."""
    x, y, phi = values
    return f"x {written(x, 'mm', 3, width)}   y {written(y, 'mm', 3, width)}   φ {written(phi, '°', 4, width)}"


def correction(told: CorrectionTold, labels: Labels) -> str:
    """Write what as-built errors are corrected by on a line."""
    words = []
    if told.file:
        x, y, phi = told.greatest
        most = f"{written(x, 'µm', 1)} in x, {written(y, 'µm', 1)} in y, {written(phi, 'mrad', 3)}"
        words.append(f"{told.file}, measured {told.made}: up to {most}")
    if any(told.backlash):
        each = [f"{name} {written(width, 'µm', 1)}" for name, width in zip(labels, told.backlash, strict=True)]
        words.append(f"backlash of {', '.join(each)}")
    return "; ".join(words)


def numbers(words: Sequence[str]) -> list[str]:
    """Return the words of a command line as they are to be parsed.

    A negative number with a unit, -5mm, is taken for no option: none begins with a digit. What follows --tool is one
    word, a name or U,V: the two lengths of a point are joined. Behind -- all words are taken as they are.
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
    """Whether a word of the command line is a length."""
    try:
        quantity(word, LENGTH)
    except ValueError:
        return False
    return True


def share(text: str) -> float:
    """Return a share of full speed, from a number or a percentage. Raises ValueError with what would be right."""
    try:
        value = quantity(text, PERCENTAGE) / (100.0 if text.strip().endswith("%") else 1.0)
    except ValueError:
        value = math.nan
    if not LOWEST_SHARE <= value <= 1.0:
        raise ValueError(
            f"{quoted(text.strip())!r} is no share of the limits: {LOWEST_SHARE} to 1, or {LOWEST_SHARE:.1%} to 100%"
            + comma_hint(text)
        )
    return value


def percent(text: str) -> float:
    """Return an override [%], from a number or a percentage. Raises ValueError with what would be right."""
    try:
        value = quantity(text, PERCENTAGE)
        converted({"percent": value}, Override)
    except (ValueError, msgspec.ValidationError):
        raise ValueError(
            f"{quoted(text.strip())!r} is no override: 0, or {LOWEST_OVERRIDE:g} to 200 %{comma_hint(text)}"
        ) from None
    return value


def positive(text: str, dimension: Dimension) -> float:
    """Return a quantity that is not negative. Raises ValueError with what would be right."""
    value = quantity(text, dimension)
    if value < 0.0:
        raise ValueError(
            f"{quoted(text.strip())!r} is negative: {dimension.name} such as {dimension.examples} is taken"
        )
    return value


def radians(text: str, deg: bool, dimension: Dimension = ANGLE) -> float:
    """Return what an angle, or its rate, is in radians; a bare number is one of degrees where `deg` says so."""
    return quantity(text, dimension, next(iter(dimension.units)).replace("rad", "deg") if deg else None)


AT_REST: Final = (0.0, 0.0, "0")


def _one(read: Callable[[str], object]) -> Parameter:
    """Return what has one word of the command line read."""

    def convert(_: Any, tokens: Sequence[Token]) -> object:
        return read(tokens[0].value)

    return Parameter(converter=convert, n_tokens=1, negative="")


def _angle(text: str, dimension: Dimension = ANGLE) -> str:
    """Return an angle as it is, once it is one: how a bare number is meant is known with --deg."""
    quantity(text, dimension)
    return text


def _angles(_: Any, tokens: Sequence[Token]) -> tuple[str, ...]:
    return tuple(_angle(token.value) for token in tokens)


def _tool(text: str) -> tuple[float, float] | str:
    """Return a point of the platform, from U,V, or the name of one."""
    u, comma, v = text.partition(",")
    if comma:
        return quantity(u, LENGTH), quantity(v, LENGTH)
    if is_length(text) and not is_name(text):
        raise ValueError(f"{quoted(text.strip())!r} is half a point: U V, as 20mm 0, or a name of [frames.tool]")
    if not is_name(text):
        raise ValueError(f"{quoted(text.strip())!r} is neither a point, as 20mm 0, nor a name: {NAME_RULE}")
    return text


def _three(along: Dimension, turning: Dimension) -> Parameter:
    """Return what has three words read, two along x and y and one about φ."""

    def convert(_: Any, tokens: Sequence[Token]) -> tuple[float, float, str]:
        x, y, phi = (token.value for token in tokens)
        return quantity(x, along), quantity(y, along), _angle(phi, turning)

    return Parameter(converter=convert, negative="", show_default=False)


Length = Annotated[float, _one(lambda text: quantity(text, LENGTH))]
"""A length of the command line [m]."""
Velocity = Annotated[float, _one(lambda text: quantity(text, VELOCITY))]
"""Likewise [m/s]."""
AngularVelocity = Annotated[float, _one(lambda text: quantity(text, ANGULAR_VELOCITY))]
"""Likewise [rad/s]."""
Distance = Annotated[float, _one(lambda text: positive(text, LENGTH))]
"""A length that is not negative [m]."""
Time = Annotated[float, _one(lambda text: positive(text, TIME))]
"""A time that is not negative [s]."""
Percent = Annotated[float, _one(percent)]
"""An override [%]."""
Share = Annotated[float, _one(share)]
"""A share of full speed."""
ToolPoint = Annotated[tuple[float, float] | str, _one(_tool)]
"""A point of the platform in its own frame [m], or the name of one in [frames.tool]."""
Angle = Annotated[str, _one(_angle)]
"""An angle of the command line, to be read by `radians`."""
Angles = Annotated[
    tuple[str, ...], Parameter(converter=_angles, consume_multiple=True, negative="", show_default=False)
]
"""Angles, as many as there are."""
PoseWay = Annotated[tuple[float, float, str], _three(LENGTH, ANGLE)]
"""Of x, y [m] and φ."""
PoseVelocity = Annotated[tuple[float, float, str], _three(VELOCITY, ANGULAR_VELOCITY)]
"""Of x, y [m/s] and φ."""
PoseAcceleration = Annotated[tuple[float, float, str], _three(ACCELERATION, ANGULAR_ACCELERATION)]
"""Of x, y [m/s²] and φ."""
