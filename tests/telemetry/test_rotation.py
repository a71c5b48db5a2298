"""Recordings over time: rotated, tidied, cut off by failing disks and kills, and kept apart on a fault."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections import namedtuple
from datetime import date, datetime
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import made
import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from telemetry.test_recorder import configured
from trirail.cli.app import app
from trirail.config import SIM, Config, load, parse
from trirail.errors import ServiceError
from trirail.processes import loop
from trirail.processes.recording import GATHER
from trirail.processes.reports import BATCHES_PER_SECOND
from trirail.telemetry import blackbox, contents, provenance, retention
from trirail.telemetry.blackbox import AFTER_S, BEFORE_S, BlackBox
from trirail.telemetry.provenance import SOFTWARE
from trirail.telemetry.reading import join, read
from trirail.telemetry.readout import ReadoutState
from trirail.telemetry.recorder import Recorder
from trirail.telemetry.recording import Recording
from trirail.telemetry.rotation import RETRY, claim
from trirail.telemetry.sessions import find, recorded
from trirail.wire.goals import PoseGoal
from trirail.wire.messages import Event
from trirail.wire.packets import ControlInput, GoalRequest
from trirail.wire.vocabulary import Mode
from trirail_drivers import interface
from trirail_drivers.bus.can_frame import CAPTURED
from trirail_drivers.bus.frames import Frame

WALL_NS = 1_795_245_300_000_000_000
BATCH = 20
Usage = namedtuple("Usage", "free")


class Time:
    """Clocks that go with the records."""

    def __init__(self) -> None:
        self.ns = made.MONOTONIC_NS

    def monotonic(self) -> int:
        return self.ns

    def wall(self) -> int:
        return WALL_NS + self.ns - made.MONOTONIC_NS


def recorder(directory: Path, time: Time, config: Config, **more: Any) -> Recorder:
    return Recorder(config, directory, live=False, wall_ns=time.wall, monotonic_ns=time.monotonic, **more)


def feed(to: Recorder | BlackBox, records: NDArray[np.void], time: Time) -> None:
    for start in range(0, len(records), BATCH):
        batch = records[start : start + BATCH]
        time.ns = int(batch["deadline_ns"][-1])
        to.records(batch.tobytes())


def goal(cycle: int) -> ControlInput:
    request = GoalRequest(7, "ann", "g-1", PoseGoal(0.01, 0.0, 0.1), made.MONOTONIC_NS)
    return ControlInput(1, cycle, made.MONOTONIC_NS + cycle * 1_000_000, request)


def parts(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.rrd"), key=lambda path: (len(path.name), path.name))


# ---------------------------------------------------------------------- files that are taken away


def _taken_away(path: Path, how: str) -> None:
    match how:
        case "unlinked":
            path.unlink()
        case "renamed":
            path.rename(path.with_suffix(".mine"))
        case "replaced":
            path.unlink()
            path.write_bytes(b"somebody's own")
        case "folder":
            shutil.rmtree(path.parent)


@settings(max_examples=15)
@given(hows=st.lists(st.sampled_from(["", "unlinked", "renamed", "replaced", "folder"]), min_size=1, max_size=5))
def test_a_recording_whose_file_is_taken_away_goes_on_in_another_and_says_so(hows: list[str]) -> None:
    with tempfile.TemporaryDirectory() as parent:
        folder, time = Path(parent) / "rec", Time()
        told: list[str] = []
        config = configured(capture_can=True)
        recording = recorder(folder, time, config, warn=lambda text: told.append(text.text), sidecars=True)
        sent = made.records(0.5 * len(hows))
        for number, how in enumerate(hows):
            time.ns += round(RETRY * 1e9)
            before, told[:] = recording.path, []
            _taken_away(before, how)
            recording.frames(CAPTURED.pack(1.0, Frame(0x201).packed))
            for start in range(500 * number, 500 * (number + 1), BATCH):
                recording.records(sent[start : start + BATCH].tobytes())
            recording.save()
            assert recording.lost == 0
            assert (recording.path == before) is (how == "")
            assert [words.partition(" was deleted or moved")[0] for words in told] == [
                *([str(before.with_suffix(".log"))] if how == "folder" else []),
                *([str(before)] if how else []),
            ]
        recording.close()
        last = max((number for number, how in enumerate(hows) if how), default=0)
        rows = read(recording.path).records["cycle"]
        assert set(range(500 * last + BATCH, len(sent))) <= set(rows.tolist())
        assert recording.path.name in [name for found in find(recorded(folder)) for name in found.files]
        assert all((folder / name).exists() for found in find(recorded(folder)) for name in found.files)


def test_a_folder_that_cannot_be_made_again_is_said_and_tried_again(tmp_path: Path) -> None:
    folder, time = tmp_path / "rec", Time()
    told: list[str] = []
    recording = recorder(folder, time, configured(), warn=lambda text: told.append(text.text))
    sent = made.records(60.0)
    feed(recording, sent[:1000], time)
    shutil.rmtree(folder)
    folder.write_text("in the way")
    feed(recording, sent[1000:30_000], time)
    assert recording.unrecorded[0] == "nothing is recorded"
    assert [words for words in told if "nothing is recorded" in words] == told
    assert len(told) == 1
    folder.unlink()
    feed(recording, sent[30_000:], time)
    assert recording.unrecorded == ("", "")
    recording.close()
    assert f"the recording continues in {recording.path}" in told[1]
    assert told[2].startswith(f"recording resumed; missing data: {recording.lost} batches")
    assert len(told) == 3
    assert read(recording.path).records["cycle"][-1] == len(sent) - 1


# ---------------------------------------------------------------------- what a file says of itself


@pytest.mark.parametrize("path", sorted((SIM.parent).glob("*.toml")), ids=lambda path: path.name)
def test_a_configuration_is_written_as_what_can_be_read(path: Path) -> None:
    config = load(path)
    assert parse(provenance.toml(config)) == config


def test_a_configuration_with_measured_legs_is_too() -> None:
    text = SIM.read_text()
    legs = ["anchor = [0.1, 0.2]\nrail_angle = 0.1\nhome = -0.3\nedge_point = [1e-3, 0.1]\nedge_angle = 2.5\n"] * 3
    turned = [leg.replace("0.1\nhome", f"{0.1 + 2.0 * number}\nhome") for number, leg in enumerate(legs)]
    text = text.replace("l0 = 0.3", "\n".join(f"[[geometry.leg]]\n{leg}" for leg in turned))
    config = msgspec.toml.decode(text, type=Config)  # no robot could be built like this: only the form is at stake
    assert msgspec.toml.decode(provenance.toml(config), type=Config) == config


def test_the_fingerprint_is_that_of_the_source_of_both_packages() -> None:
    assert {Path(str(module.__file__)) for module in (loop, interface)} <= set(provenance.sources())


def test_software_of_another_version_is_unknown_software() -> None:
    assert provenance.recorded_by({SOFTWARE: '{"trirail": "9.0", "build": 7}'}) is None
    assert provenance.recorded_by({SOFTWARE: "no JSON"}) is None


# ---------------------------------------------------------------------- rotation


def by_time(folder: Path) -> tuple[NDArray[np.void], list[Path]]:
    sent, time = made.records(3.0), Time()
    recording = recorder(folder, time, configured(rotate_minutes=1.0 / 60.0))
    feed(recording, sent, time)
    recording.close()
    return sent, parts(folder)


def test_a_recording_goes_on_in_another_file_after_its_time(tmp_path: Path) -> None:
    sent, files = by_time(tmp_path)
    assert [path.stem.partition("-part")[2] for path in files] == ["", "2", "3"]
    read_back = [read(path) for path in files]
    assert [len(part.records) for part in read_back] == pytest.approx([1000] * 3, abs=2 * BATCH)
    assert made.bits(join(read_back).records) == made.bits(sent)


@pytest.fixture(scope="module")
def rotated(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return by_time(tmp_path_factory.mktemp("rotated"))[1]


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    damage=st.lists(st.sampled_from(["none", "empty", "nul", "no records", "text"]), min_size=3, max_size=3),
    order=st.permutations(range(3)),
)
def test_a_session_is_read_without_the_files_that_a_power_cut_has_spoilt(
    rotated: list[Path], damage: list[str], order: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(shutil.copy(path, folder)) for path in rotated]
        for path, how in zip(files, damage, strict=True):
            whole = path.read_bytes()
            spoilt = {"none": whole, "empty": b"", "nul": bytes(1000), "no records": whole[:100], "text": b"no data"}
            path.write_bytes(spoilt[how])
        command = ["report", "--json", *(str(files[number]) for number in order)]
        if damage.count("none") == 0:
            with pytest.raises(ServiceError):
                app(command, exit_on_error=False, result_action="return_value")
            return
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert app(command, exit_on_error=False, result_action="return_value") == 0
        alone = [len(read(path).records) for path, how in zip(files, damage, strict=True) if how == "none"]
    assert json.loads(capsys.readouterr().out)["cycles"] == sum(alone)
    skipped = [path for path, how in zip(files, damage, strict=True) if how != "none"]
    assert sorted(str(each.message).partition(":")[0] for each in told) == sorted(map(str, skipped))


def test_every_file_is_complete_in_itself(tmp_path: Path) -> None:
    _, files = by_time(tmp_path)
    found = []
    for path in files:
        reader = RrdReader(path)
        assert len(reader.blueprints()) == 1
        still = {chunk.entity_path for chunk in reader.stream() if chunk.is_static}
        moving = {chunk.entity_path for chunk in reader.stream() if not chunk.is_static}
        texts = read(path).texts
        assert provenance.configuration(texts) == configured(rotate_minutes=1.0 / 60.0)
        assert provenance.recorded_by(texts) == provenance.software()
        found.append((still, moving, read(path).name, reader.recordings()[0].recording_id))
    assert found[1:] == found[:-1]
    assert {"/robot/rails", "/sliders/velocity", "/mode"} <= found[0][0]


def test_a_recording_goes_on_in_another_file_beyond_its_size(tmp_path: Path) -> None:
    sent, time = made.records(12.0), Time()
    recording = recorder(tmp_path, time, configured(rotate_mb=1.0))
    feed(recording, sent, time)
    recording.close()
    sizes = [path.stat().st_size for path in parts(tmp_path)]
    assert len(sizes) > 2
    assert all(1e6 < size < 2e6 for size in sizes[:-1])
    assert made.bits(join([read(path) for path in parts(tmp_path)]).records) == made.bits(sent)


# ---------------------------------------------------------------------- the folder


AHEAD = 4e9
"""A moment of the year 2096, when a clock had not been told the time yet [s since 1970]."""


def kept(folder: Path, name: str, megabytes: float, written: float = 1e9) -> Path:
    path = folder / name
    path.write_bytes(b"")
    os.truncate(path, round(megabytes * 1e6))
    os.utime(path, (written, written))
    return path


def test_the_oldest_recordings_go_and_black_boxes_last(tmp_path: Path) -> None:
    box = kept(tmp_path, "fault-20260101-100000.rrd", 4)
    old = kept(tmp_path, "demo-20260101-110000.rrd", 4)
    log = kept(tmp_path, "demo-20260101-110000.log", 2)
    part = kept(tmp_path, "demo-20260101-120000-part2.rrd", 4)
    mine = kept(tmp_path, "my-best.rrd", 50)
    live = kept(tmp_path, "other-20260101-090000.rrd", 4)
    lock = retention.lock(live)
    assert retention.tidy(tmp_path, 18e6).deleted == []
    assert retention.tidy(tmp_path, 17e6).deleted == [old]
    assert not log.exists()
    assert retention.tidy(tmp_path, 8e6).deleted == [part]
    assert retention.tidy(tmp_path, 7e6).deleted == [box]
    assert retention.tidy(tmp_path, 1e6).deleted == []  # what is being written stays
    assert mine.exists()
    retention.unlock(lock)
    assert retention.tidy(tmp_path, 1e6).deleted == [live]


@pytest.mark.parametrize("live_mb", [(9,), (50,), (30, 30), (5, 4)])
def test_files_that_are_being_written_take_the_place_of_at_most_half_of_the_others(
    tmp_path: Path, live_mb: tuple[int, ...]
) -> None:
    boxes = [kept(tmp_path, f"fault-2026010{day}-100000.rrd", 1) for day in (1, 2)]
    old = [kept(tmp_path, f"demo-2026010{day}-110000.rrd", 2) for day in range(1, 9)]
    live = [kept(tmp_path, f"other-20260101-09000{which}.rrd", size) for which, size in enumerate(live_mb)]
    locks = [retention.lock(path) for path in live]
    assert retention.tidy(tmp_path, 18e6).deleted == old[:5]
    assert retention.tidy(tmp_path, 18e6).deleted == []
    assert retention.tidy(tmp_path, 4e6, live[0].stem).deleted == old[5:]
    assert all(path.exists() for path in (*boxes, *live))
    for lock in locks:
        retention.unlock(lock)
    assert set(retention.tidy(tmp_path, 4e6).deleted) == set(live)
    assert all(path.exists() for path in boxes)


@settings(max_examples=30)
@given(
    others=st.lists(
        st.tuples(st.dates(date(1970, 1, 2), date(2099, 1, 1)), st.integers(1, 12), st.floats(0.0, AHEAD)), max_size=6
    ),
    own=st.integers(0, 12),
    at_most=st.integers(0, 30),
    shortage=st.integers(-5, 30),
    boxes=st.integers(0, 3),
)
def test_parts_of_the_running_session_go_last_whatever_clocks_said(
    others: list[tuple[date, int, float]], own: int, at_most: int, shortage: int, boxes: int
) -> None:
    """Of others the older go first, by name, and a second part before the tenth. A full disk costs no black box."""
    with tempfile.TemporaryDirectory() as parent:
        folder, session = Path(parent), "demo-20260101-120000"
        names = {f"other-{day:%Y%m%d}-000000-part{part}": (day, part) for day, part, _ in others}
        for name, (_, _, written) in zip(names, others, strict=False):
            kept(folder, f"{name}.rrd", 1, written)
        parts = [session, *(f"{session}-part{number}" for number in range(2, own + 1))][:own]
        for name in parts:
            kept(folder, f"{name}.rrd", 1)
        black_boxes = [f"fault-200001{number + 10}-120000" for number in range(boxes)]
        for name in black_boxes:
            kept(folder, f"{name}.rrd", 1)
        others_and_own = [*sorted(names, key=names.__getitem__), *parts]
        in_order = [*others_and_own, *black_boxes]
        deleted = retention.tidy(folder, at_most * 1e6, session, shortage * 1e6).deleted
        gone = max(0, len(in_order) - at_most, min(shortage, len(others_and_own)))
        assert [path.stem for path in deleted] == in_order[:gone]


def test_every_name_that_the_recorder_chooses_is_counted_and_deleted(tmp_path: Path) -> None:
    """Sessions that begin in the same second have numbers, and so have parts whose name is in use."""
    sessions = [claim(tmp_path, "demo-20260101-110000") for _ in range(2)]
    names = [claim(tmp_path, f"{first.stem}-part{part}") for first in sessions for part in (2, 2, 10)]
    in_order = [sessions[0], *names[:3], sessions[1], *names[3:]]
    for path in in_order:
        os.truncate(path, 1_000_000)
    for left in reversed(range(len(in_order))):
        (oldest,) = retention.tidy(tmp_path, left * 1e6).deleted
        assert oldest == in_order[-1 - left]


def test_another_session_of_the_same_second_goes_before_the_running_one(tmp_path: Path) -> None:
    running, other = (claim(tmp_path, "demo-20260101-110000") for _ in range(2))
    part = claim(tmp_path, f"{running.stem}-part2")
    for path in (running, other, part):
        os.truncate(path, 1_000_000)
    assert retention.tidy(tmp_path, 2e6, running.stem).deleted == [other]


def test_the_recorder_tidies_its_folder(tmp_path: Path) -> None:
    old = kept(tmp_path, "demo-20960101-110000.rrd", 4, AHEAD)
    time, told = Time(), list[str]()
    recording = recorder(tmp_path, time, configured(keep_mb=2.0), warn=lambda text: told.append(text.text))
    feed(recording, made.records(0.1), time)
    recording.close()
    assert parts(tmp_path) == [recording.path]
    assert told == [f"old recordings deleted, because all recordings exceed telemetry.keep_mb = 2: {old.name}"]


@pytest.mark.parametrize("frees", [True, False])
def test_the_recorder_makes_room_on_a_disk_that_is_nearly_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frees: bool
) -> None:
    """On a small disk, recording would otherwise end for ever before the recordings reach `keep_mb`.

    A deleted file may free nothing, as with snapshots of the disk: then the others are kept.
    """
    old = [kept(tmp_path, f"demo-2096010{day}-110000.rrd", 40, AHEAD) for day in (1, 2, 3)]
    box = kept(tmp_path, "fault-20960101-100000.rrd", 40, AHEAD)
    others = 0.0

    def usage(folder: Path) -> SimpleNamespace:
        used = sum(path.stat().st_size for path in Path(folder).glob("*.rrd"))
        still_used = 0.0 if frees else 40e6 * sum(not path.exists() for path in old)
        return SimpleNamespace(free=250e6 - others - used - still_used)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    time, told = Time(), list[str]()
    recording = recorder(tmp_path, time, configured(), warn=lambda text: told.append(text.text))
    sent = made.records(60.0)

    def kept_after(part: int) -> list[bool]:
        feed(recording, sent[11_000 * part : 11_000 * (part + 1)], time)
        return [path.exists() for path in (*old, box, recording.path)]

    assert kept_after(0) == [True, True, True, True, True]
    others = 20e6
    assert kept_after(1) == [False, True, True, True, True]
    assert kept_after(2) == [False, True, True, True, True]
    others = 60e6
    assert kept_after(3) == [False, not frees, True, True, True]
    others = 300e6  # another program fills the disk: no black box is deleted
    assert kept_after(4)[3:] == [True, True]
    recording.close()
    told = [words for words in told if "deleted" in words]
    assert told[0] == f"old recordings deleted, because less than 84 MB of the disk were free: {old[0].name}"


def test_space_that_is_used_again_counts_as_freed() -> None:
    """The recorder itself writes more between two deletions than small recordings free."""
    space = retention.Space(100.0)
    for free in (90.0, 89.0, 88.0):
        assert space.shortage(free) == 100.0 - free
        space.note_deletion(free + 1.0)
    space.note_deletion(88.0)
    assert [space.shortage(free) for free in (88.0, 87.0, 100.0, 99.0)] == [0.0, 0.0, 0.0, 1.0]


def test_a_recording_that_cannot_be_deleted_leaves_the_others_to_be_deleted(tmp_path: Path) -> None:
    """It is reported once, and once more if it could not be deleted again after it could."""
    stuck = tmp_path / "demo-20250101-110000.rrd"  # a folder cannot be unlinked, by root either
    time, told = Time(), list[str]()
    recording = recorder(tmp_path, time, configured(keep_mb=6.0), warn=lambda text: told.append(text.text))
    sent = made.records(50.0)
    for minute, is_stuck in enumerate((True, True, False, True)):
        if is_stuck:
            stuck.mkdir(exist_ok=True)
        elif stuck.exists():
            stuck.rmdir()
        old = [kept(tmp_path, f"demo-2025020{day}-11000{minute}.rrd", 4) for day in (1, 2)]
        feed(recording, sent[11_000 * minute : 11_000 * (minute + 1)], time)
        assert not old[0].exists()
    recording.close()
    assert [words.partition(":")[0] for words in told if "cannot" in words] == ["cannot delete old recordings"] * 2
    assert str(stuck) in told[1]
    assert sum("old recordings deleted" in words for words in told) == 4


def test_logs_of_frames_go_with_their_recordings(tmp_path: Path) -> None:
    """So that they need no more room than `keep_mb` allows, however long the session is."""
    frame = Frame(0x201).packed
    time, config = Time(), configured(capture_can=True, rotate_minutes=0.02, keep_mb=6.0)
    recording = recorder(tmp_path, time, config, warn=lambda _: None)
    sent = made.records(12.0)
    for second, records in enumerate(np.split(sent, 12)):
        recording.frames(CAPTURED.pack(float(second), frame) * 10_000)
        feed(recording, records, time)
    recording.close()
    logs = {path.stem for path in tmp_path.glob("*.log")}
    assert logs == {path.stem for path in parts(tmp_path)}
    assert len(logs) > 1
    assert recording.path.with_suffix(".log").read_text().startswith("(")


@settings(max_examples=20)
@given(
    boots=st.lists(
        st.tuples(st.sampled_from([0.0, 0.0, 3.0, 1.7e9, 1.8e9]), st.floats(20.0, 40.0), st.booleans()),
        min_size=2, max_size=6,
    )
)  # fmt: skip
def test_the_newest_recordings_stay_whatever_the_clock_said(boots: list[tuple[float, float, bool]]) -> None:
    """A computer without a battery begins each time in 1970, or at any date until a network has told it the time."""
    with tempfile.TemporaryDirectory() as parent:
        folder, in_order = Path(parent), list[Path]()
        (folder / "demo-20269999-999999.rrd").touch()  # as nobody but a user names a file
        for clock, up, is_box in boots:
            wall = round((clock + up) * 1e9)
            name, reason = (contents.box_name(wall * 1e-9), "x") if is_box else (None, None)
            recording = Recorder(configured(), folder, live=False, name=name, reason=reason, wall_ns=partial(int, wall))
            recording.records(made.records(0.1).tobytes())
            recording.close()
            in_order.append(recording.path)
        (folder / "demo-20269999-999999.rrd").unlink()
        listed = [folder / name for session in find(recorded(folder)) for name in session.files]
        assert listed == in_order
        for path in in_order:
            os.truncate(path, 1_000_000)
        sessions, boxes = ([path for path in in_order if path.name.startswith("fault-") is of] for of in (False, True))
        for left in reversed(range(len(in_order))):
            assert retention.tidy(folder, left * 1e6).deleted == [[*sessions, *boxes][-1 - left]]


def test_a_clock_that_is_right_gives_a_recording_its_date(tmp_path: Path) -> None:
    kept(tmp_path, "demo-19700101-000030.rrd", 1)
    kept(tmp_path, "best-29990101-000000-of-all.rrd", 1)
    recording = recorder(tmp_path, Time(), configured())
    recording.close()
    assert recording.path.name == f"demo-{datetime.fromtimestamp(WALL_NS * 1e-9).astimezone():{retention.STAMP}}.rrd"


# ---------------------------------------------------------------------- disks that fail, and kills


@pytest.mark.parametrize("full_in", [range(2, 22), range(2, 22, 2), range(2, 3), range(2, 22, 7)])
def test_a_full_disk_is_told_of_once_and_once_when_it_is_well_again(
    full_in: range, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one that is full in every other second."""
    told: list[str] = []
    time, sent = Time(), made.records(36.0)
    recording = recorder(tmp_path, time, configured(), warn=lambda text: told.append(text.text))
    for second in range(36):
        with monkeypatch.context() as full:
            if second in full_in:
                full.setattr("shutil.disk_usage", lambda _: Usage(free=10_000_000))
            feed(recording, sent[1000 * second : 1000 * (second + 1)], time)
    recording.close()
    assert [words.partition(":")[0] for words in told] == [
        "nothing is recorded",
        "recording resumed; missing data",
    ]
    assert f"{tmp_path} is full: 10 MB are free" in told[0]
    assert f"{recording.lost} batches in the file" in told[1]


LIMITED = """
import os, resource, sys
from pathlib import Path
import made, telemetry.test_rotation as here
from trirail.telemetry.rotation import RETRY
told, time = [], here.Time()
config = here.configured()
recording = here.recorder(Path(sys.argv[1]), time, config, warn=lambda text: told.append(text.text))
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
sent = made.records(4.0)
here.feed(recording, sent[:3900], time)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
late = sent[3900:].copy()
late["deadline_ns"] += int((RETRY + 10.0) * 1e9)
here.feed(recording, late, time)
recording.close()
assert "cannot be written" in told[0], (told, os._exit(1))
print(recording.path, flush=True)
os._exit(0)
"""


@pytest.mark.long
def test_after_a_disk_that_failed_the_recording_goes_on_in_another_file(tmp_path: Path) -> None:
    command = [sys.executable, "-c", LIMITED, str(tmp_path)]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[1], capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stderr
    first, *others = parts(tmp_path)
    assert first.stat().st_size <= 1_000_000
    assert str(others[-1]) == done.stdout.strip()
    assert len(read(first).records) > 500
    assert read(others[-1]).records["cycle"][-1] == 3999


@pytest.mark.long
def test_a_killed_recorder_leaves_all_that_was_saved(tmp_path: Path) -> None:
    script = (
        "import os, signal, sys; from pathlib import Path; import made, telemetry.test_rotation as here\n"
        "time = here.Time(); kept = here.recorder(Path(sys.argv[1]), time, here.configured())\n"
        "sent = made.records(1.98); here.feed(kept, sent[:1940], time); kept.save()\n"
        "here.feed(kept, sent[1940:], time)\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    assert subprocess.run(command, cwd=Path(__file__).parents[1], check=False).returncode == -9
    (path,) = parts(tmp_path)
    records = read(path).records
    assert made.bits(records) == made.bits(made.records(1.98)[:1940])


def test_what_is_not_saved_yet_is_younger_than_a_fifth_of_a_second() -> None:
    assert GATHER + 1.0 / BATCHES_PER_SECOND < 0.2


def test_records_that_never_came_are_told_of(tmp_path: Path) -> None:
    told: list[str] = []
    time, sent = Time(), made.records(2.0)
    recording = recorder(tmp_path, time, configured(), warn=lambda text: told.append(text.text))
    feed(recording, np.delete(sent, slice(400, 460)), time)
    recording.close()
    assert len(told) == 1
    assert told[0].endswith("60 cycles (recorder too slow)")


# ---------------------------------------------------------------------- the black box


def faulted(folder: Path, seconds: float, at: float, after: float) -> tuple[list[Recording], list[str]]:
    """Let the drives fault at a time, and go on for another; return the black boxes."""
    time, told = Time(), list[str]()
    config = configured(rotate_mb=1.0, capture_can=True)
    box = BlackBox(1000, lambda name, _: recorder(folder, time, config, name=name), lambda text: told.append(text.text))
    sent = made.records(seconds)
    cycle = round(at * 1000)
    box.latch("update_state", ReadoutState(None, (0.01, 0.02, 0.1)))
    feed(box, sent[: cycle - 500], time)
    box.control_input(goal(cycle - 500))
    feed(box, sent[cycle - 500 : cycle], time)
    wall = (WALL_NS + cycle * 1_000_000) * 1e-9
    box.event(Event("fault", "error", "drive B: emergency 4310", seq=1, t=at, cycle=cycle, time=wall))
    box.event(
        Event("mode", "info", "fault: drive B: emergency 4310", mode=Mode.FAULT, seq=2, t=at, cycle=cycle, time=wall)
    )
    feed(box, sent[cycle : cycle + round(after * 1000)], time)
    box.close()
    return [read(path) for path in parts(folder)], told


def test_a_fault_keeps_the_minute_before_and_the_stop(tmp_path: Path) -> None:
    (box,), told = faulted(tmp_path, 70.0, at=65.0, after=4.0)
    (path,) = parts(tmp_path)
    assert path.name == f"{box.name}.rrd"
    assert path.name.startswith("fault-2026112")
    cycles = box.records["cycle"]
    assert np.all(np.diff(cycles) == 1)
    assert cycles[0] <= 65_000 - BEFORE_S * 1000
    assert cycles[-1] >= 65_000 + AFTER_S * 1000 - 1
    assert [line.text for line in box.events] == ["drive B: emergency 4310", "fault: drive B: emergency 4310"]
    assert box.requests == (goal(64_500),)
    assert provenance.configuration(box.texts) == configured(rotate_mb=1.0, capture_can=True)
    assert provenance.recorded_by(box.texts) == provenance.software()
    assert told == []


def test_a_flood_of_messages_before_a_fault_leaves_the_newest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blackbox, "MAX_MESSAGES_MB", 0.05)
    time, told = Time(), list[str]()
    box = BlackBox(
        1000, lambda name, _: recorder(tmp_path, time, configured(), name=name), lambda text: told.append(text.text)
    )
    box.latch("update_state", ReadoutState(None, (0.01, 0.02, 0.1)))
    sent = made.records(3.0)
    for number in range(100):
        feed(box, sent[20 * number :][:20], time)
        for _ in range(5):
            box.event(
                Event(
                    "refused",
                    "info",
                    f"{number:04}" * 50,
                    seq=number,
                    t=number / 50,
                    cycle=20 * number,
                    time=WALL_NS * 1e-9,
                )
            )
    box.event(Event("fault", "error", "drive B: emergency 4310", seq=100, t=2.0, cycle=2000, time=WALL_NS * 1e-9))
    box.close()
    (path,) = parts(tmp_path)
    *flood, fault = (line.text for line in read(path).events)
    assert fault == "drive B: emergency 4310"
    assert flood == [f"{number:04}" * 50 for number in range(100) for _ in range(5)][-len(flood) :]
    assert 40 < len(flood) < 50_000 / (blackbox.MESSAGE_OVERHEAD + 200)
    assert len(read(path).records) == 2000
    assert "black box: messages exceed" in told[0]


def test_a_service_that_ends_right_after_a_fault_keeps_it_too(tmp_path: Path) -> None:
    (box,), _ = faulted(tmp_path, 3.0, at=1.5, after=0.3)
    assert box.records["cycle"].tolist() == list(range(1800))


def test_without_a_fault_there_is_no_black_box(tmp_path: Path) -> None:
    time = Time()
    box = BlackBox(1000, lambda name, _: recorder(tmp_path, time, configured(), name=name), print)
    feed(box, made.records(1.0), time)
    box.event(
        Event("mode", "info", "holding: enable by ann", mode="holding", seq=1, t=0.5, cycle=500, time=WALL_NS * 1e-9)
    )
    box.close()
    assert list(tmp_path.iterdir()) == []


def test_a_black_box_that_cannot_be_written_is_told_of(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    _, told = faulted(blocked / "x", 1.0, at=0.6, after=0.2)
    assert told[0].startswith("black box: the minute before the fault is not saved: cannot write a recording to")
    assert told[0].endswith("Not a directory; set telemetry.directory to a folder that can be written")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_where_the_disk_is_full_a_black_box_asks_for_room(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("trirail.telemetry.rotation._try", full)
    _, told = faulted(tmp_path, 1.0, at=0.6, after=0.2)
    assert told[0].endswith(
        f"{os.strerror(number)}; free some space on that disk; telemetry.keep_mb limits the size of all recordings"
    )
    assert list(tmp_path.iterdir()) == []
