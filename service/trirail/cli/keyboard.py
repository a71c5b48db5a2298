"""What a terminal sends for keys, as their names: ECMA-48's sequences of the arrows, and characters as they are."""

from __future__ import annotations

import re
from collections.abc import Iterator

_ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
# An arrow comes as ESC [ A, or ESC O A where the terminal is in application mode, with modifiers as ESC [ 1 ; 2 A.
_KEY = re.compile(r"\x1b[\[O](?P<parameters>[0-9;]*)(?P<final>[@-~])|(?P<escape>\x1b)|(?P<character>.)", re.DOTALL)


def keys(typed: bytes) -> Iterator[str]:
    """Yield the keys in what was read: up, down, left, right, escape, or a character in lower case, with = for +.

    Other keys' sequences are skipped as a whole: none of their characters is taken for a key.
    """
    for found in _KEY.finditer(typed.decode("utf-8", errors="ignore")):
        if found["final"]:
            if arrow := _ARROWS.get(found["final"]):
                yield arrow
        elif found["escape"]:
            yield "escape"
        else:
            yield {"=": "+", "_": "-"}.get(found["character"], found["character"].lower())
