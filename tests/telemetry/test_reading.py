"""Recordings read into numpy: what the recorder wrote, bit for bit; of a file that was cut off, all that is whole."""

from __future__ import annotations

import errno
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import made
import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from trirail.config import SIM, load
from trirail.errors import EmptyRecordingError, ServiceError
from trirail.telemetry import journal, reading
from trirail.telemetry.columns import FIELDS, RECORD, Column, Timelines, chunks, structs
from trirail.telemetry.contents import read_contents
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.reading import OlderRecordingWarning, SkippedFileWarning, read, read_session
from trirail.telemetry.recorder import Recorder
from trirail.telemetry.scene import Scene
from trirail.wire.messages import Event, FaultDetail
from trirail.wire.records import DTYPE
from trirail_drivers.interface import PowerState

WALL_NS = 1_795_245_300_000_000_000
BATCH = 50


def written(path: Path, sent: NDArray[np.void], events: tuple[Event, ...] = (), close: bool = True) -> Recorder:
    """Record, with all of it in the file; left open as by a process that is killed unless `close`."""
    recorder = Recorder(
        load(SIM), path.parent, path=path, live=False, wall_ns=lambda: WALL_NS, monotonic_ns=lambda: made.MONOTONIC_NS
    )
    for start in range(0, len(sent), BATCH):
        recorder.records(sent[start : start + BATCH].tobytes())
    for event in events:
        recorder.event(event)
    if close:
        recorder.close()
    return recorder


def test_records_are_equal_bit_for_bit(tmp_path: Path) -> None:
    sent = made.records(1.234)
    sent["commanded_velocity"][7] = np.nan, -0.0, np.inf
    sent["drive_state"][9] = 1, 2, len(PowerState) - 1
    sent["overruns"][11] = 2**62 + 1
    written(tmp_path / "a.rrd", sent)
    recording = read(tmp_path / "a.rrd")
    assert recording.records.dtype == DTYPE
    assert made.bits(recording.records) == made.bits(sent)


def test_nobody_who_reads_waits_for_pandas(tmp_path: Path) -> None:
    written(tmp_path / "a.rrd", made.records(0.1))
    code = "import pathlib, sys, trirail; trirail.read(pathlib.Path(sys.argv[1])); print('pandas' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.rrd"], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_times_are_nominal_and_of_the_wall_clock(tmp_path: Path) -> None:
    written(tmp_path / "a.rrd", made.records(0.5))
    recording = read(tmp_path / "a.rrd")
    assert recording.t.tolist() == [cycle / 1000 for cycle in range(500)]
    since = recording.wall - np.datetime64(WALL_NS, "ns")
    assert np.array_equal(since, np.arange(500) * np.timedelta64(1_000_000, "ns"))


def test_events_are_in_order_with_their_times(tmp_path: Path) -> None:
    moving = Event(
        "mode", "info", "moving: goal g-1 of ann", mode="moving", seq=2, t=0.6, cycle=600, time=WALL_NS * 1e-9
    )
    fault = Event("fault", "error", "drive B: silent", seq=3, t=0.75, cycle=750, time=WALL_NS * 1e-9)
    written(tmp_path / "a.rrd", made.records(0.1), (fault, moving))
    events = read(tmp_path / "a.rrd").events
    assert [(line.t, line.level, line.text) for line in events] == [
        (0.6, "INFO", moving.message),
        (0.75, "ERROR", fault.message),
    ]
    assert abs(events[0].wall - np.datetime64(WALL_NS, "ns")) < np.timedelta64(1, "us")


def test_the_name_is_the_sessions(tmp_path: Path) -> None:
    written(tmp_path / "other.rrd", made.records(0.1))
    recording = read(tmp_path / "other.rrd")
    assert re.fullmatch(r"demo-2026112\d-\d{6}", recording.name)


def test_a_gap_stays_a_gap_and_batches_are_put_in_order(tmp_path: Path) -> None:
    sent = made.records(0.6)
    later_first = np.concatenate([sent[400:], sent[:200]])
    written(tmp_path / "a.rrd", later_first)
    recording = read(tmp_path / "a.rrd")
    assert recording.records["cycle"].tolist() == [*range(200), *range(400, 600)]
    assert np.array_equal(recording.t, recording.records["cycle"] / 1000)


def test_texts_that_hold_for_the_whole_session_come_by_entity(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    stream = rr.RecordingStream("trirail")
    stream.save(path)
    stream.log("config", rr.TextDocument("[robot]\nname = 'x'"), static=True)
    stream.log("passing", rr.TextDocument("not for the whole session"))
    stream.send_chunks(Scene(DrawnRobot.from_config(load(SIM)), 0).complete(made.records(0.1)))
    stream.disconnect()
    recording = read(path)
    assert recording.texts == {"/config": "[robot]\nname = 'x'"}
    assert len(recording.records) == 100


# ---------------------------------------------------------------------- files that were cut off


def test_a_file_that_was_never_closed_holds_all_that_was_written(tmp_path: Path) -> None:
    sent = made.records(0.8)
    recorder = written(tmp_path / "a.rrd", sent, close=False)
    try:
        assert made.bits(read(tmp_path / "a.rrd").records) == made.bits(sent)
    finally:
        recorder.close()


@pytest.mark.long
def test_a_killed_recorder_leaves_what_it_has_written(tmp_path: Path) -> None:
    script = (
        "import os, signal, sys; from pathlib import Path; import made; from telemetry.test_reading import written\n"
        "kept = written(Path(sys.argv[1]), made.records(0.8), close=False)\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    path, tests = tmp_path / "a.rrd", Path(__file__).parents[1]
    assert subprocess.run([sys.executable, "-c", script, path], cwd=tests, check=False).returncode == -9
    assert made.bits(read(path).records) == made.bits(made.records(0.8))


@pytest.mark.parametrize("share", [0.3, 0.5, 0.77, 0.9, 1.0 - 1e-6])
@pytest.mark.long
def test_wherever_a_file_is_cut_the_records_before_are_read(tmp_path: Path, share: float) -> None:
    sent = made.records(2.0)
    written(tmp_path / "whole.rrd", sent)
    content = (tmp_path / "whole.rrd").read_bytes()
    (tmp_path / "cut.rrd").write_bytes(content[: round(share * len(content))])
    records = read(tmp_path / "cut.rrd").records
    assert made.bits(records) == made.bits(sent[: len(records)])
    assert abs(len(records) / len(sent) - share) < 0.2
    assert (tmp_path / "cut.rrd").stat().st_size == round(share * len(content))


@pytest.mark.parametrize("close", [True, False])
def test_a_file_that_ends_with_a_whole_message_is_read_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, close: bool
) -> None:
    """A recording may be larger than the room for temporary files."""
    recorder = written(tmp_path / "a.rrd", made.records(0.2), close=close)
    monkeypatch.setattr(shutil, "copyfile", None)
    assert len(read(tmp_path / "a.rrd").records) == 200
    if not close:
        recorder.close()


@pytest.mark.long
def test_every_length_of_the_last_message_is_survived(tmp_path: Path) -> None:
    recorder = written(tmp_path / "a.rrd", made.records(0.2), close=False)
    before = (tmp_path / "a.rrd").read_bytes()
    recorder.event(Event("mode", "info", "the last line", mode="holding", seq=1, t=0.2, cycle=200, time=WALL_NS * 1e-9))
    recorder.save()
    after = (tmp_path / "a.rrd").read_bytes()
    recorder.close()
    for length in {len(before), len(before) + 1, len(before) + 15, len(before) + 16, len(after) - 1, len(after)}:
        (tmp_path / "cut.rrd").write_bytes(after[:length])
        recording = read(tmp_path / "cut.rrd")
        assert len(recording.records) == 200
        assert [line.text for line in recording.events] == ["the last line"] * (length == len(after))


@settings(max_examples=40)
@given(data=st.data(), cut=st.integers(0, 3 << 20), unaligned=st.booleans())
@pytest.mark.long
def test_an_end_of_nul_bytes_leaves_the_records_before_it(
    file_left_open: bytes, data: st.DataObject, cut: int, unaligned: bool
) -> None:
    """After a power cut, a file may have its new size but only NUL bytes from some point on."""
    start = data.draw(st.integers(len(file_left_open) // 2, len(file_left_open)))
    start -= 0 if unaligned else start % 512
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.rrd")
        path.write_bytes(file_left_open[:start] + bytes(len(file_left_open) - start + cut))
        records = read(path).records
    sent = made.records(2.0)
    assert made.bits(records) == made.bits(sent[: len(records)])
    assert len(records) / len(sent) > start / len(file_left_open) - 0.2


@pytest.fixture(scope="module")
def file_left_open(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Content of a recording whose recorder did not close it."""
    path = tmp_path_factory.mktemp("open") / "a.rrd"
    recorder = written(path, made.records(2.0), close=False)
    recorder.save()
    content = path.read_bytes()
    recorder.close()
    return content


# ---------------------------------------------------------------------- what is refused


def test_what_is_no_recording_is_refused_with_its_path(tmp_path: Path) -> None:
    text, empty, nul, cut, header = (tmp_path / f"{name}.rrd" for name in ("text", "empty", "nul", "cut", "header"))
    header.write_bytes(b"RRF2\0\x20\0\0\1\0\0")
    text.write_text("t,x,y\n")
    empty.write_bytes(b"")
    nul.write_bytes(bytes(1000))
    written(tmp_path / "whole.rrd", made.records(0.1))
    cut.write_bytes((tmp_path / "whole.rrd").read_bytes()[:1000])
    for path, why in {
        tmp_path / "absent.rrd": "No such file or directory",
        tmp_path: "a folder; expected a regular file",
        text: "not a recording: an RRD file begins with RRF2",
        empty: "cut off in its header: the recording is empty",
        nul: "cut off in its header: the recording is empty",
        cut: "contains no",
        header: "cut off in its header",
    }.items():
        with pytest.raises(ServiceError, match=f"^{re.escape(str(path))}: {why}") as raised:
            read(path)
        assert "\n" not in str(raised.value)


@given(st.integers(0, 40), st.binary(max_size=12), st.integers(0, 40))
def test_an_error_names_the_file_and_not_a_copy(file_left_open: bytes, cut: int, other: bytes, at: int) -> None:
    """Of a file that was cut off, Rerun reads a copy."""
    content = bytearray(file_left_open[:cut])
    content[at : at + len(other)] = other
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.rrd")
        path.write_bytes(content)
        with pytest.raises(ServiceError) as raised:
            read(path)
        assert str(raised.value).startswith(str(path))
        assert set(re.findall(r"\S*a\.rrd", str(raised.value))) == {str(path)}


ABORTING = """
import os, random, sys
from rerun.chunk import RrdReader
whole, chance = open(sys.argv[1], "rb").read(), random.Random(1)
for _ in range(1000):
    damaged = bytearray(whole)
    damaged[chance.randrange(len(whole))] ^= 1 << chance.randrange(8)
    open(sys.argv[2], "wb").write(damaged)
    if not (child := os.fork()):
        try:
            [None for _ in RrdReader(sys.argv[2]).stream()]
        finally:
            os._exit(0)
    if os.WIFSIGNALED(os.waitpid(child, 0)[1]):
        break
else:
    sys.exit("Rerun aborts at no damage any more: remove the decoding in another process")
"""


def test_damage_at_which_rerun_aborts_is_told_and_other_files_are_read(tmp_path: Path) -> None:
    """Rerun aborts at one in sixty flipped bits."""
    whole, damaged = tmp_path / "a.rrd", tmp_path / "a-part2.rrd"
    written(whole, made.records(0.1))
    command = [sys.executable, "-c", ABORTING, str(whole), str(damaged)]
    found = subprocess.run(command, check=False, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr[-500:]
    with pytest.raises(ServiceError, match=f"^{damaged}: damaged: Rerun's decoder ended with SIGABRT$"):
        read(damaged)
    with pytest.warns(SkippedFileWarning, match="SIGABRT"):
        assert made.bits(read_session([damaged, whole]).records) == made.bits(read(whole).records)


def test_a_file_that_the_operating_system_refuses_is_refused_with_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / ("n" * 300)
    with pytest.raises(ServiceError, match=f"{path}: File name too long"):
        read(path)

    def refuse(path: Path, **_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "stat", refuse)
    with pytest.raises(ServiceError, match="Permission denied"):
        read(tmp_path / "a.rrd")


def test_a_recording_without_records_is_told_as_what_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "unlink", lambda *_, **__: None)  # a recorder that is killed deletes nothing
    written(tmp_path / "a.rrd", made.records(0.1)[:0])
    with pytest.raises(
        EmptyRecordingError, match=r"a\.rrd: the recording is empty, because the service or its recorder ended"
    ):
        read(tmp_path / "a.rrd")


def test_events_in_a_file_without_records_belong_to_their_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a part that a recorder has begun just before it was killed: the loop does not send its events again."""
    monkeypatch.setattr(Path, "unlink", lambda *_, **__: None)  # a recorder that is killed deletes nothing
    sent, wall = made.records(0.1), WALL_NS * 1e-9
    events = [
        Event("fault", "error", "drive B: silent", seq=seq, t=0.1, cycle=100, time=wall, fault=FaultDetail("emcy"))
        for seq in (1, 2)
    ]
    written(tmp_path / "a.rrd", sent, (events[0],))
    written(tmp_path / "b.rrd", sent[:0], (events[1],))
    for paths in ([tmp_path / "a.rrd", tmp_path / "b.rrd"], [tmp_path / "b.rrd", tmp_path / "a.rrd"]):
        session = read_session(paths)
        assert made.bits(session.records) == made.bits(sent)
        assert sorted(line.event.seq for line in session.events if line.event) == [1, 2]
    assert [entry.message for entry in read_contents(tmp_path / "b.rrd").faults] == ["drive B: silent"]
    with pytest.raises(EmptyRecordingError):
        read_session([tmp_path / "b.rrd"])


def test_a_recording_of_others_is_refused(tmp_path: Path) -> None:
    with rr.RecordingStream("another") as stream:
        stream.save(tmp_path / "a.rrd")
        stream.log("here", rr.Scalars(1.0))
    with pytest.raises(ServiceError, match=r"a\.rrd: contains no records of cycles"):
        read(tmp_path / "a.rrd")


@pytest.mark.parametrize(
    ("layout", "differs"),
    [
        ([*((name, DTYPE[name]) for name in DTYPE.names or ()), ("stance", "<f8")], "stance"),
        ([(name, "<f8" if name == "mode" else DTYPE[name]) for name in DTYPE.names or ()], "mode"),
        ([(name, ("<f8", (6,)) if name == "velocity" else DTYPE[name]) for name in DTYPE.names or ()], "velocity"),
    ],
)
def test_records_of_another_version_are_refused_by_field(tmp_path: Path, layout: Any, differs: str) -> None:
    path, other = tmp_path / "a.rrd", np.zeros(10, layout)
    stream = rr.RecordingStream("trirail")
    stream.save(path)
    stream.send_chunks(chunks(Timelines(1000, 0).for_records(other), [Column(RECORD, FIELDS, structs(other))]))
    stream.disconnect()
    with pytest.raises(ServiceError, match=rf"a\.rrd: written by another version: its records differ in {differs}$"):
        read(path)


@pytest.mark.parametrize("row", [0, 5, 9])
@pytest.mark.parametrize(("field", "value"), [("cycle", 1 << 40), ("cycle", -1), ("mode", 255), ("drive_state", 64)])
def test_records_with_flipped_bits_are_refused_as_damaged(tmp_path: Path, field: str, value: int, row: int) -> None:
    path, sent = tmp_path / "a.rrd", made.records(0.01)
    timeline = Timelines(1000, 0).for_records(sent)
    sent[field][row] = value
    stream = rr.RecordingStream("trirail")
    stream.save(path)
    stream.send_chunks(chunks(timeline, [Column(RECORD, FIELDS, structs(sent))]))
    stream.disconnect()
    with pytest.raises(ServiceError, match=r"a\.rrd: damaged: its records have unknown states, or cycle numbers that"):
        read(path)


@given(lacking=st.sets(st.sampled_from(DTYPE.names or ()), min_size=1))
@settings(max_examples=15)
def test_fields_that_an_older_version_did_not_write_read_as_nothing(lacking: set[str]) -> None:
    sent = made.records(0.05)
    there = [name for name in DTYPE.names or () if name not in lacking]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.rrd"
        stream = rr.RecordingStream("trirail")
        stream.save(path)
        columns = [Column(RECORD, FIELDS, structs(sent[there]))] if there else []
        stream.send_chunks(chunks(Timelines(1000, 0).for_records(sent), columns))
        stream.disconnect()
        if "cycle" in lacking:
            with pytest.raises(ServiceError):
                read(path)
            return
        with pytest.warns(OlderRecordingWarning, match="older version") as said:
            records = read(path).records
    assert len(said) == 1
    assert all(name in str(said[0].message) for name in lacking)
    for name in there:
        np.testing.assert_array_equal(records[name], sent[name])
    for name in lacking:
        floats = np.issubdtype(DTYPE[name].base, np.floating)
        assert (np.isnan(records[name]) if floats else records[name] == 0).all()


@pytest.mark.parametrize("log", ["events", "requests"])
def test_events_and_requests_of_another_version_are_refused(tmp_path: Path, log: str) -> None:
    path, sent = tmp_path / "a.rrd", made.records(0.1)
    stream = rr.RecordingStream("trirail")
    stream.save(path)
    columns = [Column(RECORD, FIELDS, structs(sent))]
    stream.send_chunks(chunks(Timelines(1000, 0).for_records(sent), columns))
    said = [Column(f"/{log}", kind, pa.array([["?"]])) for kind in (journal.TEXT, journal.LEVEL, journal.WORDS)]
    said.append(Column(f"/{log}", journal.JSON, pa.array([['{"seq": 1, "omen": "dark"}']])))
    stream.send_chunks(chunks(Timelines(1000, 0).for_records(sent[:1]), said))
    stream.disconnect()
    with pytest.raises(ServiceError, match=rf"a\.rrd: written by another version: its {log} cannot be read: "):
        read(path)


@pytest.mark.parametrize(
    ("log", "lacks"), [("events", journal.WORDS), ("events", journal.LEVEL), ("requests", journal.JSON)]
)
def test_events_and_requests_that_lack_a_column_are_refused_by_its_name(tmp_path: Path, log: str, lacks: Any) -> None:
    path, sent = tmp_path / "a.rrd", made.records(0.1)
    stream = rr.RecordingStream("trirail")
    stream.save(path)
    stream.send_chunks(chunks(Timelines(1000, 0).for_records(sent), [Column(RECORD, FIELDS, structs(sent))]))
    kinds = [kind for kind in (journal.TEXT, journal.LEVEL, journal.WORDS, journal.JSON) if kind is not lacks]
    said = [Column(f"/{log}", kind, pa.array([["?"]])) for kind in kinds]
    stream.send_chunks(chunks(Timelines(1000, 0).for_records(sent[:1]), said))
    stream.disconnect()
    with pytest.raises(
        ServiceError, match=rf"a\.rrd: written by another version: its {log} have no {lacks.component}$"
    ):
        read(path)


def test_a_file_that_grows_while_it_is_read_is_read_up_to_a_whole_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = written(tmp_path / "a.rrd", made.records(0.2), close=False)
    reader = RrdReader

    def slow_reader(path: Path) -> object:
        if path == tmp_path / "a.rrd":
            with path.open("ab") as file:  # the beginning of the next message
                file.write((tmp_path / "a.rrd").read_bytes()[-40:-20])
        return reader(path)

    monkeypatch.setattr(reading, "RrdReader", slow_reader)
    assert len(read(tmp_path / "a.rrd").records) == 200
    recorder.close()


def test_a_recording_is_read_by_its_name_and_printed_in_one_line(tmp_path: Path) -> None:
    written(tmp_path / "a.rrd", made.records(0.5))
    recording = read(str(tmp_path / "a.rrd"))
    assert made.bits(recording.records) == made.bits(read(tmp_path / "a.rrd").records)
    assert repr(recording) == str(recording)
    assert "\n" not in repr(recording)
    assert len(repr(recording)) < 200
    assert f"{len(recording.records)} cycles" in repr(recording)
    assert repr(recording._replace(records=recording.records[:0], t=recording.t[:0], name="")).startswith(
        "<Recording unnamed"
    )
