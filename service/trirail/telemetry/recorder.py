"""Recorder, which writes records and events to a file and to the live view, and CAN frames to a log file."""

from __future__ import annotations

import contextlib
import errno
import math
import time
from collections import deque
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk
from trirail_drivers import files

from trirail.config import Config
from trirail.errors import ServiceError
from trirail.telemetry import contents, provenance, retention
from trirail.telemetry.candump import CandumpLog
from trirail.telemetry.contents import Contents
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.journal import EVENTS, REQUESTS
from trirail.telemetry.readout import ReadoutState
from trirail.telemetry.retention import STAMP, name_in_order
from trirail.telemetry.rotation import RotatedFiles, claim
from trirail.telemetry.sinks import RESERVE, Relay, free_space, is_watched, live_relay, live_server
from trirail.telemetry.streams import LIVE_HZ, REPORT_EVERY, Batches, Streams
from trirail.wire.event_codes import EventCode, EventText, coded, encodable
from trirail.wire.messages import Event
from trirail.wire.packets import ControlInput
from trirail.wire.records import SIZE, last_cycle

RECORDS_HZ = 5
"""Minimum number of batches of complete records per second written to the file."""
DRAWING_HZ = 1
"""Number of batches of drawings per second written to the file.

A low rate saves space. Nothing is lost, because the drawings can be made again from the records.
"""
CHECKS_HZ = 1
"""Number of times per second that the files, the folder, the log and the live view are checked."""
FREE = RESERVE + (16 << 20)
"""Free space of the disk below which old recordings are deleted [bytes]. Below RESERVE, nothing would be recorded."""
TIDY_EVERY = 10.0
"""Interval at which the folder is checked, and at which the sidecar of the newest file is written [s]."""
MAX_UNWRITTEN = 1000
"""Maximum number of batches of events that are kept until the disk has recovered."""
MB = 1e6
CLOCK_STEP_NS = 5_000_000
"""Minimum change of the wall clock against the monotonic clock that counts as a step [ns].

Both clocks follow the corrections of the network time in the same way, so only a clock that is set makes a step.
"""
CLOCK_READING_NS = 1_000_000
"""Maximum duration of a reading of both clocks [ns]. A reading that was interrupted for longer is not used."""


class Recorder:
    """Writer of one recording.

    If telemetry.capture_can is set, the recorder also writes all CAN frames to a .log file next to each file.

    Parameters
    ----------
    config
        Configuration of the robot.
    directory
        Folder of the files `<robot>-<date>-<time>.rrd`; rotated files also have `-part2` and so on in their names. If
        the clock is behind the newest recording in the folder, the date is that of the next second after it.
    path
        File to write, instead of a new file in `directory`. A file that exists must be empty.
    name, reason
        Name of a black box, and the fault for which it is saved. A black box has only one file, and may fill the disk.
    sidecars
        Whether to write a summary of each file next to that file, which `trirail sessions` reads.
    live
        Whether to serve the live view.
    warn
        Function that receives reports of missing data. If it is None, the reports are written only to the log.
    wall_ns, monotonic_ns
        Functions that return the wall-clock time and the monotonic time [ns].

    Raises
    ------
    ServiceError
        The file exists, or cannot be written, or the live port is in use.
    FileError
        `path` is not a regular file.
    """

    def __init__(
        self,
        config: Config,
        directory: Path,
        *,
        path: Path | None = None,
        name: str | None = None,
        reason: str | None = None,
        sidecars: bool = False,
        live: bool = True,
        warn: Callable[[EventText], None] | None = None,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        started_ns = wall_ns()
        self._wall_offset_ns = started_ns - monotonic_ns()
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._config = config
        self._is_black_box = name is not None
        self._own_folder = directory if path is None and name is None else None
        dated = name or f"{config.robot.name}-{datetime.fromtimestamp(started_ns * 1e-9).astimezone():{STAMP}}"
        session = name_in_order(directory, dated) if path is None else dated
        telemetry = config.telemetry
        self._streams = streams = Streams(DrawnRobot.from_config(config), session, self._wall_offset_ns)
        self._warn = warn or (lambda text: streams.log("warning", text.text))
        server = live_server(telemetry.live_port, telemetry.live_mb) if live and telemetry.live_port else None
        try:
            channel = config.can.channel or config.can.interface
            captured = config.telemetry.capture_can and not self._is_black_box
            first = claim(directory, session) if path is None else _create(path, log=captured)
            log = first.with_suffix(".log")
            self._frames = CandumpLog(log, channel, self._warn) if captured else None
        except OSError as error:
            raise ServiceError(
                f"cannot write a recording to {path or directory}: {error.strerror}; {_remedy(error)}"
            ) from error
        self._frames_cause = ""
        self._sidecars, self._reason = sidecars, reason
        self._contents: Contents | None = None
        self._sidecar_error = ""
        """Reason why the last sidecar could not be written; empty if it was written."""
        self._events: list[Event] = []
        self._inputs: list[ControlInput] = []
        """Events and inputs that have not been passed to the file; they are in its next batch of log lines."""
        self._unwritten: deque[tuple[list[Chunk], list[Event]]] = deque(maxlen=MAX_UNWRITTEN)
        """Batches of events that could not be written, the oldest first."""
        reserve = 0 if self._is_black_box else RESERVE
        self._first, self._own_files = first, first.parent
        self._files = RotatedFiles(first, self._open, streams.drop, reserve, lambda: monotonic_ns() * 1e-9, self._warn)
        self._records = Batches(config.loop.rate_hz // RECORDS_HZ, self._record)
        streams.attach(self, DRAWING_HZ)
        self._live: Relay | None = None
        self.live_url = ""
        """Address to which viewers connect; empty if there is no live view."""
        if server:
            self._live = live_relay(streams.open(server))
            streams.attach(self._live, LIVE_HZ)
            self.live_url = server.uri
        self._last: int | None = None
        self._missed_cycles, self._reported, self._next_check = 0, (0, 0, 0), 0
        self._next_report = self._next_tidy = self._next_entry = 0.0
        self._tidy_error, self._space = "", retention.Space(FREE)
        self._reported_trouble = ""
        """Data reported as unrecorded, as returned by `unrecorded`; empty if no loss is being reported."""
        self._recovered_at = 0.0
        """Earliest time at which the end of a loss may be reported [s]."""

    @property
    def path(self) -> Path:
        """Newest file of the recording."""
        return self._files.path

    @property
    def lost(self) -> int:
        """Number of batches of records, events or frames that could not be written."""
        return self._files.lost + (self._frames.lost if self._frames else 0)

    @property
    def cause(self) -> str:
        """Reason why the most recently lost batch was lost; empty if no batch was lost."""
        return self._files.cause or self._frames_cause

    @property
    def unrecorded(self) -> tuple[str, str]:
        """Description of the data that currently does not reach a file, and the reason; both empty if all data does."""
        if self._files.trouble:
            return "nothing is recorded", self._files.trouble
        if self._frames and self._frames.trouble:
            return "no CAN frames are captured", self._frames.trouble
        return "", ""

    @property
    def keeps_events(self) -> bool:
        """Whether events wait for a file that can be written."""
        return bool(self._unwritten)

    @property
    def skipped(self) -> int:
        """Number of batches that were dropped because the live view was too slow."""
        return self._live.skipped if self._live else 0

    @property
    def missing(self) -> tuple[int, int, int]:
        """Three counts: batches missing in the file, batches missing in the live view, and cycles not received."""
        return self.lost, self.skipped, self._missed_cycles

    @property
    def wall_offset_ns(self) -> int:
        """Wall clock minus monotonic clock, from which the times of records and inputs are computed [ns]."""
        return self._wall_offset_ns

    def set_wall_offset(self, offset_ns: int) -> None:
        """Set the wall clock minus the monotonic clock for all later data [ns]; earlier data keeps its times."""
        if offset_ns != self._wall_offset_ns:
            self._flush()
            self._wall_offset_ns = offset_ns
            self._streams.set_wall_offset(offset_ns)

    def records(self, batch: bytes) -> None:
        """Write packed records, and run the periodic checks when they are due."""
        if not self._is_black_box:  # the data of a black box is older than the present time
            self._follow_wall_clock()
        last = last_cycle(batch)
        if self._last is not None:
            self._missed_cycles += last - self._last - len(batch) // SIZE
        self._last = last
        if last >= self._next_check:
            self._next_check = last + self._config.loop.rate_hz // CHECKS_HZ
            self._run_checks()
        self._records.add(batch)
        self._streams.records(batch)

    def save(self) -> None:
        """Write all records and log lines that have arrived, so that they survive the end of this process."""
        self._records.flush()
        self._streams.save()

    def event(self, event: Event) -> None:
        """Write an event."""
        self._streams.event(event)
        self._events.append(event)

    def control_input(self, item: ControlInput) -> None:
        """Write an input to the control loop."""
        self._streams.control_input(item)
        self._inputs.append(item)

    def update_state(self, standing: ReadoutState) -> None:
        """Set the state that the readout shows from now on."""
        self._streams.update_state(standing)

    def bus_load(self, share: float) -> None:
        """Set the displayed bus load; 1 means a full bus."""
        self._streams.bus_load(share)

    def frames(self, batch: bytes) -> None:
        """Write captured CAN frames, packed as trirail_drivers.bus.can_frame.CAPTURED."""
        if self._frames:
            self._frames.write(batch)
            self._frames_cause = self._frames.trouble or self._frames_cause

    def write_chunks(self, chunks: list[Chunk]) -> None:
        """Write a batch of drawings and log lines to the file.

        Events that cannot be written are kept, and are written again with each later batch until they are written.
        """
        inputs: list[ControlInput] = []
        if any(chunk.entity_path == REQUESTS for chunk in chunks):
            inputs, self._inputs = self._inputs, []
        if new := [chunk for chunk in chunks if chunk.entity_path == EVENTS]:
            self._unwritten.append((new, self._events))
            self._events = []
        kept = [chunk for events, _ in self._unwritten for chunk in events]
        if not self._write([*kept, *(chunk for chunk in chunks if chunk.entity_path != EVENTS)]):
            return
        if self._contents is not None:
            for event in (event for _, events in self._unwritten for event in events):
                self._contents.event(event)
            for item in inputs:
                self._contents.control_input(item)
        self._unwritten.clear()

    def close(self) -> None:
        """Write the remaining data and finish the file. Delete a file that has no cycle, unless it is a black box.

        If the disk or a viewer does not respond, this method waits for at most a few seconds.
        """
        self._flush()
        if words := self._missing_text():
            self._streams.log("warning", words)
            self._streams.save()
        self._files.close()
        if self._frames:
            self._frames.close()
        if self._last is None and not self._is_black_box:  # the service could not start
            with contextlib.suppress(OSError):
                self.path.unlink(missing_ok=True)
                if self._frames:
                    self.path.with_suffix(".log").unlink(missing_ok=True)
                if self._sidecars:
                    retention.sidecar(self.path).unlink(missing_ok=True)
        else:
            self._write_sidecar()
        if self._live:
            self._live.close()

    def _open(self, path: Path) -> rr.RecordingStream:
        """Begin a new file with all data that a viewer needs to show the file without earlier files."""
        self._write_sidecar()
        name, rate_hz = self._config.robot.name, self._config.loop.rate_hz
        self._contents = Contents(path.name, name, reason=self._reason, rate_hz=rate_hz)
        stream = self._streams.open(rr.FileSink(path))
        for entity, text in provenance.text_documents(self._config).items():
            stream.log(entity, rr.TextDocument(encodable(text)), static=True)
        self._streams.resend_state()
        if self._frames:
            self._frames.turn(path.with_suffix(".log"))
        return stream

    def _write_sidecar(self, *, running: bool = False) -> None:
        """Write the sidecar of the newest file, marked as not final if `running`."""
        if not self._sidecars or self._contents is None:
            return
        self._contents.running = running
        words, recording = "", self._own_files / self._contents.name
        try:
            contents.save(recording, self._contents)
        except FileNotFoundError:  # the recording was deleted
            retention.sidecar(recording).unlink(missing_ok=True)
        except OSError as error:
            words = (
                f"{retention.sidecar(recording)} cannot be written, so trirail sessions reads the recording itself: "
                f"{error}"
            )
            if words != self._sidecar_error:
                self._warn(coded(words, EventCode.NOT_INDEXED, error=str(error)))
        self._sidecar_error = words

    def _record(self, records: NDArray[np.void]) -> None:
        is_written = self._write(self._streams.scene.complete(records))
        if self._contents is None:
            return
        if is_written:
            began, ended = ((int(row["deadline_ns"]) + self._wall_offset_ns) * 1e-9 for row in records[[0, -1]])
            self._contents.add_cycles(began, ended, len(records))
        else:
            self._contents.lost_cycles += len(records)

    def _write(self, chunks: list[Chunk]) -> bool:
        """Write a batch to the newest file; return whether the batch was written."""
        lost = self._files.lost
        self._files.write_chunks(chunks)
        return self._files.lost == lost

    def _flush(self) -> None:
        self._records.flush()
        self._streams.flush()

    def _follow_wall_clock(self) -> None:
        """Use the time of the wall clock from now on if the clock was set, as the events of the service do."""
        before, wall, after = self._monotonic_ns(), self._wall_ns(), self._monotonic_ns()
        offset = wall - (before + after) // 2
        if after - before <= CLOCK_READING_NS and abs(offset - self._wall_offset_ns) > CLOCK_STEP_NS:
            self.set_wall_offset(offset)

    def _run_checks(self) -> None:
        """Rotate the file, delete old recordings, write the sidecar and report missing data, if any of these is due."""
        t = self._streams.t
        if not self._is_black_box:
            self._rotate()
        if self._live:  # while no viewer is connected, reuse the drawings made for the file, which costs nothing
            self._streams.attach(self._live, LIVE_HZ if is_watched(self._config.telemetry.live_port) else DRAWING_HZ)
        if self._own_folder is not None and t >= self._next_tidy:
            self._next_tidy = t + TIDY_EVERY
            self._tidy(self._own_folder, self._config.telemetry.keep_mb * MB)
        if self._own_folder is not None:
            self._make_room(self._own_folder)
        if t >= self._next_entry and self._contents is not None and self._contents.began is not None:
            self._next_entry = t + TIDY_EVERY
            if not self._files.trouble:
                self._write_sidecar(running=True)
        if not self._report_trouble(t) and t >= self._next_report and (words := self._missing_text()):
            self._next_report = t + REPORT_EVERY
            lost, skipped, absent = self.missing
            self._warn(coded(words, EventCode.RECORDING_INCOMPLETE, lost=lost, skipped=skipped, absent=absent))

    def _report_trouble(self, t: float) -> bool:
        """Report a loss once when it begins and once when it ends. Return True from the first report to the second.

        The end is reported only after REPORT_EVERY seconds without a loss, because space may become free on a full disk
        for short moments.
        """
        problem, why = self.unrecorded
        if problem:
            self._recovered_at = t + REPORT_EVERY
            if problem != self._reported_trouble:
                code = EventCode.NOT_RECORDED if self._files.trouble else EventCode.NOT_CAPTURED
                self._warn(coded(f"{problem}: {why}", code, error=why))
            self._reported_trouble = problem
        elif self._reported_trouble and t >= self._recovered_at:
            self._reported_trouble = ""
            self._warn(coded(f"recording resumed; {self._missing_text()}", EventCode.RECORDED_AGAIN))
        return bool(self._reported_trouble)

    def _rotate(self) -> None:
        """Continue in another file if the newest file is too old or too large, unless writing currently fails."""
        telemetry, volumes = self._config.telemetry, self._files
        full = volumes.age >= telemetry.rotate_minutes * 60.0 or volumes.size >= telemetry.rotate_mb * MB
        if full and not volumes.trouble:
            self._flush()
            volumes.turn()

    def _tidy(self, folder: Path, at_most: float) -> None:
        """Delete the oldest recordings if all need more than `at_most` bytes."""
        deleted, errors = retention.tidy(folder, at_most, self._first.stem)
        if deleted:
            names = ", ".join(path.name for path in deleted)
            words = (
                f"old recordings deleted, because all recordings exceed telemetry.keep_mb = {at_most / MB:g}: {names}"
            )
            self._warn(coded(words, EventCode.RECORDINGS_DELETED, keep_mb=at_most / MB, files=names))
        others = f", and {len(errors) - 1} more" if len(errors) > 1 else ""
        why = f"{errors[0]}{others}" if errors else ""
        if why and why != self._tidy_error:
            self._warn(coded(f"cannot delete old recordings: {why}", EventCode.RECORDINGS_KEPT, error=why))
        self._tidy_error = why

    def _make_room(self, folder: Path) -> None:
        """Delete the oldest recordings if little of their disk is free."""
        shortage = self._space.shortage(free_space(folder))
        if shortage > 0.0 and (deleted := retention.tidy(folder, math.inf, self._first.stem, shortage).deleted):
            self._space.note_deletion(free_space(folder))
            names = ", ".join(path.name for path in deleted)
            words = f"old recordings deleted, because less than {FREE / MB:.0f} MB of the disk were free: {names}"
            self._warn(coded(words, EventCode.RECORDINGS_DELETED_FOR_SPACE, free_mb=round(FREE / MB), files=names))

    def _missing_text(self) -> str:
        """Return a message about missing data if any count has changed since the last message; otherwise return ""."""
        if self.missing == self._reported:
            return ""
        self._reported = self.missing
        because = f" ({self.cause})" if self.cause else ""
        return (
            f"missing data: {self.lost} batches in the file{because}, {self.skipped} in the live view, "
            f"{self._missed_cycles} cycles (recorder too slow)"
        )


def _remedy(error: OSError) -> str:
    """Return advice for the user if a file could not be created."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free some space on that disk; telemetry.keep_mb limits the size of all recordings"
    return "set telemetry.directory to a folder that can be written"


def _create(path: Path, *, log: bool) -> Path:
    """Create an empty file and, if `log`, one for the log of CAN frames; empty files are used as they are.

    Raises FileError if a file is not a regular file (opening a FIFO would wait for a reader), and ServiceError if a
    recorder is writing the file, if it is not empty, or if it would also be the log.
    """
    if log and path.suffix == ".log":
        raise ServiceError(f"{path} would also be the log of CAN frames; name the recording {path.stem}.rrd")
    path.parent.mkdir(parents=True, exist_ok=True)
    for each in (path.with_suffix(".log"), path) if log else (path,):
        with contextlib.suppress(FileNotFoundError):
            files.check(each)
            if retention.is_being_written(each):
                raise ServiceError(f"{each} is being written, perhaps by another service; name another file")
            if each.stat().st_size:
                raise ServiceError(f"{each} already exists; name another file, or remove it")
        each.open("ab").close()
    return path
