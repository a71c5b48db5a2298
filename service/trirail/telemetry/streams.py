"""Conversion of the loop's messages to drawings and log lines, sent in batches to the sinks of a recording."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from trirail.telemetry import blueprint, journal
from trirail.telemetry.blueprint import RobotView
from trirail.telemetry.columns import SECOND
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.journal import EVENTS, Entry
from trirail.telemetry.readout import ReadoutState
from trirail.telemetry.scene import Scene
from trirail.telemetry.shown_alignment import ShownAlignment
from trirail.wire.messages import Event, Level
from trirail.wire.packets import ControlInput
from trirail.wire.records import DTYPE, unpack

APPLICATION = "trirail"
LIVE_HZ = 5
"""Number of batches of drawings per second sent to a live view, which is its frame rate."""
REPORT_EVERY = 10.0
"""Minimum interval between reports of missing data in the log [s]."""


class Sink(Protocol):
    """Receiver of batches, which counts the batches that it cannot accept."""

    def write_chunks(self, chunks: list[Chunk]) -> None:
        """Write a batch without waiting long; if writing fails, count the batch as lost."""


class Streams:
    """Rerun streams of one robot, with its drawing, its layout and its sinks.

    All entity paths begin with `root`. With different roots, several robots can be in the same recording.
    """

    def __init__(self, robot: DrawnRobot, name: str, wall_offset_ns: int, root: str = "") -> None:
        self.scene = Scene(robot, wall_offset_ns)
        self.shown = RobotView(robot, self.scene.bounds, root)
        """Data that a layout needs to show the robot."""
        self._name = name
        self._rate_hz = robot.rate_hz
        self._wall_offset_ns = wall_offset_ns
        self._recording = str(uuid.uuid4())
        self._streams: list[rr.RecordingStream] = []
        self._waiting: list[Chunk] = []
        self._entries: list[Entry] = []
        self._rates: dict[Sink, int] = {}
        self._batches: dict[int, Batches] = {}
        self._drawn: dict[int, np.void] = {}
        """Last record that was drawn at each rate."""
        self._newest = bytes(DTYPE.itemsize)
        self._state = ReadoutState()
        self._goal_drawn = True
        self._alignment = ShownAlignment()

    def open(self, sink: rr.FileSink | rr.GrpcServerSink) -> rr.RecordingStream:
        """Return a new stream of this recording to a Rerun sink, and send the static parts and the layout to it."""
        stream = rr.RecordingStream(APPLICATION, recording_id=self._recording)
        stream.set_sinks(sink, default_blueprint=blueprint.layout(self.shown))
        stream.send_recording_name(self._name)
        self.join(stream)
        return stream

    def join(self, stream: rr.RecordingStream) -> None:
        """Send the static parts to a stream, and send them again whenever they change."""
        for path, archetype in self.scene.still():
            stream.log(f"{self.shown.root}{path}", archetype, static=True)
        self._streams.append(stream)

    def attach(self, sink: Sink, drawing_hz: int) -> None:
        """Send all subsequent data to a sink. The records are drawn in `drawing_hz` batches per second.

        Another call changes the rate for this sink. Sinks with the same rate share their drawings, because drawing is
        the most expensive step.
        """
        if self._rates.get(sink) == drawing_hz:
            return
        self.flush()
        self._rates[sink] = drawing_hz
        self._drawn.clear()
        self._batches = {hz: Batches(self._rate_hz // hz, partial(self._draw, hz)) for hz in set(self._rates.values())}

    @property
    def t(self) -> float:
        """Nominal time of the newest record [s]."""
        return float(self._record["cycle"]) / self._rate_hz

    def records(self, batch: bytes) -> None:
        """Send packed records to the sinks."""
        if not self._goal_drawn:
            self._goal_drawn = True
            self._waiting += self.scene.goal(unpack(batch)[0], self._state.target)
        for batches in self._batches.values():
            batches.add(batch)
        self._newest = batch[-DTYPE.itemsize :]

    def set_wall_offset(self, offset_ns: int) -> None:
        """Set the wall clock minus the monotonic clock for all later data [ns]. Call flush before."""
        self._wall_offset_ns = offset_ns
        self.scene.set_wall_offset(offset_ns)

    def update_state(self, state: ReadoutState) -> None:
        """Set the state that the readout shows from the next record on."""
        self._goal_drawn = self._goal_drawn and state.target == self._state.target
        self._state = state

    def bus_load(self, share: float) -> None:
        """Set the displayed bus load; 1 means a full bus."""
        for path, archetype in self.scene.bus_load(share):
            for stream in self._streams:
                stream.log(f"{self.shown.root}{path}", archetype, static=True)

    def event(self, event: Event) -> None:
        """Add an event to the log."""
        self._entries.append(journal.event_entry(event))
        if event.alignment is not None:
            self._waiting += self._alignment.drawing_of(event, event.alignment)

    def control_input(self, item: ControlInput) -> None:
        """Add a line to the log for an input to the control loop."""
        self._entries.append(journal.input_entry(item, self._rate_hz, self._wall_offset_ns))

    def log(self, level: Level, message: str) -> None:
        """Add a line to the log, at the time of the newest record."""
        wall = (int(self._record["deadline_ns"]) + self._wall_offset_ns) / SECOND
        self._entries.append(Entry(EVENTS, self.t, wall, message, level))

    def resend_state(self) -> None:
        """Send unchanged data again with the next records. A sink that begins a new file needs that data."""
        self._goal_drawn = self._state.target is None

    def drop(self, stream: rr.RecordingStream) -> None:
        """Remove a finished stream, which then receives no more changes of the static parts."""
        self._streams.remove(stream)

    def save(self) -> None:
        """Send all pending messages in one batch. A batch costs about the same for one line as for ten."""
        chunks = self._placed(self._waiting + journal.chunks(self._entries))
        self._waiting, self._entries = [], []
        if chunks:
            for sink in self._rates:
                sink.write_chunks(chunks)

    def flush(self) -> None:
        """Send all pending messages and records."""
        self.save()
        for batches in self._batches.values():
            batches.flush()

    @property
    def _record(self) -> np.void:
        newest: np.void = unpack(self._newest)[0]
        return newest

    def _draw(self, hz: int, records: NDArray[np.void]) -> None:
        chunks = self._placed(self.scene.drawn(records, self._state, self._drawn.get(hz)))
        self._drawn[hz] = records[-1]
        for sink, pace in self._rates.items():
            if pace == hz:
                sink.write_chunks(chunks)

    def _placed(self, chunks: list[Chunk]) -> list[Chunk]:
        root = self.shown.root
        return [chunk.with_entity_path(f"{root}{chunk.entity_path}") for chunk in chunks] if root else chunks


def open_together(several: Sequence[Streams], name: str, sink: rr.FileSink | rr.GrpcServerSink) -> rr.RecordingStream:
    """Return a new stream to a Rerun sink that shows several robots side by side."""
    stream = rr.RecordingStream(APPLICATION, recording_id=str(uuid.uuid4()))
    stream.set_sinks(sink, default_blueprint=blueprint.side_by_side([streams.shown for streams in several]))
    stream.send_recording_name(name)
    for streams in several:
        streams.join(stream)
    return stream


class MissingDataReport:
    """Report of missing data in the log, written when more data is missing, but at most every REPORT_EVERY seconds.

    `counts` returns the numbers of missing items, which are inserted into `words`.
    """

    def __init__(self, streams: Streams, words: str, counts: Callable[[], tuple[int, ...]]) -> None:
        self._streams = streams
        self._words = words
        self._counts = counts
        self._reported = counts()
        self._next = 0.0

    def check(self) -> None:
        """Write a report if more data is missing and REPORT_EVERY has passed since the last report."""
        missing = self._counts()
        if missing != self._reported and self._streams.t >= self._next:
            self._reported, self._next = missing, self._streams.t + REPORT_EVERY
            self._streams.log("warning", self._words.format(*missing))


class Batches:
    """Collector of records, which delivers them in batches of at least `size` records."""

    def __init__(self, size: int, deliver: Callable[[NDArray[np.void]], None]) -> None:
        self._batch_bytes = max(1, size) * DTYPE.itemsize
        self._deliver = deliver
        self._pending = bytearray()

    def add(self, batch: bytes) -> None:
        """Add packed records. If there are enough for a batch, deliver all collected records."""
        self._pending += batch
        if len(self._pending) >= self._batch_bytes:
            self.flush()

    def flush(self) -> None:
        """Deliver the collected records, even if they are fewer than a full batch."""
        if self._pending:
            records = unpack(bytes(self._pending))
            self._pending.clear()
            self._deliver(records)
