"""Black box that keeps the last minute in memory, and writes it to its own file on a fault.

The file is `fault-<time>.rrd` in the recording's folder, with the same content as the recording: every record, the
control inputs, the log, the drawing, the configuration and the software. It also contains the seconds after the fault,
including the stop.
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
from trirail.wire.packets import ControlInput, EventReport, decode_answer, encode
from trirail.wire.records import last_cycle

BEFORE_S = 60.0
"""Time kept before the fault [s]."""
AFTER_S = 2.0
"""Time kept after the fault [s]."""
MARGIN_S = 1.0
"""Extra time kept, since batches may begin or end in between [s]."""

MAX_MESSAGES_MB = 12.0
"""Limit of the kept messages including their overhead in memory [1e6 bytes]; a flood would send more in a minute."""
MESSAGE_OVERHEAD = 600
"""Memory that a message needs in addition to its packed bytes: closure, tuple and place in the queue [bytes]."""

Fill = Callable[[Recorder], None]
Begin = Callable[[str, str], Recorder]
"""Function that starts a black box with a name and a reason, and returns its recorder."""


class StoredInput(NamedTuple):
    """Input that can be repeated to the recorder of a black box."""

    order: int
    t: float
    """Time of its arrival [s]."""
    fill: Fill
    lasting: str = ""
    """Name of a state that is valid until its next update; empty for an event."""
    size: int = 0
    """Size that counts towards SAID_MB [bytes]."""


class BlackBox:
    """Memory of everything that the recorder receives.

    Parameters
    ----------
    rate_hz
        Rate of the control loop.
    begin
        Function that returns the recorder of a black box, given its name and reason.
    warn
        Function that receives a report of each problem with a file.
    """

    def __init__(self, rate_hz: int, begin: Begin, warn: Callable[[EventText], None]) -> None:
        self._rate_hz = rate_hz
        self._begin = begin
        self._warn = warn
        self._order = itertools.count()
        self._records: deque[StoredInput] = deque()
        self._messages: deque[StoredInput] = deque()
        self._message_bytes = 0
        self._dropped_at = -math.inf
        self._latched: dict[str, Fill] = {}
        self._t = 0.0
        self._faults: deque[Event] = deque()
        self._writing: list[threading.Thread] = []

    def records(self, batch: bytes) -> None:
        """Store packed records; write the file once the records after a fault have arrived."""
        self._t = last_cycle(batch) / self._rate_hz
        self._records.append(StoredInput(next(self._order), self._t, methodcaller("records", batch)))
        oldest = self._t - BEFORE_S - AFTER_S - MARGIN_S
        while self._records[0].t < oldest:
            self._records.popleft()
        while self._messages and self._messages[0].t < oldest:
            self._forget()
        while self._faults and self._t >= self._faults[0].t + AFTER_S:
            self._write(self._faults.popleft())

    def event(self, event: Event) -> None:
        """Store an event; if it is a fault, prepare its file."""
        self._keep_packed(EventReport(event))
        if event.kind == "fault":
            self._faults.append(event)

    def control_input(self, item: ControlInput) -> None:
        """Store an input of the control loop."""
        self._keep_packed(item)

    def latch(self, name: str, *values: object) -> None:
        """Store a state that is valid until its next update, by the name of the recorder's method."""
        self._keep(methodcaller(name, *values), lasting=name)

    def close(self) -> None:
        """Write the files of recent faults, and wait until they are complete."""
        while self._faults:
            self._write(self._faults.popleft())
        for thread in self._writing:
            thread.join()

    def _keep_packed(self, message: EventReport | ControlInput) -> None:
        """Keep a message in packed form, which is many times smaller."""
        packed = encode(message)
        self._keep(lambda recorder: _replay_message(recorder, packed), size=len(packed) + MESSAGE_OVERHEAD)

    def _keep(self, fill: Fill, *, lasting: str = "", size: int = 0) -> None:
        self._messages.append(StoredInput(next(self._order), self._t, fill, lasting, size))
        self._message_bytes += size
        while self._message_bytes > MAX_MESSAGES_MB * 1e6:
            self._dropped_at = self._messages[0].t
            self._forget()

    def _forget(self) -> None:
        """Drop the oldest message, unless it is a state that is still valid."""
        old = self._messages.popleft()
        self._message_bytes -= old.size
        if old.lasting:
            self._latched[old.lasting] = old.fill

    def _write(self, fault: Event) -> None:
        if self._dropped_at >= self._t - BEFORE_S - AFTER_S - MARGIN_S:
            # A flood of messages fills the memory before a minute has passed.
            words = (
                f"black box: messages exceed {MAX_MESSAGES_MB:g} MB; "
                f"those before t = {self._dropped_at:.1f} s are missing"
            )
            self._warn(coded(words, EventCode.BLACK_BOX_SHORT, until=self._dropped_at))
        fills = [*self._latched.values(), *(kept.fill for kept in heapq.merge(self._records, self._messages))]
        # Runs in a thread, since it takes a second or two during which the recording must continue.
        thread = threading.Thread(target=self._fill, args=(fault, fills), name="black box")
        self._writing = [writing for writing in self._writing if writing.is_alive()] + [thread]
        thread.start()

    def _fill(self, fault: Event, fills: list[Fill]) -> None:
        try:
            recorder = self._begin(box_name(fault.time), fault.message)
        except ServiceError as error:
            words = f"black box: the minute before the fault is not saved: {error}"
            self._warn(coded(words, EventCode.NO_BLACK_BOX, error=str(error)))
            return
        for fill in fills:
            fill(recorder)
        recorder.close()
        if recorder.lost:
            words = f"black box: the minute before the fault is incomplete in {recorder.path}: {recorder.cause}"
            file, cause = str(recorder.path), recorder.cause
            self._warn(coded(words, EventCode.BLACK_BOX_INCOMPLETE, file=file, error=cause))


def _replay_message(recorder: Recorder, packed: bytes) -> None:
    """Pass a message of the loop to a recorder."""
    match decode_answer(packed):
        case EventReport(event):
            recorder.event(event)
        case ControlInput() as item:
            recorder.control_input(item)
