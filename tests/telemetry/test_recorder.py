"""The recorder: what is in the file, what happens when disk, port or viewer fail."""

from __future__ import annotations

import gc
import os
import resource
import shutil
import socket
import tempfile
import threading
import weakref
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import made
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from ports import free_port
from rerun.chunk import Chunk, RrdReader
from trirail.config import SIM, Config, load
from trirail.errors import ServiceError
from trirail.telemetry import contents
from trirail.telemetry.candump import CandumpLog
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.recorder import MAX_UNWRITTEN, Recorder
from trirail.telemetry.rotation import RotatedFiles
from trirail.telemetry.sinks import BACKLOG, RESERVE, Archive, Relay, is_watched
from trirail.telemetry.streams import Streams
from trirail.wire.messages import Event
from trirail.wire.packets import ControlInput, PlannerLost
from trirail.wire.records import DTYPE
from trirail_drivers.bus.can_frame import CAPTURED
from trirail_drivers.bus.frames import Frame, packed
from trirail_drivers.errors import FileError
from waiting import WITHIN, wait_until

WALL_NS = 1_795_245_300_000_000_000


def configured(**telemetry: Any) -> Config:
    config = load(SIM)
    return msgspec.structs.replace(config, telemetry=msgspec.structs.replace(config.telemetry, **telemetry))


def recorder(directory: Path, config: Config | None = None, **more: Any) -> Recorder:
    settled = {"live": False, "wall_ns": lambda: WALL_NS, "monotonic_ns": lambda: made.MONOTONIC_NS}
    return Recorder(config or configured(), directory, **{**settled, **more})


def feed(to: Recorder, records: NDArray[np.void], size: int = 50) -> None:
    for start in range(0, len(records), size):
        to.records(records[start : start + size].tobytes())


def chunks(path: Path, entity: str) -> list[Chunk]:
    return [chunk for chunk in RrdReader(path).stream() if chunk.entity_path == entity]


def read(path: Path) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """Return the records in a file, and their nominal times [ns]."""
    batches = [chunk.to_record_batch() for chunk in chunks(path, "/record")]
    records = np.zeros(sum(batch.num_rows for batch in batches), DTYPE)
    for name in DTYPE.names or ():
        columns = [batch.column("fields").flatten().field(name) for batch in batches]
        flat = [column.flatten() if records[name].ndim > 1 else column for column in columns]
        records[name] = np.concatenate([column.to_numpy() for column in flat]).reshape(records[name].shape)
    t = np.concatenate([batch.column("t").to_numpy().astype(np.int64) for batch in batches])
    order = np.argsort(t)
    return records[order], t[order]


def lines(path: Path) -> list[tuple[str, str]]:
    """Return level and text of a file's log."""
    return [
        (level[0], text[0])
        for chunk in chunks(path, "/events")
        for level, text in zip(
            chunk.to_record_batch().column("TextLog:level").to_pylist(),
            chunk.to_record_batch().column("words").to_pylist(),
            strict=True,
        )
    ]


def test_the_file_holds_every_record_in_exact_steps(tmp_path: Path) -> None:
    sent = made.records(1.234)
    recording = recorder(tmp_path / "new" / "folder")
    feed(recording, sent, 37)
    recording.close()
    records, t = read(recording.path)
    assert made.bits(records) == made.bits(sent)
    assert np.all(np.diff(t) == 1_000_000)
    assert recording.lost == 0


def test_the_file_holds_blueprint_drawing_and_curves(tmp_path: Path) -> None:
    recording = recorder(tmp_path)
    feed(recording, made.records(0.3))
    recording.close()
    reader = RrdReader(recording.path)
    (store,) = reader.recordings()
    assert store.application_id == "trirail"
    assert len(reader.blueprints()) == 1
    still = {chunk.entity_path for chunk in reader.stream() if chunk.is_static}
    moving = {chunk.entity_path for chunk in reader.stream() if not chunk.is_static}
    assert {"/robot/rails", "/robot/platform/outline", "/sliders/velocity", "/mode"} <= still
    assert {"/robot/platform", "/robot/sliders", "/sliders/velocity", "/mode", "/record"} <= moving


def test_events_are_lines_of_the_log(tmp_path: Path) -> None:
    recording = recorder(tmp_path)
    recording.event(
        Event("mode", "info", "enabled by ann", mode="holding", seq=1, t=0.5, cycle=500, time=WALL_NS * 1e-9)
    )
    recording.event(Event("fault", "error", "drive B: silent", seq=2, t=0.6, cycle=600, time=WALL_NS * 1e-9))
    feed(recording, made.records(0.01))
    recording.close()
    assert lines(recording.path) == [("INFO", "enabled by ann"), ("ERROR", "drive B: silent")]


def test_files_are_named_by_the_wall_clock_and_never_overwritten(tmp_path: Path) -> None:
    first, second = recorder(tmp_path), recorder(tmp_path)
    first.close()
    second.close()
    assert first.path.name.startswith("demo-2026112")
    assert second.path.name == f"{first.path.stem}-2.rrd"


@settings(max_examples=15, deadline=None)
@given(
    ran=st.booleans(),
    named=st.booleans(),
    sidecars=st.booleans(),
    came=st.lists(st.sampled_from(["event", "frames"]), max_size=3),
)
def test_a_service_that_does_not_start_leaves_no_recording(
    *, ran: bool, named: bool, sidecars: bool, came: list[str]
) -> None:
    """A service that is started again and again would push out the recordings of the robot by telemetry.keep_mb."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / "mine.rrd" if named else None
        recording = recorder(folder, configured(capture_can=True), path=path, sidecars=sidecars)
        for what in came:
            if what == "event":
                recording.event(Event("service", "error", "no bus", seq=1, t=0.0, cycle=0, time=WALL_NS * 1e-9))
            else:
                recording.frames(CAPTURED.pack(1.0, Frame(0x201).packed))
        if ran:
            feed(recording, made.records(0.01))
        recording.close()
        left = sorted(file.suffix for file in folder.iterdir())
        assert left == (sorted([".rrd", ".log", *([".json"] if sidecars else [])]) if ran else [])


def test_a_file_asked_for_by_name_is_written(tmp_path: Path) -> None:
    path = tmp_path / "mine.rrd"
    path.touch()  # as by mktemp
    recording = recorder(tmp_path / "elsewhere", path=path)
    feed(recording, made.records(0.1))
    recording.close()
    assert recording.path == path
    assert len(read(path)[0]) == 100
    assert not (tmp_path / "elsewhere").exists()


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(ServiceError, match=r"cannot write a recording to .*file/x: .*telemetry\.directory"):
        recorder(blocked / "x")


@pytest.mark.parametrize("kind", ["FIFO", "device", "folder"])
def test_what_is_no_file_is_not_recorded_to(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.rrd"
    if kind == "FIFO":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/null")
    else:
        path.mkdir()
    with pytest.raises(FileError, match=rf"a\.rrd: a {kind}; expected a regular file"):
        Recorder(load(SIM), tmp_path, path=path, live=False)


def test_a_file_that_another_recorder_is_writing_is_not_begun_anew(tmp_path: Path) -> None:
    first = recorder(tmp_path)
    feed(first, made.records(0.2))
    with pytest.raises(ServiceError, match=rf"{first.path.name} is being written.*name another file"):
        recorder(tmp_path, path=first.path)
    first.close()
    assert len(read(first.path)[0]) == 200


@pytest.mark.parametrize("name", ["session.rrd", "robot.toml", "session.log"])
def test_a_file_that_exists_is_not_recorded_to(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content := b"RRF2 of yesterday" if name != "robot.toml" else SIM.read_bytes())
    with pytest.raises(ServiceError, match=rf"{name} already exists; name another file, or remove it"):
        recorder(tmp_path, configured(capture_can=True), path=path.with_suffix(".rrd") if "log" in name else path)
    assert path.read_bytes() == content


def test_a_recording_is_not_written_to_its_own_log_of_frames(tmp_path: Path) -> None:
    with pytest.raises(ServiceError, match=r"name the recording session\.rrd$"):
        recorder(tmp_path, configured(capture_can=True), path=tmp_path / "session.log")
    assert list(tmp_path.iterdir()) == []


def test_a_live_port_in_use_is_refused(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ServiceError, match=rf"127\.0\.0\.1:{port}: .*telemetry\.live_port"):
            recorder(tmp_path, configured(live_port=port), live=True)
    assert list(tmp_path.iterdir()) == []


def test_the_live_view_is_served_on_loopback_beside_the_file(tmp_path: Path) -> None:
    port = free_port()
    recording = recorder(tmp_path, configured(live_port=port), live=True)
    try:
        assert recording.live_url == f"rerun+http://127.0.0.1:{port}/proxy"
        socket.create_connection(("127.0.0.1", port), timeout=WITHIN).close()
        feed(recording, made.records(0.4))
    finally:
        recording.close()
    assert len(read(recording.path)[0]) == 400
    assert (recording.lost, recording.skipped) == (0, 0)


def test_without_a_live_port_there_is_no_live_view(tmp_path: Path) -> None:
    recording = recorder(tmp_path, configured(live_port=0), live=True)
    recording.close()
    assert recording.live_url == ""


def test_a_full_disk_is_counted_and_said_and_recording_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "free")
    recording = recorder(tmp_path)
    sent = made.records(1.0)
    feed(recording, sent[:400])
    with monkeypatch.context() as full:
        full.setattr(shutil, "disk_usage", lambda _: usage(free=0))
        feed(recording, sent[400:600])
    feed(recording, sent[600:])
    recording.close()
    records, _ = read(recording.path)
    assert np.array_equal(records["cycle"], [*range(400), *range(600, 1000)])
    assert recording.lost > 0
    (level, text), *_ = reversed(lines(recording.path))
    assert level == "WARN"
    assert text.startswith(f"missing data: {recording.lost} batches in the file")


def test_a_stuck_disk_is_left_alone_until_it_answers() -> None:
    stream = _Stream()
    archive = Archive(stream, Path("/tmp/x.rrd"))  # type: ignore[arg-type]
    archive.write_chunks([])
    assert archive.lost == 0
    stream.stuck = True
    archive.write_chunks([])
    archive.write_chunks([])
    assert archive.lost == 2
    assert stream.sent == 2  # Rerun's sink would block for ever if it were sent more
    archive.close()
    assert not stream.closed
    stream.stuck = False
    archive.write_chunks([])
    assert archive.lost == 2
    archive.close()
    assert stream.closed


def test_a_batch_that_a_slow_disk_writes_late_is_not_written_twice() -> None:
    stream = _Stream()
    archive = Archive(stream, Path("/tmp/x.rrd"))  # type: ignore[arg-type]
    first, second, third = (SimpleNamespace(id=name) for name in "abc")
    stream.stuck = True
    archive.write_chunks([first])  # type: ignore[list-item]
    stream.stuck = False
    archive.write_chunks([second])  # type: ignore[list-item]
    archive.write_chunks([first, third])  # type: ignore[list-item]
    assert stream.chunks == [first, second, third]


def test_many_inputs_on_a_full_disk_displace_no_event(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "free")
    recording, sent = recorder(tmp_path), made.records(1.0)
    with monkeypatch.context() as full:
        full.setattr(shutil, "disk_usage", lambda _: usage(free=0))
        recording.event(Event("fault", "error", "drive B", seq=1, t=0.1, cycle=100, time=1.8e9))
        recording.save()
        for seq in range(MAX_UNWRITTEN + 1):
            recording.control_input(ControlInput(seq, 10, made.MONOTONIC_NS, PlannerLost("late")))
            recording.save()
    feed(recording, sent)
    recording.close()
    assert ("ERROR", "drive B") in lines(recording.path)


@pytest.mark.parametrize("fails", ["before", "at that moment", "at the end"])
def test_a_stream_whose_disk_fails_when_its_file_ends_is_not_destroyed(fails: str, tmp_path: Path) -> None:
    """Rerun would wait for the disk, and the recorder with it."""
    streams: list[_Stream] = []
    (tmp_path / "a.rrd").touch()
    files = RotatedFiles(tmp_path / "a.rrd", lambda _: _begun(streams), lambda _: None, 0, lambda: 0.0)  # type: ignore[arg-type,return-value]
    stream = streams.pop()
    first = weakref.ref(stream)
    if fails == "before":
        stream.stuck = True
        files.write_chunks([])
    stream.stuck = True
    del stream
    if fails == "at the end":
        files.close()
        del files
    else:
        assert files.turn()
    gc.collect()
    alive = first()
    assert alive is not None
    assert not alive.closed


def _begun(streams: list[_Stream]) -> _Stream:
    streams.append(_Stream())
    return streams[-1]


class _Stream:
    """A recording stream whose disk can be stuck."""

    def __init__(self) -> None:
        self.sent = 0
        self.chunks: list[Chunk] = []
        self.stuck = False
        self.closed = False

    def send_chunks(self, chunks: list[Chunk]) -> None:
        self.sent += 1
        self.chunks += chunks

    def flush(self, *, timeout_sec: float) -> None:
        if self.stuck:
            raise RuntimeError("flush timed out")

    def disconnect(self) -> None:
        self.closed = True


def test_a_slow_viewer_is_skipped_to_the_newest() -> None:
    """It gets all lines of the log and changes of the goal: a fault or the end of a goal would never be shown."""
    began, go_on, finished = threading.Event(), threading.Event(), threading.Event()
    delivered: list[Any] = []

    def deliver(batch: Any) -> None:
        began.set()
        assert go_on.wait(WITHIN)
        delivered.append(batch)

    relay = Relay(deliver, finished.set)
    batches: list[Any] = [[SimpleNamespace(entity_path="/left/mode")] for _ in range(2 * BACKLOG + 5)]
    lasting = [SimpleNamespace(entity_path=f"/left{path}") for path in ("/robot/goal", "/events", "/events")]
    for place, chunk in zip((3, 7, BACKLOG + 9), lasting, strict=True):
        batches[place].append(chunk)
    relay.write_chunks(batches[0])
    assert began.wait(WITHIN)
    for batch in batches[1:]:
        relay.write_chunks(batch)
    go_on.set()
    relay.close()
    assert finished.is_set()
    assert relay.skipped == 2 * BACKLOG
    first, *others = batches[2 * BACKLOG + 1 :]
    assert delivered == [batches[0], [*lasting, *first], *others]


class Kept:
    """A sink that keeps the batches of drawings it is given."""

    def __init__(self) -> None:
        self.drawn: list[list[Chunk]] = []

    def write_chunks(self, chunks: list[Chunk]) -> None:
        if any(chunk.entity_path == PLATFORM for chunk in chunks):
            self.drawn.append(chunks)

    def cycles(self) -> list[int]:
        platform = [chunk for chunks in self.drawn for chunk in chunks if chunk.entity_path == PLATFORM]
        return [int(t) // 1_000_000 for chunk in platform for t in chunk.to_record_batch().column("t").cast("int64")]


PLATFORM = "/robot/platform"


def test_sinks_of_one_pace_share_their_drawings_and_a_change_of_pace_loses_none() -> None:
    streams = Streams(DrawnRobot.from_config(configured()), "shown", 0)
    file, live = Kept(), Kept()
    streams.attach(file, 1)
    records = made.records(6.0)

    def pass_by(begin: int, end: int) -> tuple[list[list[Chunk]], list[list[Chunk]]]:
        file.drawn, live.drawn = [], []
        for start in range(begin, end, 20):
            streams.records(records[start : start + 20].tobytes())
        return file.drawn, live.drawn

    everything: list[int] = []
    for begin, end, pace in ((0, 1500, 1), (1500, 3300, 5), (3300, 6000, 1)):
        streams.attach(live, pace)
        everything += live.cycles() if begin else []  # what the change of pace has flushed
        to_file, to_live = pass_by(begin, end)
        if pace == 1:
            assert len(to_file) in (1, 2)
            assert [id(chunks) for chunks in to_live] == [id(chunks) for chunks in to_file]
        else:
            assert (len(to_file), len(to_live)) == (1, 9)
        everything += live.cycles()
        live.drawn = []
    streams.flush()
    everything += live.cycles()
    assert everything == sorted(set(everything))
    assert set(everything) >= set(range(9, 6000, 10))


def test_a_live_view_is_drawn_for_only_while_somebody_watches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    recording = recorder(tmp_path, configured(live_port=port), live=True)
    drawn: list[int] = []
    draw = recording._streams.scene.drawn

    def counted(records: NDArray[np.void], *others: Any) -> list[Chunk]:
        drawn.append(len(records))
        return draw(records, *others)

    monkeypatch.setattr(recording._streams.scene, "drawn", counted)
    records = made.records(10.0)
    feed(recording, records[:5000])
    assert sum(drawn) <= 5000
    drawn.clear()
    with socket.create_connection(("127.0.0.1", port)):
        wait_until(lambda: is_watched(port))
        feed(recording, records[5000:])
    assert sum(drawn) > 7000
    recording.close()


def test_captured_frames_are_a_log_that_python_can_reads(tmp_path: Path) -> None:
    recording = recorder(tmp_path, configured(capture_can=True))
    foreign = can.Message(arbitration_id=0x1ABCDEF0, data=b"\x07", is_extended_id=True)
    # Of error frames python-can reads those of the class "bus error", 80h.
    passive = can.Message(arbitration_id=0x284, data=b"\0\x30" + bytes(6), is_extended_id=False, is_error_frame=True)
    seen = [
        Frame(0x201, bytes([1, 2, 3, 4, 5, 255])).packed,
        Frame(0x080).packed,
        Frame(0x029, remote=True).packed,
        packed(foreign),
        packed(passive),
    ]
    for number, frame in enumerate(seen):
        recording.frames(CAPTURED.pack(1_795_245_300.25 + number, frame))
    feed(recording, made.records(0.01))
    recording.close()
    with can.CanutilsLogReader(recording.path.with_suffix(".log")) as log:
        first, second, third, fourth, fifth = log
    assert (first.arbitration_id, bytes(first.data)) == (0x201, bytes([1, 2, 3, 4, 5, 255]))
    assert first.timestamp == pytest.approx(1_795_245_300.25)
    assert first.channel == "simulated"
    assert (second.arbitration_id, second.dlc) == (0x080, 0)
    assert (third.arbitration_id, third.is_remote_frame, second.is_remote_frame) == (0x029, True, False)
    assert (fourth.arbitration_id, fourth.is_extended_id, bytes(fourth.data)) == (0x1ABCDEF0, True, b"\x07")
    assert (fifth.is_error_frame, first.is_error_frame) == (True, False)


def test_the_log_of_frames_leaves_the_reserve_free_says_so_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "free")
    told: list[str] = []
    recording = recorder(tmp_path, configured(capture_can=True), warn=lambda text: told.append(text.text))

    def frame(number: int) -> None:
        recording.frames(CAPTURED.pack(number, Frame(0x200 + number).packed))

    frame(1)
    with monkeypatch.context() as full:
        full.setattr(shutil, "disk_usage", lambda _: usage(free=RESERVE))
        frame(2)
        frame(3)
        assert recording.unrecorded[0] == "no CAN frames are captured"
        assert f"{tmp_path} is full" in recording.unrecorded[1]
        recording.records(made.records(0.1).tobytes())
    frame(4)
    assert recording.unrecorded == ("", "")
    recording.close()
    with can.CanutilsLogReader(recording.path.with_suffix(".log")) as log:
        assert [message.arbitration_id for message in log] == [0x201, 0x204]
    assert len(told) == 1
    assert told[0].startswith(f"no CAN frames are captured: {tmp_path} is full")


def test_a_batch_of_frames_that_the_disk_takes_in_part_leaves_no_part(tmp_path: Path) -> None:
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    log = CandumpLog(tmp_path / "x.log", "can0")
    batch = CAPTURED.pack(1.0, Frame(0x201, bytes(8)).packed)
    log.write(batch)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (50, limit[1]))
        log.write(batch)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert (log.lost, log.trouble) == (1, f"{tmp_path / 'x.log'} cannot be written: No space left on device")
    log.write(batch)
    log.close()
    assert (log.lost, log.trouble) == (1, "")
    assert (tmp_path / "x.log").read_text() == "(1.000000) can0 201#0000000000000000\n" * 2


def test_frames_are_not_kept_unless_asked_for(tmp_path: Path) -> None:
    recording = recorder(tmp_path)
    recording.frames(CAPTURED.pack(1.0, Frame(0x201).packed))
    feed(recording, made.records(0.01))
    recording.close()
    assert [path.suffix for path in tmp_path.iterdir()] == [".rrd"]


# ---------------------------------------------------------------------- the wall clock


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(st.integers(-(10**13), 10**13), st.booleans()), max_size=8))
def test_all_data_has_the_wall_clock_time_of_its_cycle_when_the_clock_is_set(steps: list[tuple[int, bool]]) -> None:
    """The inputs and the drawings too; readings of the clocks that took long do not count."""
    sent, offset, offsets = made.records(0.5), WALL_NS - made.MONOTONIC_NS, list[int]()
    now, interrupted = made.MONOTONIC_NS, False

    def monotonic() -> int:
        nonlocal now
        now += 20_000_000 if interrupted else 0
        return now

    with tempfile.TemporaryDirectory() as folder:
        to = recorder(Path(folder), sidecars=True, wall_ns=lambda: now + offset, monotonic_ns=monotonic)
        for number, start in enumerate(range(0, len(sent), 50)):
            batch = sent[start : start + 50]
            step, interrupted = steps[number] if number < len(steps) else (0, False)
            now = int(batch["deadline_ns"][-1])
            if not interrupted:
                offset += step if abs(step) > 5_000_000 else 0
            to.records(batch.tobytes())
            item = ControlInput(number, start, int(batch["deadline_ns"][0]), PlannerLost("no planner"))
            to.control_input(item)
            offsets += [offset] * len(batch)
        interrupted = False
        to.close()
        times = sent["deadline_ns"] + np.array(offsets)
        found = [chunk for chunk in RrdReader(to.path).stream() if not chunk.is_static]
        assert {"/record", "/requests", "/mode", "/robot/platform"} <= {chunk.entity_path for chunk in found}
        for batch in (chunk.to_record_batch() for chunk in found):
            cycles = batch.column("t").to_numpy().astype(np.int64) // 1_000_000
            walls = batch.column("wall").to_numpy().astype(np.int64)
            assert np.abs(walls - times[cycles]).max() < 1000  # the inputs' times are floats
        entry = contents.load(to.path)
    assert entry is not None
    assert (entry.began, entry.ended) == pytest.approx((times[0] * 1e-9, times[-1] * 1e-9), abs=1e-5)
