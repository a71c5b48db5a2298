"""Drawing of an alignment in Rerun: curves of the marks' distances from their targets, and a table of the looks."""

from __future__ import annotations

import math

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from trirail.telemetry import columns
from trirail.telemetry.columns import SECOND, Column
from trirail.wire.looks import AlignmentLook
from trirail.wire.messages import Event

RESIDUALS, TABLE = "/alignment/residual", "/alignment/table"
MOST_LOOKS = 8
"""Maximum number of looks in the table, which has one column per look. Older looks are omitted."""
_TEXT = rr.TextDocument.descriptor_text()
_SCALARS = rr.Scalars.descriptor_scalars()


class ShownAlignment:
    """Drawing of the current alignment or, after its end, of the last one."""

    def __init__(self) -> None:
        self._looks: list[AlignmentLook] = []

    def drawing_of(self, event: Event, look: AlignmentLook) -> list[Chunk]:
        """Add a look, which `event` reports, and return the updated drawing."""
        if self._looks and (self._looks[0].id, self._looks[0].purpose) != (look.id, look.purpose):
            self._looks.clear()
        self._looks = [*self._looks, look][-MOST_LOOKS:]
        at = columns.times(np.array([round(event.t * SECOND)]), np.array([round(event.time * SECOND)]))
        parts = [Column(TABLE, _TEXT, pa.array([[self._table(event)]]))]
        for mark in look.marks:
            if mark.to_go is not None:
                path = f"{RESIDUALS}/{rr.escape_entity_path_part(mark.name)}"
                parts.append(Column(path, _SCALARS, columns.scalars(np.array([[math.hypot(*mark.to_go) * 1e6]]))))
        return columns.chunks(at, parts)

    def _table(self, event: Event) -> str:
        looks, last = self._looks, self._looks[-1]
        numbers = " | ".join(f"look {look.number}" if look.marks else "end" for look in looks)
        lines = [f"| {last.purpose} | {numbers} |", "|---" * (len(looks) + 1) + "|"]
        for name in dict.fromkeys(mark.name for look in looks for mark in look.marks):
            cells = " | ".join(_cell(look, name) for look in looks)
            lines.append(f"| {_plain(name)} | {cells} |")
        how = "" if last.end is None else f"**{last.end}** after {last.seconds:.2f} s. "
        return "\n".join([*lines, "", f"{how}{_plain(last.words)}", "", f"{_plain(last.id)} of {event.user}"])


def _cell(look: AlignmentLook, name: str) -> str:
    for mark in look.marks:
        if mark.name == name:
            (u, v), to_go = mark.pixel, mark.to_go
            return f"{u:.2f}, {v:.2f}" if to_go is None else f"{math.hypot(*to_go) * 1e6:.2f} µm"
    return "–"


def _plain(text: str) -> str:
    """Escape Markdown's special characters in a text that a client sent."""
    return "".join(f"\\{character}" if character in r"\`*_{}[]()<>#+-!|~" else character for character in text)
