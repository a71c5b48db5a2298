"""Black box, which stores the last minute of data in memory and writes it to a separate file after a fault.

The file is `fault-<time>.rrd` in the folder of the recording. It has the same content as a recording: every record, the
control inputs, the log, the drawing, the configuration and the software versions. It also contains the seconds after
the fault, in which the robot stops.

If faults repeat, they share files: after a file, the next one is written a minute later, and begins where it ended. The
files of all faults together contain the minute before each of them.
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
"""Extra time kept, because the start or the end of the saved time may fall within a batch [s]."""
KEPT_S = BEFORE_S + 2.0 * AFTER_S + MARGIN_S
"""Time for which data is kept [s]. A second fault within AFTER_S of the first one delays the file by up to AFTER_S."""

MAX_MESSAGES_MB = 12.0
"""Maximum memory for stored messages, including MESSAGE_OVERHEAD for each [1e6 bytes].

A flood of messages can exceed it within a minute; the oldest messages are then dropped.
"""
MESSAGE_OVERHEAD = 600
"""Memory that a message needs in addition to its packed bytes, for closure, tuple and queue entry [bytes]."""

Fill = Callable[[Recorder], None]
Begin = Callable[[str, str], Recorder]
"""Function that starts a black box with a name and a reason, and returns its recorder."""


class StoredInput(NamedTuple):
    """Stored call that passes an input to the recorder of a black box."""

    order: int
    t: float
    """Time at which the input arrived, since the start of the loop [s]."""
    fill: Fill
    lasting: str = ""
    """Name of the state that the input sets until the next update of that state; empty for an event."""
    size: int = 0
    """Memory that counts towards MAX_MESSAGES_MB [bytes]."""


class BlackBox:
    """Memory of the last minute of everything that the recorder receives.

    Parameters
    ----------
    rate_hz
        Rate of the control loop.
    begin
        Function that returns a new recorder for a black box, given the black box's name and reason.
    warn
        Function that receives a warning if a black box is incomplete or cannot be saved.
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
        """Faults that are not saved yet, or without all of the time after them."""
        self._saved_at = -math.inf
        """Time at which the data for the last file was taken from the memory [s]."""
        self._writing: threading.Thread | None = None
        self._reported: set[EventCode] = set()
        """Delay or loss of faults that was reported since the last file."""

    def records(self, batch: bytes) -> None:
        """Store packed records. Write a file if it is due, unless the last one is still being written."""
        self._t = last_cycle(batch) / self._rate_hz
        if not self._records:
            self._drop_earlier_faults()
        self._records.append(StoredInput(next(self._order), self._t, methodcaller("records", batch)))
        oldest = self._t - KEPT_S
        while self._records[0].t < oldest:
            self._records.popleft()
        while self._messages and self._messages[0].t < oldest:
            self._forget()
        if self._faults and self._faults[0].t < oldest:
            self._report_loss(oldest)
        if self._faults and self._t < self._due:
            self._report_delay()
        elif self._faults and not self._is_writing:
            self._write()

    def event(self, event: Event) -> None:
        """Store an event; if it is a fault, schedule the writing of a file."""
        self._keep_packed(EventReport(event))
        if event.kind == "fault":
            self._faults.append(event)

    def control_input(self, item: ControlInput) -> None:
        """Store an input to the control loop."""
        self._keep_packed(item)

    def latch(self, name: str, *values: object) -> None:
        """Store a state that is valid until its next update, as a call of the recorder's method `name`."""
        self._keep(methodcaller(name, *values), lasting=name)

    def close(self) -> None:
        """Wait until the last file is complete; if faults are not saved yet, write another one for all of them."""
        self._wait()
        if self._faults:
            self._write()
            self._wait()

    def _wait(self) -> None:
        if self._writing is not None:
            self._writing.join()

    @property
    def _is_writing(self) -> bool:
        return self._writing is not None and self._writing.is_alive()

    @property
    def _due(self) -> float:
        """Time at which the waiting faults are saved [s].

        This is AFTER_S after them; those that follow the first one by more than AFTER_S do not delay it further. A file
        is due at least BEFORE_S after the last one, so that files do not repeat each other's data.
        """
        first, newest = self._faults[0].t, self._faults[-1].t
        return max(min(first + AFTER_S, newest) + AFTER_S, self._saved_at + BEFORE_S)

    def _report_delay(self) -> None:
        """Report that a fault is saved later than usual, once per file."""
        due = self._due
        if due > self._faults[0].t + 2.0 * AFTER_S and EventCode.BLACK_BOX_LATER not in self._reported:
            self._reported.add(EventCode.BLACK_BOX_LATER)
            words = f"black box: faults repeat within a minute; those until t = {due:.1f} s are saved in one file"
            self._warn(coded(words, EventCode.BLACK_BOX_LATER, until=due))

    def _drop_earlier_faults(self) -> None:
        """Drop the faults of the time before the first records, which the loop has sent again to this recorder."""
        dropped = len(self._faults)
        self._faults = deque(fault for fault in self._faults if fault.t > self._t - MARGIN_S)
        if len(self._faults) < dropped:
            self._warn_unsaved("the recorder has restarted since")

    def _report_loss(self, oldest: float) -> None:
        """Drop the faults before `oldest`, whose data is no longer in the memory; report that once per file."""
        while self._faults and self._faults[0].t < oldest:
            self._faults.popleft()
        if EventCode.NO_BLACK_BOX not in self._reported:
            self._reported.add(EventCode.NO_BLACK_BOX)
            self._warn_unsaved("the disk is so slow that the previous black box is still being written")

    def _warn_unsaved(self, error: str) -> None:
        words = f"black box: the minute before the fault is not saved: {error}"
        self._warn(coded(words, EventCode.NO_BLACK_BOX, error=error))

    def _keep_packed(self, message: EventReport | ControlInput) -> None:
        """Store a message in packed form, which is many times smaller than the decoded message."""
        packed = encode(message)
        self._keep(lambda recorder: _replay_message(recorder, packed), size=len(packed) + MESSAGE_OVERHEAD)

    def _keep(self, fill: Fill, *, lasting: str = "", size: int = 0) -> None:
        self._messages.append(StoredInput(next(self._order), self._t, fill, lasting, size))
        self._message_bytes += size
        while self._message_bytes > MAX_MESSAGES_MB * 1e6:
            self._dropped_at = self._messages[0].t
            self._forget()

    def _forget(self) -> None:
        """Remove the oldest message from the queue. If it sets a state, save the state as one that is still valid."""
        old = self._messages.popleft()
        self._message_bytes -= old.size
        if old.lasting:
            self._latched[old.lasting] = old.fill

    def _write(self) -> None:
        """Begin to write a file, which contains all waiting faults."""
        fault = self._faults[0]
        self._saved_at = self._t
        self._reported.clear()
        while self._faults and self._faults[0].t + AFTER_S <= self._t:  # the time after the others is in the next file
            self._faults.popleft()
        if self._dropped_at >= self._t - KEPT_S:
            # A flood of messages has filled the memory in less than a minute.
            words = (
                f"black box: messages exceed {MAX_MESSAGES_MB:g} MB; "
                f"those before t = {self._dropped_at:.1f} s are missing"
            )
            self._warn(coded(words, EventCode.BLACK_BOX_SHORT, until=self._dropped_at))
        fills = [*self._latched.values(), *(kept.fill for kept in heapq.merge(self._records, self._messages))]
        # Writing takes a second or two. It runs in a thread, because the recording must continue meanwhile.
        self._writing = threading.Thread(target=self._fill, args=(fault, fills), name="black box")
        self._writing.start()

    def _fill(self, fault: Event, fills: list[Fill]) -> None:
        try:
            recorder = self._begin(box_name(fault.time), fault.message)
        except ServiceError as error:
            self._warn_unsaved(str(error))
            return
        for fill in fills:
            fill(recorder)
        recorder.close()
        if recorder.lost:
            words = f"black box: the minute before the fault is incomplete in {recorder.path}: {recorder.cause}"
            file, cause = str(recorder.path), recorder.cause
            self._warn(coded(words, EventCode.BLACK_BOX_INCOMPLETE, file=file, error=cause))


def _replay_message(recorder: Recorder, packed: bytes) -> None:
    """Decode a stored message and pass it to a recorder."""
    match decode_answer(packed):
        case EventReport(event):
            recorder.event(event)
        case ControlInput() as item:
            recorder.control_input(item)
