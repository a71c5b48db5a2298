"""The black box: what happened in the last minute is kept in memory, and on a fault in a file of its own.

The file is `fault-<time>.rrd`, beside the recording, and is made like one: every record, what the control was given,
the log, the drawing, the configuration and the software. It also has the seconds after the fault, with the stop.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from datetime import datetime
from operator import methodcaller

from trirail.errors import ServiceError
from trirail.telemetry.recorder import Recorder
from trirail.telemetry.retention import BLACK_BOX
from trirail.wire.messages import Event
from trirail.wire.packets import ControlInput
from trirail.wire.records import last_cycle

BEFORE = 60.0
"""How much of what came before the fault is kept [s]."""
AFTER = 2.0
"""How long it is waited for what comes after it [s]."""
SPARE = 1.0
"""Kept beyond both, for batches that begin or end in between [s]."""

Fill = Callable[[Recorder], None]


class BlackBox:
    """Takes all that the recorder takes. `begin` makes a recorder for a name; `say` tells of the file, or why not."""

    def __init__(self, rate_hz: int, begin: Callable[[str], Recorder], say: Callable[[str], None]) -> None:
        self._rate_hz = rate_hz
        self._begin = begin
        self._say = say
        self._kept: deque[tuple[float, str, Fill]] = deque()
        self._standing: dict[str, Fill] = {}
        self._t = 0.0
        self._faults: deque[Event] = deque()
        self._writing: list[threading.Thread] = []

    def records(self, batch: bytes) -> None:
        """Take packed records; write the file when those after a fault are there."""
        self._t = last_cycle(batch) / self._rate_hz
        self._keep(methodcaller("records", batch))
        while self._kept and self._kept[0][0] < self._t - BEFORE - AFTER - SPARE:
            _, lasting, fill = self._kept.popleft()
            if lasting:
                self._standing[lasting] = fill
        while self._faults and self._t >= self._faults[0].t + AFTER:
            self._write(self._faults.popleft())

    def event(self, event: Event) -> None:
        """Take an event."""
        self._keep(methodcaller("event", event))
        if event.kind == "fault":
            self._faults.append(event)

    def given(self, what: ControlInput) -> None:
        """Take what the control was given."""
        self._keep(methodcaller("given", what))

    def stands(self, name: str, *values: object) -> None:
        """Take what holds until it is said anew: by the name of the recorder's method."""
        self._keep(methodcaller(name, *values), name)

    def close(self) -> None:
        """Write the files of faults that have just been; wait until they are complete."""
        while self._faults:
            self._write(self._faults.popleft())
        for thread in self._writing:
            thread.join()

    def _keep(self, fill: Fill, lasting: str = "") -> None:
        self._kept.append((self._t, lasting, fill))

    def _write(self, fault: Event) -> None:
        fills = [*self._standing.values(), *(fill for _, _, fill in self._kept)]
        # In a thread: it takes a second or two, in which the recording goes on.
        thread = threading.Thread(target=self._fill, args=(fault, fills), name="black box")
        self._writing = [writing for writing in self._writing if writing.is_alive()] + [thread]
        thread.start()

    def _fill(self, fault: Event, fills: list[Fill]) -> None:
        try:
            recorder = self._begin(f"{BLACK_BOX}{datetime.fromtimestamp(fault.time).astimezone():%Y%m%d-%H%M%S}")
        except ServiceError as error:
            self._say(f"the last minute before the fault is not kept: {error}")
            return
        for fill in fills:
            fill(recorder)
        recorder.close()
        if recorder.lost:
            self._say(f"the last minute before the fault is not whole in {recorder.path}: {recorder.cause}")
