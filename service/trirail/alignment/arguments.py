"""Checks of the arguments of alignments and calibrations, which take place before the first motion."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NoReturn

from trirail.alignment.images import LENSES, Pair
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.goal_kind import MIN_SPEED
from trirail.wire.text import quoted

MAX_PIXEL = 1e7
"""Greatest pixel coordinate that is accepted. No picture is that large, and fits with much greater ones overflow."""
MAX_WAIT_S = 3600.0
"""Longest waiting time after a motion that is accepted [s]."""


def parse_pixel(value: object) -> Pair | None:
    """Return two numbers of at most MAX_PIXEL as a pair of Python floats; None for any other value."""
    pair = parse_numbers(value, 2)
    return None if pair is None or max(map(abs, pair)) > MAX_PIXEL else (pair[0], pair[1])


def parse_numbers(value: object, count: int) -> tuple[float, ...] | None:
    """Return `count` finite numbers as a tuple of Python floats; None for any other value."""
    if not isinstance(value, Iterable) or isinstance(value, str | bytes | Mapping):
        return None
    numbers = [_parse_number(each) for each in value]
    plain = tuple(each for each in numbers if each is not None and math.isfinite(each))
    return plain if len(plain) == len(numbers) == count else None


def check_count(value: object, name: str, minimum: int) -> None:
    """Raise RefusedError unless `value` is an integer of at least `minimum`."""
    if isinstance(value, bool) or not hasattr(type(value), "__index__") or value < minimum:  # type: ignore[operator]
        _refuse(value, name, f"a whole number of at least {minimum}")


def check_above_zero(value: object, name: str) -> None:
    """Raise RefusedError unless `value` is a number above zero."""
    number = _parse_number(value)
    if number is None or not number > 0.0:
        _refuse(value, name, "a number above 0")


def check_wait(value: object) -> None:
    """Raise RefusedError unless `value` is a waiting time from 0 s to MAX_WAIT_S."""
    number = _parse_number(value)
    if number is None or not 0.0 <= number <= MAX_WAIT_S:
        _refuse(value, "wait", f"a number of seconds from 0 to {MAX_WAIT_S:g}")


def check_speed(value: object) -> None:
    """Raise RefusedError unless `value` is a fraction of full speed from MIN_SPEED to 1."""
    number = _parse_number(value)
    if number is None or not MIN_SPEED <= number <= 1.0:
        _refuse(value, "speed", f"a fraction of full speed from {MIN_SPEED:g} to 1")


def check_pose_offset(value: object, name: str) -> None:
    """Raise RefusedError unless `value` consists of three finite numbers, x, y [m] and phi [rad]."""
    if parse_numbers(value, 3) is None:
        _refuse(value, name, "three finite numbers, x, y [m] and phi [rad]")


def check_approach(value: object) -> None:
    """Raise RefusedError unless `value` is an offset x, y [m], phi [rad] or None."""
    if value is not None:
        check_pose_offset(value, "approach")


def check_moves(value: object) -> None:
    """Raise RefusedError unless `value` is a list of moves, each of which consists of x, y [m] and phi [rad]."""
    if not isinstance(value, Iterable) or isinstance(value, str | bytes | Mapping):
        _refuse(value, "moves", "a list of x, y [m] and phi [rad]")
    for each in value:
        check_pose_offset(each, "one of moves")


def check_views(value: object) -> None:
    """Raise RefusedError unless `value` is None or maps names of marks to names of views."""
    if value is not None and not (
        isinstance(value, Mapping) and all(isinstance(name, str) for pair in value.items() for name in pair)
    ):
        _refuse(value, "views", "{mark: view}")


def check_lens(lens: object, centre: object) -> None:
    """Raise RefusedError unless `lens` is one of LENSES and `centre` is a pixel (u, v), or one for each view.

    `centre` may be None, except for a radial lens: with a wrong centre, the fit succeeds, but its positions are wrong.
    """
    if not isinstance(lens, str) or lens not in LENSES:
        _refuse(lens, "lens", f"one of {', '.join(LENSES)}")
    if centre is None:
        if lens == "radial":
            _refuse(None, "centre", "the pixel (u, v) on the axis of the radial lens, usually the picture's centre")
        return
    for each in centre.values() if isinstance(centre, Mapping) else (centre,):
        if parse_pixel(each) is None:
            _refuse(each, "centre", "two pixels (u, v) within ±1e7")


def check_targets(value: object) -> None:
    """Raise RefusedError unless `value` maps names of marks to target pixels."""
    if not isinstance(value, Mapping):
        _refuse(value, "targets", "{mark: (u, v)} in pixels")
    for name, pixel in value.items():
        if parse_pixel(pixel) is None:
            _refuse(pixel, f"the target of mark {name!r:.60}", "two pixels (u, v) within ±1e7")


def _parse_number(value: object) -> float | None:
    """Convert a number of any library to a Python float. Return None for booleans, strings and other objects."""
    if isinstance(value, bool | str | bytes) or not any(hasattr(type(value), n) for n in ("__index__", "__float__")):
        return None
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return None


def _refuse(value: object, name: str, expected: str) -> NoReturn:
    raise RefusedError(RefusalCode.MALFORMED, f"{name} is {quoted(repr(value))}: expected {expected}")
