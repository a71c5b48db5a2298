"""Sessions found again: by what stands beside recordings, whatever has become of it, the same as by reading them."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections import Counter, namedtuple
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import made
import msgspec
import numpy as np
import pytest
from cyclopts import CycloptsError
from hypothesis import given, settings
from hypothesis import strategies as st
from trirail.cli.app import app
from trirail.config import SIM, Config, load
from trirail.telemetry import contents, retention
from trirail.telemetry import sessions as found_sessions
from trirail.telemetry.blackbox import BlackBox
from trirail.telemetry.contents import Contents, FaultEntry, read_contents
from trirail.telemetry.journal import Line
from trirail.telemetry.reading import join, read
from trirail.telemetry.recorder import Recorder
from trirail.telemetry.retention import is_black_box, robot_in, sidecar
from trirail.telemetry.rotation import claim
from trirail.telemetry.sessions import RecordedSession, SessionFilter, find, recorded
from trirail.wire.goals import PoseGoal
from trirail.wire.messages import Event, FaultDetail, Outcome
from trirail.wire.packets import CommandRequest, ControlInput, GoalRequest
from trirail.wire.vocabulary import Command

SECOND = 1000
"""Number of cycles per second."""
Usage = namedtuple("Usage", "free")


class Time:
    """The clocks of a recording, that go with its records."""

    def __init__(self, began: str) -> None:
        self.wall_ns = round(datetime.fromisoformat(began).timestamp()) * 1_000_000_000
        self.ns = made.MONOTONIC_NS

    def monotonic(self) -> int:
        return self.ns

    def wall(self) -> int:
        return self.wall_ns + self.ns - made.MONOTONIC_NS


def configured(name: str = "demo", **telemetry: object) -> Config:
    config = load(SIM)
    return msgspec.structs.replace(
        config,
        robot=msgspec.structs.replace(config.robot, name=name),
        telemetry=msgspec.structs.replace(config.telemetry, **telemetry),
    )


def asked(seq: int, user: str) -> ControlInput:
    return ControlInput(seq, 10, made.MONOTONIC_NS, GoalRequest(seq, user, f"g{seq}", PoseGoal(0.01, 0.0, 0.1), 0))


def record(folder: Path, began: str = "2026-01-31 12:00:00", name: str = "demo", seconds: float = 0.5) -> Path:
    """Record a session in which ann and ben send goals, and drive B has a fault."""
    time = Time(began)
    recording = Recorder(
        configured(name), folder, sidecars=True, live=False, wall_ns=time.wall, monotonic_ns=time.monotonic
    )
    box = BlackBox(
        1000,
        lambda called, reason: Recorder(
            configured(name), folder, name=called, reason=reason, sidecars=True, live=False, wall_ns=time.wall,
            monotonic_ns=time.monotonic,
        ),
        lambda text: pytest.fail(text.text),
    )  # fmt: skip
    for taker in (recording, box):
        taker.control_input(asked(1, "ann"))
        taker.control_input(asked(2, "ben"))
        taker.control_input(ControlInput(3, 11, made.MONOTONIC_NS, CommandRequest(3, "eva", Command.STOP)))
    sent = made.records(seconds)
    for start in range(0, len(sent), 20):
        time.ns = int(sent[start : start + 20]["deadline_ns"][-1])
        recording.records(sent[start : start + 20].tobytes())
        box.records(sent[start : start + 20].tobytes())
    now = time.wall() * 1e-9
    for event in (
        Event("goal", "info", "done", id="g1", outcome="done", user="ann", seq=1, t=0.3, cycle=300, time=now),
        Event("goal", "error", "faulted", id="g2", outcome="faulted", user="ben", seq=2, t=0.3, cycle=300, time=now),
        Event(
            "fault",
            "error",
            "drive B: EMCY 8700",
            fault=FaultDetail("emcy", "B", 0x8700),
            seq=3,
            t=0.3,
            cycle=300,
            time=now,
        ),
    ):
        recording.event(event)
        box.event(event)
    recording.close()
    box.close()
    return recording.path


def sessions(folder: Path, *options: str) -> list[RecordedSession]:
    """What the command prints."""
    done: list[str] = []
    capture = pytest.MonkeyPatch()
    capture.setattr("trirail.cli.terminal.json", lambda content: done.append(msgspec.json.encode(content).decode()))
    try:
        assert (
            app(["sessions", str(folder), "--json", *options], exit_on_error=False, result_action="return_value") == 0
        )
    finally:
        capture.undo()
    return msgspec.convert(json.loads(done[0])["sessions"], list[RecordedSession])


def test_what_the_recorder_enters_is_what_its_files_hold(tmp_path: Path) -> None:
    record(tmp_path)
    kept = find(recorded(tmp_path, on_read=lambda path: pytest.fail(f"{path} was read")))
    read: list[Contents] = [read_contents(path) for path in tmp_path.glob("*.rrd")]
    assert len(kept) == 2
    assert find(read) == kept
    box, whole = sorted(kept, key=lambda session: session.reason is None)
    assert box.reason == "drive B: EMCY 8700"
    assert whole.reason is None
    assert (whole.robot, whole.goals, sorted(whole.users)) == ("demo", {"done": 1, "faulted": 1}, ["ann", "ben", "eva"])
    assert whole.faults == box.faults == ["drive B: EMCY 8700"]
    assert whole.cycles == 500
    assert whole.began == datetime.fromisoformat("2026-01-31 12:00:00").timestamp()
    assert whole.ended == pytest.approx(whole.began + 0.499)


@settings(max_examples=10)
@given(full=st.lists(st.booleans(), min_size=2, max_size=6), faults=st.lists(st.integers(0, 5), max_size=6))
def test_contents_list_what_was_written_and_events_are_written_when_the_disk_has_room_again(
    full: list[bool], faults: list[int]
) -> None:
    time = Time("2026-01-31 12:00:00")
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        recording = Recorder(
            configured(), Path(folder), sidecars=True, live=False, wall_ns=time.wall, monotonic_ns=time.monotonic
        )
        for number, records in enumerate(np.split(made.records(len(full) * 1.0), len(full))):
            patch.setattr("shutil.disk_usage", lambda _, number=number: Usage(free=0 if full[number] else 1 << 40))
            for start in range(0, SECOND, 50):
                time.ns = int(records[start : start + 50]["deadline_ns"][-1])
                recording.records(records[start : start + 50].tobytes())
                recording.control_input(asked(start, "ann"))
                recording.save()
            for seq in [seq for seq, at in enumerate(faults) if at == number]:
                now, fault = time.wall() * 1e-9 + seq, FaultDetail("emcy", "B", 0x8700 + seq)
                recording.event(
                    Event("fault", "error", f"fault {seq}", fault=fault, seq=seq, t=number + 1.0, cycle=0, time=now)
                )
                recording.save()
        recording.close()
        (listed,) = find(recorded(Path(folder), on_read=lambda path: pytest.fail(f"{path} was read")))
        (read,) = find([read_contents(recording.path)])
    assert (listed.cycles, listed.lost_cycles) == (SECOND * full.count(False), SECOND * full.count(True))
    if not all(full):
        assert msgspec.structs.replace(listed, lost_cycles=0) == read
    written = [seq for seq, at in enumerate(faults) if at < len(full)]
    if not full[-1]:
        assert sorted(listed.faults) == [f"fault {seq}" for seq in written]


def test_a_disk_that_is_slow_at_the_start_changes_no_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    time = Time("2026-01-31 12:00:00")

    def claim_slowly(folder: Path, name: str) -> Path:
        time.ns += 3_000_000_000
        return claim(folder, name)

    monkeypatch.setattr("trirail.telemetry.recorder.claim", claim_slowly)
    recording = Recorder(
        configured(), tmp_path, sidecars=True, live=False, wall_ns=time.wall, monotonic_ns=time.monotonic
    )
    recording.records(made.records(0.1).tobytes())
    recording.close()
    assert contents.load(recording.path) == read_contents(recording.path)


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ([], ["one", "two"]),
        (["--robot", "two"], ["two"]),
        (["--since", "2026-02-01"], ["two"]),
        (["--until", "2026-02-01"], ["one"]),
        (["--since", "2026-01-31", "--until", "2026-01-31"], ["one"]),
        (["--until", "2026-01-31T00:00"], []),
        (["--since", "2026-03-01"], []),
        (["--fault", "EMCY"], ["one", "two"]),
        (["--fault", "0x8700"], ["one", "two"]),
        (["--fault", "8700"], ["one", "two"]),
        (["--fault", "0x8611"], []),
        (["--user", "eva"], ["one", "two"]),
        (["--user", "max"], []),
        (["--outcome", "faulted"], ["one", "two"]),
        (["--outcome", "stopped"], []),
        (["--outcome", "faulted", "--user", "ben"], ["one", "two"]),
        (["--outcome", "faulted", "--user", "ann"], []),
        (["--last", "1"], ["two"]),
    ],
)
def test_sessions_are_found_by_what_was_in_them(shelf: Path, options: list[str], found: list[str]) -> None:
    assert [session.robot for session in sessions(shelf, *options) if session.reason is None] == found


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--fault", "zzz"], "0 sessions\nno recorded fault contains zzz; known faults: emcy 0x8700\n"),
        (["--fault", "0x8611"], "0 sessions\nno recorded fault contains 0x8611; known faults: emcy 0x8700\n"),
        (["--fault", "emcy", "--user", "max"], "0 sessions\n"),
    ],
)
def test_a_fault_that_never_was_is_told_with_those_that_were(
    shelf: Path, options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert app(["sessions", str(shelf), *options], exit_on_error=False, result_action="return_value") == 0
    assert capsys.readouterr().out == said


@pytest.mark.parametrize("options", [("--since", "0001-01-01"), ("--until", "0001-01-01T00:00"), ("--last", "-1")])
def test_what_is_no_time_and_no_number_of_sessions_is_refused(shelf: Path, options: tuple[str, str]) -> None:
    with pytest.raises(CycloptsError, match=options[0]):
        app(["sessions", str(shelf), *options], exit_on_error=False, print_error=False)


@pytest.mark.parametrize("words", ["0xzzz", "0x87000000000"])
def test_a_code_that_no_fault_can_have_is_refused(shelf: Path, words: str) -> None:
    with pytest.raises(CycloptsError, match=f"{words}' is not a code such as 0x8700"):
        app(["sessions", str(shelf), "--fault", words], exit_on_error=False, print_error=False)


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sessions of two robots, without black boxes."""
    folder = tmp_path_factory.mktemp("shelf")
    for began, name in (("2026-01-31 12:00:00", "one"), ("2026-02-28 12:00:00", "two")):
        record(folder, began, name)
    for box in folder.glob("fault-*"):
        box.unlink()
    return folder


def _cut(beside: Path) -> None:
    beside.write_bytes(beside.read_bytes()[: beside.stat().st_size // 2])


@pytest.mark.parametrize(
    "damage",
    [
        Path.unlink,
        lambda beside: beside.write_bytes(b""),
        lambda beside: beside.write_bytes(b"\xff\x00 nonsense" * 100),
        _cut,
        lambda beside: beside.write_text("[1, 2]"),
        lambda beside: beside.write_text('{"name": "demo.rrd", "robot": "demo", "version": 99}'),
    ],
    ids=["gone", "empty", "nonsense", "cut", "other", "newer"],
)
def test_a_recording_with_nothing_usable_beside_it_is_read(shelf: Path, damage: Callable[[Path], object]) -> None:
    before = sessions(shelf)
    one = sidecar(min(shelf.glob("*.rrd")))
    kept = one.read_bytes()
    damage(one)
    assert sessions(shelf) == before
    assert one.read_bytes() == kept
    assert sessions(shelf, "--rebuild") == before


def test_a_reason_that_passes_is_not_kept(shelf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = min(shelf.glob("*.rrd"))
    cut = tmp_path / whole.name
    cut.write_bytes(whole.read_bytes()[:-100])

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr("shutil.copyfile", refuse)
        (told,) = sessions(tmp_path)
        assert "No space left" in str(told.trouble)
        contents.save(cut, Contents(cut.name, "", trouble=told.trouble))  # as earlier versions did
    (told,) = sessions(tmp_path)
    assert (told.trouble, told.robot) == (None, "one")
    assert contents.load(cut) is not None


DAMAGES: dict[str, Callable[[Path], object]] = {
    "nothing": lambda path: path.write_bytes(b""),
    "header": lambda path: path.write_bytes(path.read_bytes()[:9]),
    "text": lambda path: path.write_text("t,x,y\n"),
    "middle": lambda path: path.write_bytes(path.read_bytes().replace(b"trirail", b"\0" * 7)),
}
FILTERS = ["--robot=one", "--since=2026-01-01", "--until=2027-01-01", "--user=eva", "--fault=emcy", "--outcome=done"]


@pytest.mark.parametrize("option", FILTERS)
@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_file_that_cannot_be_read_is_listed_or_named(
    shelf: Path, tmp_path: Path, damage: Callable[[Path], object], option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def printed(*words: str) -> str:
        assert app(["sessions", str(tmp_path), *words], exit_on_error=False, result_action="return_value") == 0
        return capsys.readouterr().out

    for path in shelf.glob("one-*.rrd"):
        damage(Path(shutil.copy(path, tmp_path)))
    (name,) = (path.name for path in tmp_path.iterdir())
    answer = json.loads(printed(option, "--json"))
    assert [*answer["unreadable"], *(file for each in answer["sessions"] for file in each["files"])] == [name]
    assert bool(answer["sessions"]) is (option == "--robot=one")
    assert name in printed(option)
    assert not sidecar(tmp_path / name).exists()
    assert json.loads(printed("--robot=two", "--json"))["unreadable"] == [name]
    assert not sessions(tmp_path, "--robot=two")


@settings(max_examples=5)
@given(st.sampled_from([os.mkfifo, os.mkdir, lambda path: os.symlink("/dev/zero", path)]))
def test_what_is_not_a_regular_file_is_no_recording(make: Callable[[Path], None]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "demo-20260131-120000.rrd")
        make(path)
        assert recorded(Path(folder)) == []
        assert [*Path(folder).iterdir()] == [path]
        retention.tidy(Path(folder), -1.0)  # does not wait for a writer


@settings(max_examples=30)
@given(st.data())
def test_what_several_files_of_a_session_contain_is_read_once(shelf: Path, data: st.DataObject) -> None:
    whole = read(min(shelf.glob("*.rrd")))
    lines = [Line(t, np.datetime64("2026-01-31"), "INFO", text) for t, text in ((0.1, "a"), (0.1, "b"), (0.2, "a"))]
    whole = whole._replace(events=sorted([*whole.events, *lines], key=lambda line: line.t))
    holders = st.sets(st.sampled_from(range(3)), min_size=1)
    of_events, of_requests, of_records = (
        data.draw(st.lists(holders, min_size=len(items), max_size=len(items)))
        for items in (whole.events, whole.requests, range(10))
    )
    blocks = np.array_split(np.arange(len(whole.records)), 10)
    parts = []
    for number in range(3):
        rows = np.concatenate([blocks[0], *(blocks[k] for k in range(1, 10) if number in of_records[k])])
        parts.append(
            whole._replace(
                records=whole.records[rows],
                t=whole.t[rows],
                wall=whole.wall[rows],
                events=[line for line, held in zip(whole.events, of_events, strict=True) if number in held],
                requests=tuple(item for item, held in zip(whole.requests, of_requests, strict=True) if number in held),
            )
        )
    joined = join(parts)
    assert made.bits(joined.records) == made.bits(whole.records)
    assert joined.requests == whole.requests
    assert sorted(map(repr, joined.events)) == sorted(map(repr, whole.events))


def test_rebuild_reads_what_seems_usable(shelf: Path) -> None:
    before = sessions(shelf)
    beside = sidecar(min(shelf.glob("*.rrd")))
    beside.write_bytes(beside.read_bytes().replace(b'"eva"', b'"max"'))
    assert sessions(shelf) != before
    assert sessions(shelf, "--rebuild") == before
    assert sessions(shelf) == before


def test_a_folder_that_cannot_be_written_is_listed_all_the_same(shelf: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = sessions(shelf)
    beside = sidecar(min(shelf.glob("*.rrd")))
    kept = beside.read_bytes()
    beside.unlink()

    def refuse(*_: object) -> None:
        raise PermissionError

    with monkeypatch.context() as unwritable:
        unwritable.setattr("trirail_drivers.files.replace", refuse)
        assert sessions(shelf) == before
    assert not beside.exists()
    beside.write_bytes(kept)


def test_a_recorder_that_cannot_write_beside_its_recording_says_so_and_records(tmp_path: Path) -> None:
    time, told = Time("2026-01-31 12:00:00"), list[str]()
    recording = Recorder(
        configured(), tmp_path, sidecars=True, live=False, wall_ns=time.wall,
        monotonic_ns=time.monotonic, warn=lambda text: told.append(text.text),
    )  # fmt: skip
    sidecar(recording.path).mkdir()
    recording.records(made.records(0.1).tobytes())
    recording.close()
    assert ["cannot be written, so trirail sessions reads the recording" in words for words in told] == [True]
    assert read_contents(recording.path).cycles == 100


def test_what_stands_beside_a_recording_is_for_the_same_people(tmp_path: Path) -> None:
    recording = record(tmp_path)
    for mode in (0o640, 0o600):
        recording.chmod(mode)
        contents.save(recording, read_contents(recording))
        assert sidecar(recording).stat().st_mode & 0o777 == mode


def test_what_stands_beside_a_recording_is_deleted_with_it(tmp_path: Path) -> None:
    old = record(tmp_path)
    time = Time("2026-02-01 12:00:00")
    recording = Recorder(
        configured(keep_mb=1.0), tmp_path, sidecars=True, live=False, wall_ns=time.wall,
        monotonic_ns=time.monotonic,
    )  # fmt: skip
    with old.open("r+b") as file:  # the oldest, and large enough to go alone
        file.truncate(3_000_000)
    recording.records(made.records(0.1).tobytes())
    recording.close()
    assert not old.exists()
    assert {path.name for path in tmp_path.glob("*.json")} == {sidecar(path).name for path in tmp_path.glob("*.rrd")}


def test_what_is_deleted_by_hand_or_was_cut_off_by_a_kill_is_right_all_the_same(shelf: Path, tmp_path: Path) -> None:
    for path in shelf.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    one, two = sorted(tmp_path.glob("*.rrd"))
    killed = tmp_path / "demo-20260301-120000.rrd"
    killed.write_bytes(two.read_bytes()[: two.stat().st_size * 19 // 20])
    one.unlink()
    (tmp_path / "mine.rrd").write_bytes(b"no recording")
    found = {session.session: session for session in sessions(tmp_path)}
    assert set(found) == {two.stem, killed.stem, "mine"}
    assert found["mine"].trouble
    assert 0 < found[killed.stem].cycles <= 500


def read_in(folder: Path) -> list[Path]:
    """Return which recordings had to be read."""
    found: list[Path] = []
    recorded(folder, on_read=found.append)
    return found


def test_what_is_being_written_is_left_alone(shelf: Path, tmp_path: Path) -> None:
    written = tmp_path / "demo-20260301-120000.rrd"
    shutil.copy(min(shelf.glob("*.rrd")), written)
    lock = retention.lock(written)
    assert sessions(tmp_path) == []
    assert read_in(tmp_path) == []
    retention.unlock(lock)
    assert read_in(tmp_path) == [written]
    assert read_in(tmp_path) == []


names = st.sampled_from(["ann", "ben", "eva"])
outcomes: st.SearchStrategy[Outcome] = st.sampled_from(("done", "stopped", "faulted"))
when = st.floats(0.0, 100.0)
faults = st.builds(
    FaultEntry,
    when,
    st.builds(FaultDetail, st.sampled_from(["emcy", "bus"]), st.just(""), st.sampled_from([0, 0x8700])),
    st.sampled_from(["drive A", "CAN bus"]),
)


@st.composite
def files(draw: st.DrawFn) -> list[Contents]:
    found = []
    for number in range(draw(st.integers(0, 8))):
        robot = draw(st.sampled_from(["x", "y"]))
        for part in range(draw(st.integers(1, 3))):
            began = draw(when)
            found.append(
                Contents(
                    f"{robot}-{number}{f'-part{part + 1}' if part else ''}.rrd", robot, began, began + draw(when), 10,
                    draw(st.sets(names, max_size=2)),
                    draw(st.dictionaries(names, st.dictionaries(outcomes, st.integers(1, 3), min_size=1), max_size=2)),
                    draw(st.lists(faults, max_size=2)),
                )
            )  # fmt: skip
    return found


def fits(parts: list[Contents], wanted: SessionFilter) -> bool:
    """Whether a session is wanted: said once more."""
    goals = {(user, outcome) for part in parts for user, outcomes in part.goals.items() for outcome in outcomes}
    said = [f"{each.fault.cause} 0x{each.fault.code:04X} {each.message}".lower() for p in parts for each in p.faults]
    users = {user for part in parts for user in part.users}
    return (
        (wanted.robot is None or parts[0].robot == wanted.robot)
        and (wanted.since is None or max(part.ended or 0.0 for part in parts) >= wanted.since)
        and (wanted.until is None or min(part.began or 0.0 for part in parts) <= wanted.until)
        and (wanted.fault is None or any(wanted.fault.lower() in text for text in said))
        and (wanted.user is None or wanted.outcome is not None or wanted.user in users)
        and (wanted.outcome is None or any(o == wanted.outcome and wanted.user in (None, u) for u, o in goals))
    )


def test_a_session_that_runs_is_found_and_one_that_was_cut_off_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    time = Time("2026-01-31 12:00:00")
    recording = Recorder(
        configured(), tmp_path, sidecars=True, live=False, wall_ns=time.wall, monotonic_ns=time.monotonic
    )
    sent = made.records(2.0)
    for start in range(0, 1500, 50):
        time.ns = int(sent["deadline_ns"][start])
        recording.records(sent[start : start + 50].tobytes())
    (found,) = find(recorded(tmp_path))
    assert (found.running, found.robot, found.files) == (True, "demo", [recording.path.name])
    assert read_in(tmp_path) == []
    with monkeypatch.context() as killed:
        killed.setattr(found_sessions, "is_being_written", lambda _: False)
        assert read_in(tmp_path) == [recording.path]
    (cut_off,) = find(recorded(tmp_path))
    assert not cut_off.running
    assert cut_off.cycles > found.cycles
    recording.close()
    (whole,) = find(recorded(tmp_path))
    assert (whole.running, whole.cycles) == (False, 1500)


@settings(max_examples=60)
@given(
    files(),
    st.builds(
        SessionFilter,
        st.none() | st.sampled_from(["x", "y"]),
        st.none() | when,
        st.none() | when,
        st.none() | st.sampled_from(["EMCY", "0x8700", "can", "drive a"]),
        st.none() | names,
        st.none() | outcomes,
    ),
)
def test_what_is_wanted_is_found_and_nothing_else(found: list[Contents], wanted: SessionFilter) -> None:
    by_session: dict[str, list[Contents]] = {}
    for each in found:
        by_session.setdefault(each.session, []).append(each)
    expected = {name for name, parts in by_session.items() if fits(parts, wanted)}
    answer = find(found, wanted)
    assert {session.session for session in answer} == expected
    for session in answer:
        parts = by_session[session.session]
        assert session.cycles == 10 * len(parts)
        goals = Counter[str]()
        for outcomes in (outcomes for part in parts for outcomes in part.goals.values()):
            goals.update(outcomes)
        assert session.goals == goals
        assert len(session.faults) == sum(len(part.faults) for part in parts)
        assert set(session.files) == {part.name for part in parts}
    assert [s.began for s in answer] == sorted(s.began or 0.0 for s in answer)


@pytest.mark.parametrize("damaged", ["demo-2-part2.rrd", "demo-2-part3.rrd", "demo-2.rrd"])
def test_a_session_with_a_file_that_cannot_be_read_keeps_its_place_and_its_robot(damaged: str) -> None:
    """So that it is among the newest ones, where a cut of power has damaged its last file."""
    parts = {"demo-1.rrd": 1e9, "demo-2.rrd": 2e9, "demo-2-part2.rrd": 3e9, "demo-2-part3.rrd": 4e9}
    found = [Contents(name, "demo", began, began + 10.0, 10) for name, began in parts.items() if name != damaged]
    found.append(Contents(damaged, "", trouble="cut off"))
    answer = find(found)
    assert [(session.session, session.robot) for session in answer] == [("demo-1", "demo"), ("demo-2", "demo")]
    assert answer[1].files == [*(name for name in [*parts][1:] if name != damaged), damaged]


@given(files())
def test_what_stands_beside_a_recording_is_what_was_in_it(found: list[Contents]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for each in found:
            recording = Path(folder, each.name)
            recording.touch()
            contents.save(recording, each)
            assert contents.load(recording) == each


def test_the_name_of_a_black_box_is_that_of_its_faults_time() -> None:
    moment = datetime(2026, 1, 31, 12, 0, 5).astimezone().timestamp()
    assert contents.box_name(moment) == "fault-20260131-120005"


def test_a_robot_whose_name_begins_like_that_of_a_black_box_has_usual_recordings(tmp_path: Path) -> None:
    file = record(tmp_path, name="fault-line")
    sidecar(file).unlink()
    (session,) = (each for each in find(recorded(tmp_path)) if file.name in each.files)
    assert (session.robot, session.reason) == ("fault-line", None)
    assert (robot_in(file.name), robot_in("fault-20260131-120000.rrd")) == ("fault-line", "")
    assert not is_black_box(file.name)
    assert is_black_box("fault-20260131-120000 of Monday.rrd")


@pytest.mark.parametrize(
    "damage", [{"began": 1e300}, {"began": -1e12}, {"ended": 1e300}, {"goals": {"ann": {"dome": 1}}}, {"cycles": "x"}]
)
def test_a_damaged_sidecar_is_none(tmp_path: Path, damage: dict[str, Any]) -> None:
    """The recording is read instead, and the other sessions are listed."""
    recording = tmp_path / "x-20260131-120000.rrd"
    recording.touch()
    contents.save(recording, Contents(recording.name, "x", 1e9, 1e9 + 1.0, 9))
    assert contents.load(recording) is not None
    beside = sidecar(recording)
    beside.write_text(json.dumps(json.loads(beside.read_text()) | damage))
    assert contents.load(recording) is None


@pytest.mark.parametrize("step_s", [20 * 365 * 86400, -3600])
def test_a_session_lasts_as_long_as_it_was_recorded_even_if_the_clock_is_set(
    step_s: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A computer without a battery for its clock has the right time only after the service has started."""
    time = Time("2026-01-31 12:00:00")
    recording = Recorder(
        configured(), tmp_path, sidecars=True, live=False, wall_ns=time.wall, monotonic_ns=time.monotonic
    )
    sent = made.records(4.0)
    for start in range(0, len(sent), 50):
        if start == len(sent) // 2:
            time.wall_ns += step_s * 1_000_000_000
        time.ns = int(sent["deadline_ns"][start + 49])
        recording.records(sent[start : start + 50].tobytes())
        recording.save()
    recording.close()
    for options in ((), ("--rebuild",)):
        assert [session.duration for session in sessions(tmp_path, *options)] == [4.0]
    assert app(["sessions", str(tmp_path)], exit_on_error=False, result_action="return_value") == 0
    assert "  0:00:04  " in capsys.readouterr().out
