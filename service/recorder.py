"""The recorder: takes records, events and frames, and gives them to the file and to the live view."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.chunk import Chunk

from service import blueprint
from service.candump import CandumpLog
from service.config import Config
from service.errors import ServiceError
from service.messages import Event
from service.records import DTYPE, unpack
from service.scene import Scene, remark
from service.sinks import Archive, Relay, live_relay, live_server

APPLICATION = "trirail"
RECORDS_HZ = 5
"""Batches of whole records a second to the file: a killed process loses the newest one."""
DRAWING_HZ = 1
"""Batches of what is drawn a second to the file: fewer are smaller, and records are enough to draw it again."""
LIVE_HZ = 5
"""Batches of what is drawn a second to the live view: its picture moves as often."""
REPORT_EVERY = 10.0
"""How often the log may say that something is missing [s]."""
MISSING = "missing so far: {} batches in the file (disk full or failing), {} in the live view (viewer too slow)"


class Recorder:
    """One recording, from start to close.

    The file is `path`, or `<robot>-<date>-<time>.rrd` in `directory`; with telemetry.capture_can, every CAN
    frame goes to a .log file beside it. Raises ServiceError if it cannot be written or the live port is taken.
    """

    def __init__(
        self,
        config: Config,
        directory: Path,
        *,
        path: Path | None = None,
        live: bool = True,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        started_ns = wall_ns()
        self._wall_offset_ns = started_ns - monotonic_ns()
        self._scene = Scene(config, self._wall_offset_ns)
        self._rate_hz = config.loop.rate_hz
        self._newest = np.zeros(1, DTYPE)[0]
        self._reported = (0, 0)
        self._next_report = 0.0

        name = f"{config.robot.name}-{datetime.fromtimestamp(started_ns * 1e-9).astimezone():%Y%m%d-%H%M%S}"
        server = live_server(config.telemetry.live_port) if live and config.telemetry.live_port else None
        try:
            self.path = _claim(directory, name) if path is None else _overwrite(path)
            """The recording file."""
            channel = config.can.channel or config.can.interface
            captured = config.telemetry.capture_can
            self._frames = CandumpLog(self.path.with_suffix(".log"), channel) if captured else None
        except OSError as error:
            raise ServiceError(
                f"cannot write a recording to {path or directory}: {error.strerror}; "
                "telemetry.directory must be a folder that can be written"
            ) from error
        layout = blueprint.layout(config, self._scene.bounds)
        open_stream = partial(self._open, str(uuid.uuid4()), name, layout)
        self._archive = Archive(open_stream(rr.FileSink(self.path)), self.path)
        self._batches = [
            Batches(self._rate_hz // RECORDS_HZ, self._record),
            Batches(self._rate_hz // DRAWING_HZ, lambda records: self._draw(records, self._archive)),
        ]
        self._live: Relay | None = None
        self.live_url = ""
        """Where viewers connect; empty without a live view."""
        if server:
            self._live = relay = live_relay(open_stream(server))
            self._batches.append(Batches(self._rate_hz // LIVE_HZ, lambda records: self._draw(records, relay)))
            self.live_url = server.uri

    @property
    def lost(self) -> int:
        """Batches of records, events or frames that the disk did not take."""
        return self._archive.lost + (self._frames.failures if self._frames else 0)

    @property
    def skipped(self) -> int:
        """Batches that the live view was too slow for."""
        return self._live.skipped if self._live else 0

    def records(self, batch: bytes) -> None:
        """Take packed records."""
        for batches in self._batches:
            batches.add(batch)

    def event(self, event: Event) -> None:
        """Take an event."""
        self._remark(remark(event.t, event.time, event.level, event.message))

    def frames(self, batch: bytes) -> None:
        """Take captured CAN frames, packed as drivers.capture.FRAME."""
        if self._frames:
            self._frames.write(batch)

    def close(self) -> None:
        """Write what is left and complete the file; waits a few seconds at most for a stuck disk or viewer."""
        for batches in self._batches:
            batches.flush()
        self._report()
        self._archive.close()
        if self._frames:
            self._frames.close()
        if self._live:
            self._live.close()

    def _open(
        self, recording: str, name: str, layout: rrb.Blueprint, sink: rr.FileSink | rr.GrpcServerSink
    ) -> rr.RecordingStream:
        stream = rr.RecordingStream(APPLICATION, recording_id=recording)
        stream.set_sinks(sink, default_blueprint=layout)
        stream.send_recording_name(name)
        for path, archetype in self._scene.still():
            stream.log(path, archetype, static=True)
        return stream

    def _record(self, records: NDArray[np.void]) -> None:
        self._archive.send(self._scene.complete(records))
        self._newest = records[-1]
        if float(self._newest["cycle"]) / self._rate_hz >= self._next_report:
            self._report()

    def _draw(self, records: NDArray[np.void], sink: Archive | Relay) -> None:
        sink.send(self._scene.drawn(records))

    def _report(self) -> None:
        """Say in the log what is missing, if it is more than was last said."""
        missing = (self.lost, self.skipped)
        if missing == self._reported:
            return
        t = float(self._newest["cycle"]) / self._rate_hz
        wall = float(self._newest["deadline_ns"] + self._wall_offset_ns) * 1e-9
        self._reported, self._next_report = missing, t + REPORT_EVERY
        self._remark(remark(t, wall, "warning", MISSING.format(*missing)))

    def _remark(self, line: Chunk) -> None:
        self._archive.send([line])
        if self._live:
            self._live.send([line])


class Batches:
    """Records, put together until there are enough to be worth passing on."""

    def __init__(self, size: int, take: Callable[[NDArray[np.void]], None]) -> None:
        self._enough = max(1, size) * DTYPE.itemsize
        self._take = take
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
            self._take(records)


def _claim(directory: Path, name: str) -> Path:
    """Create an empty file with a name that is not taken."""
    directory.mkdir(parents=True, exist_ok=True)
    path, number = directory / f"{name}.rrd", 1
    while True:
        try:
            path.open("xb").close()
        except FileExistsError:
            number += 1
            path = directory / f"{name}-{number}.rrd"
        else:
            return path


def _overwrite(path: Path) -> Path:
    """Create an empty file, or empty it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.open("wb").close()
    return path
