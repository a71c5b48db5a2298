"""What clients tell of their alignments, as the gateway takes it: each look becomes an event."""

from __future__ import annotations

import time
from collections.abc import Callable

from msgspec import structs

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.incoming import Incoming, Pace
from trirail.wire import boundary, zenoh_session
from trirail.wire.looks import WELL, AlignmentLook
from trirail.wire.packets import Looked
from trirail.wire.text import quoted

BURST, RATE = 50, 20.0
"""Looks of one user that are taken at once, and then a second: three times what an alignment without a camera has."""


class Looks:
    """Takes what comes on …/alignment; `send` gives it to the loop, False where that takes no more now."""

    def __init__(self, robot: str, send: Callable[[Looked], bool], clock: Callable[[], float] = time.monotonic) -> None:
        self._prefix = zenoh_session.key(robot, "alignment")
        self._send = send
        self._clock = clock
        self._pace = Pace(BURST, RATE)

    def forward(self, incoming: Incoming) -> AlignmentLook:
        """Pass a look on, and return it. Raises RefusedError."""
        (user,) = boundary.names(incoming.key, self._prefix, ("user",))
        sent: AlignmentLook = incoming.content(AlignmentLook, "not a look of an alignment")
        look = structs.replace(sent, words=quoted(sent.words))
        now = self._clock()
        if self._pace.wait(user, now) > 0.0:
            raise RefusedError(RefusalCode.BUSY, f"more than {RATE:g} looks a second: send fewer")
        self._pace.count(user, now)
        if not self._send(Looked(user, "info" if look.end in WELL else "warning", in_words(look), look)):
            raise RefusedError(RefusalCode.BUSY, "the loop takes no more now: send it again")
        return look


def in_words(look: AlignmentLook) -> str:
    """Return a look as a line for people."""
    said = f"{look.purpose} {look.id}, look {look.number}: {_marks(look)}"
    if look.correction is not None:
        x, y, phi = look.correction
        said += f"; corrects by x {x * 1e6:.2f} µm, y {y * 1e6:.2f} µm, φ {phi * 1e6:.1f} µrad"
    if look.noise is not None:
        said += f"; residual {look.noise:.3f} pixel"
    if look.end is not None:
        said += f"; {look.end} after {look.seconds:.2f} s"
    return said + (f": {look.words}" if look.words else "")


def _marks(look: AlignmentLook) -> str:
    if not look.marks:
        return "no marks"
    if look.error is None:
        return ", ".join(f"{mark.name} ({mark.pixel[0]:.2f}, {mark.pixel[1]:.2f})" for mark in look.marks)
    return f"{look.error.worst * 1e6:.2f} µm and {look.error.turn * 1e6:.1f} µrad to go"
