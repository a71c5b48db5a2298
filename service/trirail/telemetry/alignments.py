"""Alignments as a recording has them: the looks of each, in order."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trirail.wire.looks import AlignmentLook

if TYPE_CHECKING:
    from trirail.telemetry.reading import Line


class RecordedAlignment(NamedTuple):
    """What a client told of one alignment, calibration or check."""

    id: str
    """The ids of its goals begin with it."""
    user: str
    purpose: str
    """alignment, calibration or check."""
    t: tuple[float, ...]
    """Nominal times of its looks since the loop's start, when they were told [s]."""
    looks: tuple[AlignmentLook, ...]
    """In order. The last has the end, and is none of the cameras' where an error or a calibration ended it."""

    @property
    def end(self) -> str:
        """Why it ended; unknown where that was not told."""
        return self.looks[-1].end or "unknown"

    @property
    def marks(self) -> tuple[str, ...]:
        """The marks that were found, by name: the rows of `residuals`."""
        return tuple(sorted({mark.name for look in self.looks for mark in look.marks}))

    @property
    def residuals(self) -> NDArray[np.float64]:
        """How far each mark was from its target at each look, (marks, looks) [m]; NaN where that is not known."""
        ways = [
            {mark.name: math.hypot(*mark.to_go) for mark in look.marks if mark.to_go is not None} for look in self.looks
        ]
        rows = [[way.get(name, math.nan) for way in ways] for name in self.marks]
        return np.array(rows).reshape(len(self.marks), len(self.looks))


def of(events: Iterable[Line]) -> list[RecordedAlignment]:
    """Return the alignments that a log tells of, by their first look."""
    found: dict[tuple[str, str, str], list[tuple[float, AlignmentLook]]] = {}
    for line in events:
        if line.event is not None and (look := line.event.alignment) is not None:
            found.setdefault((look.id, line.event.user or "", look.purpose), []).append((line.t, look))
    return [
        RecordedAlignment(*name, tuple(t for t, _ in told), tuple(look for _, look in told))
        for name, told in found.items()
    ]
