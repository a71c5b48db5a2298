"""The black box: the last minute is kept in memory, and on a fault written to a file of its own.

The file is `fault-<time>.rrd`, beside the recording, with the same content: every record, the control's inputs, the
log, the drawing, the configuration and the software. It also has the seconds after the fault, with the stop.
"""

from __future__ import annotations

import heapq
import itertools
import math
import threading
from collections import deque
from collections.abc import Callable
from operator import methodcaller
from typing import NamedTuple

from trirail.errors import ServiceError
from trirail.telemetry.contents import box_name
from trirail.telemetry.recorder import Recorder
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.messages import Event
from trirail.wire.packets import ControlInput, Happened, decode_answer, encode
from trirail.wire.records import last_cycle

BEFORE = 60.0
"""Time kept before the fault [s]."""
AFTER = 2.0
"""Time kept after the fault [s]."""
SPARE = 1.0
"""Time kept beyond both, for batches that begin or end in between [s]."""

SAID_MB = 12.0
"""Limit of the kept messages, with their overhead in memory [1e6 bytes]: a flood sends more in a minute."""
OVERHEAD = 600
"""Memory of a message beside its packed bytes: its closure, its tuple and its place in the queue [bytes]."""

Fill = Callable[[Recorder], None]
Begin = Callable[[str, str], Recorder]
"""Returns the recorder of a black box of this name, kept for this reason."""


class Kept(NamedTuple):
    """Input to repeat to the recorder of a black box."""

    order: int
    t: float
    """Time of its arrival [s]."""
    fill: Fill
    lasting: str = ""
    """Name of a state that holds until its next update; empty for an event."""
    size: int = 0
    """Size that counts towards SAID_MB [bytes]."""


class BlackBox:
    """Memory of all that the recorder takes. `begin` returns a recorder; `say` reports problems with its file."""

    def __init__(self, rate_hz: int, begin: Begin, say: Callable[[EventText], None]) -> None:
        self._rate_hz = rate_hz
        self._begin = begin
        self._say = say
        self._order = itertools.count()
        self._records: deque[Kept] = deque()
        self._said: deque[Kept] = deque()
        self._said_bytes = 0
        self._left_out_at = -math.inf
        self._standing: dict[str, Fill] = {}
        self._t = 0.0
        self._faults: deque[Event] = deque()
        self._writing: list[threading.Thread] = []

    def records(self, batch: bytes) -> None:
        """Take packed records; write the file when those after a fault have arrived."""
        self._t = last_cycle(batch) / self._rate_hz
        self._records.append(Kept(next(self._order), self._t, methodcaller("records", batch)))
        oldest = self._t - BEFORE - AFTER - SPARE
        while self._records[0].t < oldest:
            self._records.popleft()
        while self._said and self._said[0].t < oldest:
            self._forget()
        while self._faults and self._t >= self._faults[0].t + AFTER:
            self._write(self._faults.popleft())

    def event(self, event: Event) -> None:
        """Take an event."""
        self._keep_packed(Happened(event))
        if event.kind == "fault":
            self._faults.append(event)

    def control_input(self, what: ControlInput) -> None:
        """Take an input of the control."""
        self._keep_packed(what)

    def stands(self, name: str, *values: object) -> None:
        """Take a state that holds until its next update, by the name of the recorder's method."""
        self._keep(methodcaller(name, *values), lasting=name)

    def close(self) -> None:
        """Write the files of recent faults; wait until they are complete."""
        while self._faults:
            self._write(self._faults.popleft())
        for thread in self._writing:
            thread.join()

    def _keep_packed(self, said: Happened | ControlInput) -> None:
        """Keep a message in packed form, which is many times smaller."""
        packed = encode(said)
        self._keep(lambda recorder: _say(recorder, packed), size=len(packed) + OVERHEAD)

    def _keep(self, fill: Fill, *, lasting: str = "", size: int = 0) -> None:
        self._said.append(Kept(next(self._order), self._t, fill, lasting, size))
        self._said_bytes += size
        while self._said_bytes > SAID_MB * 1e6:
            self._left_out_at = self._said[0].t
            self._forget()

    def _forget(self) -> None:
        """Drop the oldest message, except for a state that still holds."""
        old = self._said.popleft()
        self._said_bytes -= old.size
        if old.lasting:
            self._standing[old.lasting] = old.fill

    def _write(self, fault: Event) -> None:
        if self._left_out_at >= self._t - BEFORE - AFTER - SPARE:
            words = f"too much was said for the black box: what was until t = {self._left_out_at:.1f} s is left out"
            self._say(coded(words, EventCode.BLACK_BOX_SHORT, until=self._left_out_at))
        fills = [*self._standing.values(), *(kept.fill for kept in heapq.merge(self._records, self._said))]
        # In a thread: it takes a second or two, during which the recording continues.
        thread = threading.Thread(target=self._fill, args=(fault, fills), name="black box")
        self._writing = [writing for writing in self._writing if writing.is_alive()] + [thread]
        thread.start()

    def _fill(self, fault: Event, fills: list[Fill]) -> None:
        try:
            recorder = self._begin(box_name(fault.time), fault.message)
        except ServiceError as error:
            words = f"the last minute before the fault is not kept: {error}"
            self._say(coded(words, EventCode.NO_BLACK_BOX, error=str(error)))
            return
        for fill in fills:
            fill(recorder)
        recorder.close()
        if recorder.lost:
            words = f"the last minute before the fault is not whole in {recorder.path}: {recorder.cause}"
            file, cause = str(recorder.path), recorder.cause
            self._say(coded(words, EventCode.BLACK_BOX_INCOMPLETE, file=file, error=cause))


def _say(recorder: Recorder, packed: bytes) -> None:
    """Pass a message of the loop to a recorder."""
    match decode_answer(packed):
        case Happened(event):
            recorder.event(event)
        case ControlInput() as what:
            recorder.control_input(what)
