"""What loops say, made into what sinks are given: drawings in batches, the goal, lines of the log."""

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
from trirail.telemetry.blueprint import Shown
from trirail.telemetry.columns import SECOND
from trirail.telemetry.journal import EVENTS, Entry
from trirail.telemetry.readout import Standing
from trirail.telemetry.scene import Scene
from trirail.telemetry.shown_alignment import ShownAlignment
from trirail.telemetry.shown_robot import ShownRobot
from trirail.wire.messages import Event, Level
from trirail.wire.packets import ControlInput
from trirail.wire.records import DTYPE, unpack

APPLICATION = "trirail"
LIVE_HZ = 5
"""Batches of what is drawn a second to a live view: its picture moves as often."""
REPORT_EVERY = 10.0
"""How often the log may say that something is missing [s]."""


class Sink(Protocol):
    """Takes batches; what it cannot take it counts."""

    def write_chunks(self, chunks: list[Chunk]) -> None:
        """Take a batch; never waits for long."""


class Streams:
    """One robot's recording, with its drawing and its layout, and the sinks that it goes to.

    With a `root`, an entity, all of it is below that: others may be in the same recording.
    """

    def __init__(self, robot: ShownRobot, name: str, wall_offset_ns: int, root: str = "") -> None:
        self.scene = Scene(robot, wall_offset_ns)
        self.shown = Shown(robot, self.scene.bounds, root)
        """What a layout is made of."""
        self._name = name
        self._rate_hz = robot.rate_hz
        self._wall_offset_ns = wall_offset_ns
        self._recording = str(uuid.uuid4())
        self._streams: list[rr.RecordingStream] = []
        self._waiting: list[Chunk] = []
        self._entries: list[Entry] = []
        self._paces: dict[Sink, int] = {}
        self._batches: dict[int, Batches] = {}
        self._newest = bytes(DTYPE.itemsize)
        self._standing = Standing()
        self._goal_drawn = True
        self._alignment = ShownAlignment()

    def open(self, sink: rr.FileSink | rr.GrpcServerSink) -> rr.RecordingStream:
        """Return a stream of this recording to a sink of Rerun's, with what stands still and the layout in it."""
        stream = rr.RecordingStream(APPLICATION, recording_id=self._recording)
        stream.set_sinks(sink, default_blueprint=blueprint.layout(self.shown))
        stream.send_recording_name(self._name)
        self.join(stream)
        return stream

    def join(self, stream: rr.RecordingStream) -> None:
        """Give a stream what stands still, now and when it changes."""
        for path, archetype in self.scene.still():
            stream.log(f"{self.shown.root}{path}", archetype, static=True)
        self._streams.append(stream)

    def attach(self, sink: Sink, drawing_hz: int) -> None:
        """Give a sink everything that is said from now on, and so many batches of drawings a second.

        Called anew, it changes how many. Sinks of the same pace share their drawings: to draw costs the most.
        """
        if self._paces.get(sink) == drawing_hz:
            return
        self.flush()
        self._paces[sink] = drawing_hz
        self._batches = {hz: Batches(self._rate_hz // hz, partial(self._draw, hz)) for hz in set(self._paces.values())}

    @property
    def t(self) -> float:
        """Nominal time of the newest record [s]."""
        return float(self._record["cycle"]) / self._rate_hz

    def records(self, batch: bytes) -> None:
        """Take packed records."""
        if not self._goal_drawn:
            self._goal_drawn = True
            self._waiting += self.scene.goal(unpack(batch)[0], self._standing.target)
        for batches in self._batches.values():
            batches.add(batch)
        self._newest = batch[-DTYPE.itemsize :]

    def stands(self, standing: Standing) -> None:
        """Take what holds from the next record on."""
        self._goal_drawn = self._goal_drawn and standing.target == self._standing.target
        self._standing = standing

    def bus_load(self, share: float) -> None:
        """Take the load of the bus, 1 for a full one."""
        for path, archetype in self.scene.bus_load(share):
            for stream in self._streams:
                stream.log(f"{self.shown.root}{path}", archetype, static=True)

    def event(self, event: Event) -> None:
        """Take an event."""
        self._entries.append(journal.said(event))
        if event.alignment is not None:
            self._waiting += self._alignment.drawing_of(event, event.alignment)

    def control_input(self, what: ControlInput) -> None:
        """Take what the control was given."""
        self._entries.append(journal.control_input(what, self._rate_hz, self._wall_offset_ns))

    def say(self, level: Level, message: str) -> None:
        """Write a line of the log at the time of the newest record."""
        wall = (int(self._record["deadline_ns"]) + self._wall_offset_ns) / SECOND
        self._entries.append(Entry(EVENTS, self.t, wall, message, level))

    def begin_anew(self) -> None:
        """Say with the next records again what else is said only when it changes: a sink has begun a new file."""
        self._goal_drawn = self._standing.target is None

    def drop(self, stream: rr.RecordingStream) -> None:
        """Let go of a stream: it is complete."""
        self._streams.remove(stream)

    def save(self) -> None:
        """Pass on what was said: together, for a batch costs about the same with one line or ten."""
        chunks = self._placed(self._waiting + journal.chunks(self._entries))
        self._waiting, self._entries = [], []
        if chunks:
            for sink in self._paces:
                sink.write_chunks(chunks)

    def flush(self) -> None:
        """Pass on all there is."""
        self.save()
        for batches in self._batches.values():
            batches.flush()

    @property
    def _record(self) -> np.void:
        newest: np.void = unpack(self._newest)[0]
        return newest

    def _draw(self, hz: int, records: NDArray[np.void]) -> None:
        chunks = self._placed(self.scene.drawn(records, self._standing))
        for sink, pace in self._paces.items():
            if pace == hz:
                sink.write_chunks(chunks)

    def _placed(self, chunks: list[Chunk]) -> list[Chunk]:
        root = self.shown.root
        return [chunk.with_entity_path(f"{root}{chunk.entity_path}") for chunk in chunks] if root else chunks


def open_together(several: Sequence[Streams], name: str, sink: rr.FileSink | rr.GrpcServerSink) -> rr.RecordingStream:
    """Return a stream to a sink of Rerun's, in which several robots are side by side, each below its root."""
    stream = rr.RecordingStream(APPLICATION, recording_id=str(uuid.uuid4()))
    stream.set_sinks(sink, default_blueprint=blueprint.side_by_side([streams.shown for streams in several]))
    stream.send_recording_name(name)
    for streams in several:
        streams.join(stream)
    return stream


class Shortfall:
    """Says in the log what is missing, when that is more than was last said, and not too often."""

    def __init__(self, streams: Streams, words: str, counts: Callable[[], tuple[int, ...]]) -> None:
        self._streams = streams
        self._words = words
        self._counts = counts
        self._said = counts()
        self._next = 0.0

    def check(self) -> None:
        """Say it if it is time to."""
        missing = self._counts()
        if missing != self._said and self._streams.t >= self._next:
            self._said, self._next = missing, self._streams.t + REPORT_EVERY
            self._streams.say("warning", self._words.format(*missing))


class Batches:
    """Records, put together until there are enough to be worth passing on."""

    def __init__(self, size: int, deliver: Callable[[NDArray[np.void]], None]) -> None:
        self._enough = max(1, size) * DTYPE.itemsize
        self._deliver = deliver
        self._pending = bytearray()

    def add(self, batch: bytes) -> None:
        """Add packed records; pass all on if that makes enough."""
        self._pending += batch
        if len(self._pending) >= self._enough:
            self.flush()

    def flush(self) -> None:
        """Pass on what there is."""
        if self._pending:
            records = unpack(bytes(self._pending))
            self._pending.clear()
            self._deliver(records)
