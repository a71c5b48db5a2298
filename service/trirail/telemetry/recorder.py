"""The recorder: takes records, events and frames, and gives them to the file and to the live view."""

from __future__ import annotations

import contextlib
import errno
import sqlite3
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from trirail_drivers import files

from trirail.config import Config
from trirail.errors import ServiceError
from trirail.telemetry import provenance, retention
from trirail.telemetry.candump import CandumpLog
from trirail.telemetry.contents import STAMP, Contents
from trirail.telemetry.readout import Standing
from trirail.telemetry.rotation import RotatedFiles, claim
from trirail.telemetry.session_index import SessionIndex
from trirail.telemetry.shown_robot import ShownRobot
from trirail.telemetry.sinks import RESERVE, Relay, is_watched, live_relay, live_server
from trirail.telemetry.streams import LIVE_HZ, REPORT_EVERY, Batches, Streams
from trirail.wire.messages import Event
from trirail.wire.packets import ControlInput
from trirail.wire.records import SIZE, last_cycle

RECORDS_HZ = 5
"""Batches of whole records a second to the file, at least."""
DRAWING_HZ = 1
"""Batches of what is drawn a second to the file: fewer are smaller, and records are enough to draw it again."""
LOOKS_HZ = 1
"""How often a second it is looked whether files, folder, log or live view want something."""
TIDY_EVERY = 10.0
"""How often the folder is looked at, and the index gets what is in the newest file [s]."""
MB = 1e6


class Recorder:
    """One recording, from start to close.

    Its files are `path` or `<robot>-<date>-<time>.rrd` in `directory`, and where it is rotated the same with
    `-part2` and so on; with telemetry.capture_can, every CAN frame goes to a .log file beside the first. A black
    box, given its `name` and `reason` and not a path, is one file, which takes what room there is. What is in each
    file is entered into the `index` when it is complete.

    `warn` is told what is missing; else that stands in the log alone. Raises ServiceError if the file cannot be
    written or the live port is taken, FileError if `path` is no regular file.
    """

    def __init__(
        self,
        config: Config,
        directory: Path,
        *,
        path: Path | None = None,
        name: str | None = None,
        reason: str | None = None,
        index: SessionIndex | None = None,
        live: bool = True,
        warn: Callable[[str], None] | None = None,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        started_ns = wall_ns()
        self._config = config
        self._is_black_box = name is not None
        self._own_folder = directory if path is None and name is None else None
        session = name or f"{config.robot.name}-{datetime.fromtimestamp(started_ns * 1e-9).astimezone():{STAMP}}"
        telemetry = config.telemetry
        self._streams = streams = Streams(ShownRobot.configured(config), session, started_ns - monotonic_ns())
        self._warn = warn or (lambda words: streams.say("warning", words))
        server = live_server(telemetry.live_port, telemetry.live_mb) if live and telemetry.live_port else None
        try:
            first = claim(directory, session) if path is None else _overwrite(path)
            channel = config.can.channel or config.can.interface
            captured = config.telemetry.capture_can and not self._is_black_box
            log = first.with_suffix(".log")
            self._frames = CandumpLog(log, channel, self._warn) if captured else None
        except OSError as error:
            raise ServiceError(
                f"cannot write a recording to {path or directory}: {error.strerror}; {_remedy(error)}"
            ) from error
        self._frames_cause = ""
        self._index, self._reason, self._wall_offset_ns = index, reason, started_ns - monotonic_ns()
        self._contents: Contents | None = None
        self._entered = ""
        """Why nothing could be entered into the index, when that was last tried."""
        reserve = 0 if self._is_black_box else RESERVE
        self._own_files = first.parent
        self._files = RotatedFiles(first, self._open, streams.drop, reserve, lambda: monotonic_ns() * 1e-9, self._warn)
        self._records = Batches(config.loop.rate_hz // RECORDS_HZ, self._record)
        streams.attach(self._files, DRAWING_HZ)
        self._live: Relay | None = None
        self.live_url = ""
        """Where viewers connect; empty without a live view."""
        if server:
            self._live = live_relay(streams.open(server))
            streams.attach(self._live, LIVE_HZ)
            self.live_url = server.uri
        self._last: int | None = None
        self._absent = 0
        self._reported = (0, 0, 0)
        self._next_look = 0
        self._next_report = 0.0
        self._next_tidy = 0.0
        self._next_entry = 0.0
        self._untidy = ""
        self._troubled = ""
        """What was said to get into no file."""
        self._well_at = 0.0
        """When it will have got into one for long enough that this is said."""

    @property
    def path(self) -> Path:
        """The newest file of the recording."""
        return self._files.path

    @property
    def lost(self) -> int:
        """Batches of records, events or frames that the disk did not take."""
        return self._files.lost + (self._frames.lost if self._frames else 0)

    @property
    def cause(self) -> str:
        """Why the disk did not take the newest of them; empty if none is lost."""
        return self._files.cause or self._frames_cause

    @property
    def unrecorded(self) -> tuple[str, str]:
        """What is taken now and gets into no file, and why; empty while all does."""
        if self._files.trouble:
            return "nothing is recorded", self._files.trouble
        if self._frames and self._frames.trouble:
            return "no CAN frames are captured", self._frames.trouble
        return "", ""

    @property
    def skipped(self) -> int:
        """Batches that the live view was too slow for."""
        return self._live.skipped if self._live else 0

    @property
    def missing(self) -> tuple[int, int, int]:
        """What is missing: batches in the file, in the live view, and cycles that this recorder was too slow for."""
        return self.lost, self.skipped, self._absent

    def records(self, batch: bytes) -> None:
        """Take packed records."""
        last = last_cycle(batch)
        if self._last is not None:
            self._absent += last - self._last - len(batch) // SIZE
        self._last = last
        if last >= self._next_look:
            self._next_look = last + self._config.loop.rate_hz // LOOKS_HZ
            self._look_after()
        self._records.add(batch)
        self._streams.records(batch)
        if self._contents is not None:
            self._contents.records(batch, self._wall_offset_ns)

    def save(self) -> None:
        """Write all records that have been taken, and what was said: they outlive this process."""
        self._records.flush()
        self._streams.save()

    def event(self, event: Event) -> None:
        """Take an event."""
        self._streams.event(event)
        if self._contents is not None:
            self._contents.event(event)

    def control_input(self, what: ControlInput) -> None:
        """Take what the control was given."""
        self._streams.control_input(what)
        if self._contents is not None:
            self._contents.control_input(what)

    def stands(self, standing: Standing) -> None:
        """Take what holds from now on and records do not say."""
        self._streams.stands(standing)

    def bus_load(self, share: float) -> None:
        """Take the load of the bus, 1 for a full one."""
        self._streams.bus_load(share)

    def frames(self, batch: bytes) -> None:
        """Take captured CAN frames, packed as trirail_drivers.bus.capture.FRAME."""
        if self._frames:
            self._frames.write(batch)
            self._frames_cause = self._frames.trouble or self._frames_cause

    def close(self) -> None:
        """Write what is left and complete the file; waits a few seconds at most for a stuck disk or viewer."""
        self._flush()
        if words := self._missing():
            self._streams.say("warning", words)
            self._streams.save()
        self._files.close()
        self._enter()
        if self._frames:
            self._frames.close()
        if self._live:
            self._live.close()

    def _open(self, path: Path) -> rr.RecordingStream:
        """Begin a file: with all in it that it takes to be looked at by itself."""
        self._enter()
        self._contents = Contents(path.name, self._config.robot.name, reason=self._reason)
        stream = self._streams.open(rr.FileSink(path))
        for entity, text in provenance.texts(self._config).items():
            stream.log(entity, rr.TextDocument(text), static=True)
        self._streams.begin_anew()
        return stream

    def _enter(self, *, running: bool = False) -> None:
        """Enter what is in the newest file into the index: all of it, or with `running` what is so far.

        One that has been deleted is taken out.
        """
        if self._index is None or self._contents is None:
            return
        self._contents.running = running
        try:
            if (self._own_files / self._contents.name).exists():
                self._index.put([self._contents])
            else:
                self._index.forget([self._contents.name])
        except (sqlite3.Error, OSError) as error:
            words = f"the index of sessions takes no more, trirail sessions makes it anew: {error}"
        else:
            words = ""
        if words and words != self._entered:
            self._warn(words)
        self._entered = words

    def _record(self, records: NDArray[np.void]) -> None:
        self._files.write_chunks(self._streams.scene.complete(records))

    def _flush(self) -> None:
        self._records.flush()
        self._streams.flush()

    def _look_after(self) -> None:
        """Rotate the file, tidy the folder and say what is missing, where it is time to."""
        t = self._streams.t
        if not self._is_black_box:
            self._rotate()
        if self._live:  # where nobody watches, it shares the file's drawings
            self._streams.attach(self._live, LIVE_HZ if is_watched(self._config.telemetry.live_port) else DRAWING_HZ)
        if self._own_folder is not None and t >= self._next_tidy:
            self._next_tidy = t + TIDY_EVERY
            self._tidy(self._own_folder, self._config.telemetry.keep_mb * MB)
        if t >= self._next_entry and self._contents is not None and self._contents.began is not None:
            self._next_entry = t + TIDY_EVERY
            if not self._files.trouble:
                self._enter(running=True)
        if not self._tell_trouble(t) and t >= self._next_report and (words := self._missing()):
            self._next_report = t + REPORT_EVERY
            self._warn(words)

    def _tell_trouble(self, t: float) -> bool:
        """Say once that something gets into no file, and once that it does again; whether that is so or has just been.

        A disk that is full now and then is told to be well when it has been for REPORT_EVERY.
        """
        what, why = self.unrecorded
        if what:
            self._well_at = t + REPORT_EVERY
            if what != self._troubled:
                self._warn(f"{what}: {why}")
            self._troubled = what
        elif self._troubled and t >= self._well_at:
            self._troubled = ""
            self._warn(f"recorded again; {self._missing()}")
        return bool(self._troubled)

    def _rotate(self) -> None:
        """Go on in another file where it is time to; not where the disk is full, for that has no room for it."""
        telemetry, volumes = self._config.telemetry, self._files
        full = volumes.age >= telemetry.rotate_minutes * 60.0 or volumes.size >= telemetry.rotate_mb * MB
        if full and not volumes.trouble:
            self._flush()
            volumes.turn()

    def _tidy(self, folder: Path, at_most: float) -> None:
        try:
            deleted = retention.tidy(folder, at_most)
            if deleted and self._index is not None:
                self._index.forget([path.name for path in deleted])
        except (OSError, sqlite3.Error) as error:
            words = f"cannot delete old recordings, or their rows in the index: {error}"
            if words != self._untidy:
                self._untidy = words
                self._warn(words)

    def _missing(self) -> str:
        """Return what is missing, in words, if that is more than was last said."""
        if self.missing == self._reported:
            return ""
        self._reported = self.missing
        because = f" ({self.cause})" if self.cause else ""
        return (
            f"missing so far: {self.lost} batches in the file{because}, {self.skipped} in the live view, "
            f"{self._absent} cycles that the recorder was too slow for"
        )


def _remedy(error: OSError) -> str:
    """What is to be done where no file can be begun."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "make room on that disk; telemetry.keep_mb bounds what recordings take of it"
    return "telemetry.directory must be a folder that can be written"


def _overwrite(path: Path) -> Path:
    """Create an empty file, or empty it. Raises FileError for what is no file: a FIFO would wait for a reader."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileNotFoundError):
        files.check(path)
    path.open("wb").close()
    return path
