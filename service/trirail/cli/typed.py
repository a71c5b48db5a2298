"""Three numbers as people type them: with spaces between, with commas, or both."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Final

from trirail.cli.notation import TOOL

OF_THREE: Final = ("goto", "move", "sliders", "jog", "ik", "fk")
"""Commands that take three numbers, or poses of three."""
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?[^\d,;]*", re.IGNORECASE)


def spread(words: Sequence[str]) -> list[str]:
    """Return the words of a command line with 10mm,20mm,5deg as three, and without commas behind numbers.

    Two numbers in one word stay one: 10,5 may be meant for a decimal comma, of which its reader tells.
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
