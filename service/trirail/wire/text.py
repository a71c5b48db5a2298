"""Rules for names and ids that arrive from outside, and safe display of text that arrives from outside."""

from __future__ import annotations

import codecs
import json
import math
import re
import unicodedata
from datetime import datetime

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.sizes import MAX_NAME, MAX_TEXT

_HIDDEN = frozenset({"Cc", "Cf", "Cs", "Co", "Zl", "Zp"})
"""Unicode categories of characters that control a terminal, reorder or end a line, or cannot be seen."""
_NAME = re.compile(rf"[A-Za-z0-9_-]{{1,{MAX_NAME}}}")
_QUANTITY = re.compile(r"-?[0-9]+([eE]-?[0-9]+)?(m|cm|mm|um|nm|in|rad|mrad|urad|deg|arcmin|arcsec|s|ms|us|min)?")
"""Pattern of names that the command line would read as a number or a quantity."""

NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
"""Pattern of decimal numbers. Python's float would also accept underscores and digits of other scripts."""

NAME_RULE = f"at most {MAX_NAME} letters, digits, - and _"
QUANTITY_RULE = "reads as a number or a quantity; choose a name such as p5mm"
ID_RULE = f"1 to {MAX_NAME} characters, without control and formatting characters"


_WITH_COMMA = re.compile(r"\s*[-+]?[0-9]+,[0-9]+(?![0-9,.])")


def number(text: str) -> float:
    """Convert a text to a number, ignoring blanks at both ends. Raises ValueError if it is not a finite number."""
    if re.fullmatch(NUMBER, text.strip()) is None or not math.isfinite(value := float(text)):
        raise ValueError(f"{quoted(text.strip())!r} is not a number{comma_hint(text)}")
    return value


def comma_hint(text: str) -> str:
    """Return a hint to write a decimal point if the text begins with a number with a decimal comma; otherwise ""."""
    match = _WITH_COMMA.match(text)
    return f": write {text[: match.end()].strip().replace(',', '.')} with a decimal point" if match is not None else ""


def is_name(text: str) -> bool:
    """Return True if a text is a valid name of a robot, user or pose in a key."""
    return _NAME.fullmatch(text) is not None


def is_quantity(name: str) -> bool:
    """Return True if the command line would read a name as a number or a quantity, such as 10 or 5mm."""
    return _QUANTITY.fullmatch(name) is not None


def is_id(text: str) -> bool:
    """Return True if a text is a valid id of a goal."""
    return 0 < len(text) <= MAX_NAME and not any(map(_is_hidden, text))


def check_id(text: str, whose: str) -> None:
    """Raise ValueError if a text is not a valid id. `whose` tells the error message what is named, such as "mark"."""
    if not is_id(text):
        too_long = f"is too long ({len(text)} characters)"
        problem = "is empty" if not text else too_long if len(text) > MAX_NAME else "is not printable"
        raise ValueError(f"{whose} {quoted(text)!r} {problem}; use {ID_RULE}")


def printable(text: str) -> str:
    """Return a text with escapes, such as \\x1b, \\u202e and \\n, in place of control and invisible characters."""
    return "".join(_escaped(character) if _is_hidden(character) else character for character in text)


def json_printable(text: str, encoding: str | None = None) -> str:
    """Return JSON with JSON escapes in place of control and invisible characters, for output on a terminal.

    If `encoding`, that of the output, is not UTF-8, other characters than ASCII are escaped too: RFC 8259, section 8.1.
    """
    is_utf8 = encoding is None or codecs.lookup(encoding).name == "utf-8"
    return "".join(
        json.dumps(character)[1:-1] if _is_hidden(character) or not (is_utf8 or character.isascii()) else character
        for character in text
    )


def quoted(text: str) -> str:
    """Return a text from outside for a quotation in one line: printable, and cut to MAX_TEXT characters."""
    line = printable(text[: MAX_TEXT + 1])
    return line if len(line) <= MAX_TEXT else line[: MAX_TEXT - 1] + "…"


def wall_clock(seconds: float) -> str:
    """Return a time since 1970 [s] as local date and time with milliseconds."""
    return datetime.fromtimestamp(seconds).astimezone().isoformat(" ", "milliseconds")[:23]


def _is_hidden(character: str) -> bool:
    return unicodedata.category(character) in _HIDDEN


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def check_name(name: str, whose: str) -> str:
    """Check the name of a robot, user or pose, and return the name.

    `whose` tells the error message what is named, such as "robot". Raises RefusedError if the name is invalid.
    """
    if not isinstance(name, str) or not is_name(name):
        raise RefusedError(RefusalCode.BAD_NAME, f"{whose} {quoted(str(name))!r} is not a valid name; use {NAME_RULE}")
    return name


def check_new_pose(name: str) -> str:
    """Check the name of a new pose; return the name.

    Raises RefusedError if the name is invalid, or if the command `trirail goto` would read it as a quantity.
    """
    check_name(name, "pose")
    if is_quantity(name):
        raise RefusedError(RefusalCode.BAD_NAME, f"pose {name!r} {QUANTITY_RULE}")
    return name
