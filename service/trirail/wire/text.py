"""Text from outside: what a name or an id may have in it, and how it is shown."""

from __future__ import annotations

import json
import math
import re
import unicodedata
from datetime import datetime

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.sizes import MAX_NAME, MAX_TEXT

_HIDDEN = frozenset({"Cc", "Cf", "Cs", "Co", "Zl", "Zp"})
"""Unicode's categories of what steers a terminal, reorders or ends a line, or cannot be seen."""
_NAME = re.compile(rf"[A-Za-z0-9_-]{{1,{MAX_NAME}}}")
_QUANTITY = re.compile(r"-?[0-9]+([eE]-?[0-9]+)?(m|cm|mm|um|nm|in|rad|mrad|urad|deg|arcmin|arcsec|s|ms|us|min)?")
"""What is a name by its characters and, on the command line, a number or one with a unit."""

NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
"""A number as people write one: no underscores and no digits of other scripts, which Python's float takes."""

NAME_RULE = f"letters, digits, - and _, at most {MAX_NAME}"
QUANTITY_RULE = "reads as a number or a quantity: a pose is told from one by its name, as p5mm"
ID_RULE = f"at most {MAX_NAME} characters, none of them for control or formatting"


_WITH_COMMA = re.compile(r"\s*[-+]?[0-9]+,[0-9]+(?![0-9,.])")


def number(text: str) -> float:
    """Return what a number says, blanks around it aside. Raises ValueError for what is none, or not finite."""
    if re.fullmatch(NUMBER, text.strip()) is None or not math.isfinite(value := float(text)):
        raise ValueError(f"{quoted(text.strip())!r} is no number{comma_hint(text)}")
    return value


def comma_hint(text: str) -> str:
    """Return how a number with a decimal comma is to be written, "" for what is none."""
    found = _WITH_COMMA.match(text)
    return f": write {text[: found.end()].strip().replace(',', '.')}, with a point" if found is not None else ""


def is_name(text: str) -> bool:
    """Whether it may name a robot or a user in a key."""
    return _NAME.fullmatch(text) is not None


def is_quantity(name: str) -> bool:
    """Whether a name reads as a number, or as one with a unit: 10, 5mm."""
    return _QUANTITY.fullmatch(name) is not None


def is_id(text: str) -> bool:
    """Whether it may be a goal's id."""
    return 0 < len(text) <= MAX_NAME and not any(map(_is_hidden, text))


def printable(text: str) -> str:
    """Return text with what a terminal would obey, or nobody would see, as an escape: \\x1b, \\u202e, \\n."""
    return "".join(_escaped(character) if _is_hidden(character) else character for character in text)


def json_printable(text: str) -> str:
    """Return JSON with the same characters escaped as JSON has them, for JSON that may end on a terminal."""
    return "".join(json.dumps(character)[1:-1] if _is_hidden(character) else character for character in text)


def quoted(text: str) -> str:
    """Return text from outside as a part of a line: printable, and not longer than a line may be."""
    said = printable(text[: MAX_TEXT + 1])
    return said if len(said) <= MAX_TEXT else said[: MAX_TEXT - 1] + "…"


def wall_clock(seconds: float) -> str:
    """Return a time since 1970 [s] as the clock on the wall shows it, to milliseconds."""
    return datetime.fromtimestamp(seconds).astimezone().isoformat(" ", "milliseconds")[:23]


def _is_hidden(character: str) -> bool:
    return unicodedata.category(character) in _HIDDEN


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def check_name(name: str, whose: str) -> str:
    """Return what may name a robot or user. Raises RefusedError."""
    if not isinstance(name, str) or not is_name(name):
        raise RefusedError(RefusalCode.BAD_NAME, f"{whose} {quoted(str(name))!r} is no name: {NAME_RULE} are taken")
    return name


def check_new_pose(name: str) -> str:
    """Return what may name a pose that is taught: a name that goto takes for no quantity. Raises RefusedError."""
    check_name(name, "pose")
    if is_quantity(name):
        raise RefusedError(RefusalCode.BAD_NAME, f"pose {name!r} {QUANTITY_RULE}")
    return name
