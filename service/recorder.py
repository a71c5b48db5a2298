"""The recorder: takes records, events and frames, and gives them to the file and to the live view."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from service.candump import CandumpLog
from service.config import Config
from service.errors import ServiceError
from service.messages import Event
from service.show import LIVE_HZ, Batches, Shortfall, Show
from service.sinks import Archive, Relay, live_relay, live_server
from service.subject import Subject

RECORDS_HZ = 5
"""Batches of whole records a second to the file: a killed process loses the newest one."""
DRAWING_HZ = 1
"""Batches of what is drawn a second to the file: fewer are smaller, and records are enough to draw it again."""
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
        self._show = show = Show(Subject.configured(config), name, started_ns - monotonic_ns())
        self._archive = Archive(show.open(rr.FileSink(self.path)), self.path)
        self._records = Batches(config.loop.rate_hz // RECORDS_HZ, self._record)
        show.attach(self._archive, DRAWING_HZ)
        self._live: Relay | None = None
        self.live_url = ""
        """Where viewers connect; empty without a live view."""
        if server:
            self._live = live_relay(show.open(server))
            show.attach(self._live, LIVE_HZ)
            self.live_url = server.uri
        self._missing = Shortfall(show, MISSING, lambda: (self.lost, self.skipped))

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
        self._records.add(batch)
        self._show.records(batch)

    def event(self, event: Event) -> None:
        """Take an event."""
        self._show.event(event)

    def target(self, pose: Sequence[float] | None) -> None:
        """Take the pose that the goal leads to; None for no goal."""
        self._show.target(pose)

    def bus_load(self, share: float) -> None:
        """Take the load of the bus, 1 for a full one."""
        self._show.bus_load(share)

    def frames(self, batch: bytes) -> None:
        """Take captured CAN frames, packed as drivers.capture.FRAME."""
        if self._frames:
            self._frames.write(batch)

    def close(self) -> None:
        """Write what is left and complete the file; waits a few seconds at most for a stuck disk or viewer."""
        self._records.flush()
        self._show.flush()
        self._missing.say()
        self._archive.close()
        if self._frames:
            self._frames.close()
        if self._live:
            self._live.close()

    def _record(self, records: NDArray[np.void]) -> None:
        self._archive.send(self._show.scene.complete(records))
        self._missing.check()


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
