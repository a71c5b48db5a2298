"""Sessions found again: by the index, whatever has become of it, the same as by reading every recording."""

from __future__ import annotations

import json
import os
import sqlite3
import tempfile
from collections import Counter
from contextlib import closing
from datetime import datetime
from pathlib import Path

import made
import msgspec
import numpy as np
import pytest
from cyclopts import CycloptsError
from hypothesis import given, settings
from hypothesis import strategies as st
from trirail.cli.app import app
from trirail.config import SIM, Config, load
from trirail.telemetry import contents
from trirail.telemetry.blackbox import BlackBox
from trirail.telemetry.contents import Contents, FaultEntry, of_file
from trirail.telemetry.recorder import Recorder
from trirail.telemetry.session_index import FILE, RecordedSession, SessionIndex, Wanted
from trirail.wire.goals import PoseGoal
from trirail.wire.messages import Event, FaultDetail
from trirail.wire.packets import CommandRequest, ControlInput, GoalRequest
from trirail.wire.vocabulary import Command

LATER = 4e9
"""A time at which nothing of today is being written [s since 1970]."""


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
    index = SessionIndex(folder)
    recording = Recorder(
        configured(name), folder, index=index, live=False, wall_ns=time.wall, monotonic_ns=time.monotonic
    )
    box = BlackBox(
        1000,
        lambda called, reason: Recorder(
            configured(name), folder, name=called, reason=reason, index=index, live=False, wall_ns=time.wall,
            monotonic_ns=time.monotonic,
        ),
        pytest.fail,
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


def rested(folder: Path) -> None:
    """Let nothing be being written any more."""
    for path in folder.glob("*.rrd"):
        os.utime(path, (1e9, 1e9))


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
    kept = SessionIndex(tmp_path).find()
    read: list[Contents] = [of_file(path) for path in tmp_path.glob("*.rrd")]
    again = SessionIndex(tmp_path)
    again.clear()
    again.put(read)
    assert len(kept) == 2
    assert again.find() == kept
    box, whole = sorted(kept, key=lambda session: session.reason is None)
    assert box.reason == "drive B: EMCY 8700"
    assert whole.reason is None
    assert (whole.robot, whole.goals, sorted(whole.users)) == ("demo", {"done": 1, "faulted": 1}, ["ann", "ben", "eva"])
    assert whole.faults == box.faults == ["drive B: EMCY 8700"]
    assert whole.cycles == 500
    assert whole.began == datetime.fromisoformat("2026-01-31 12:00:00").timestamp()
    assert whole.ended == pytest.approx(whole.began + 0.499)


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ([], ["one", "two"]),
        (["--robot", "two"], ["two"]),
        (["--since", "2026-02-01"], ["two"]),
        (["--until", "2026-02-01"], ["one"]),
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
        (["--fault", "zzz"], "0 sessions\nno recorded fault says zzz: there are emcy 0x8700\n"),
        (["--fault", "0x8611"], "0 sessions\nno recorded fault says 0x8611: there are emcy 0x8700\n"),
        (["--fault", "emcy", "--user", "max"], "0 sessions\n"),
    ],
)
def test_a_fault_that_never_was_is_told_with_those_that_were(
    shelf: Path, options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert app(["sessions", str(shelf), *options], exit_on_error=False, result_action="return_value") == 0
    assert capsys.readouterr().out == said


@pytest.mark.parametrize("words", ["0xzzz", "0x87000000000"])
def test_a_code_that_no_fault_can_have_is_refused(shelf: Path, words: str) -> None:
    with pytest.raises(CycloptsError, match=f"{words}' is no code such as 0x8700"):
        app(["sessions", str(shelf), "--fault", words], exit_on_error=False, print_error=False)


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sessions of two robots, without black boxes."""
    folder = tmp_path_factory.mktemp("shelf")
    for began, name in (("2026-01-31 12:00:00", "one"), ("2026-02-28 12:00:00", "two")):
        record(folder, began, name)
    for box in folder.glob("fault-*"):
        box.unlink()
    rested(folder)
    return folder


def _cut(index: Path) -> None:
    index.write_bytes(index.read_bytes()[: index.stat().st_size // 2])


def _scribble(index: Path) -> None:
    content = bytearray(index.read_bytes())
    content[100:] = np.random.default_rng(1).bytes(len(content) - 100)
    index.write_bytes(content)


def _other(index: Path) -> None:
    index.unlink()
    with closing(sqlite3.connect(index)) as other, other:
        other.execute("CREATE TABLE recording (something TEXT)")
        other.execute("PRAGMA user_version = 99")


@pytest.mark.parametrize(
    "damage",
    [
        Path.unlink,
        lambda index: index.write_bytes(b""),
        lambda index: index.write_bytes(b"not a database, by no means" * 100),
        _cut,
        _scribble,
        _other,
    ],
    ids=["gone", "empty", "nonsense", "cut", "scribbled", "other"],
)
def test_a_damaged_index_is_made_anew(shelf: Path, damage: object) -> None:
    before = sessions(shelf)
    damage(shelf / FILE)  # type: ignore[operator]
    assert sessions(shelf) == before
    assert sessions(shelf, "--rebuild") == before


def test_a_recorder_whose_index_is_damaged_goes_on(tmp_path: Path) -> None:
    (tmp_path / FILE).write_bytes(b"not a database, by no means" * 100)
    record(tmp_path)
    rested(tmp_path)
    assert len(sessions(tmp_path)) == 2


def test_a_recorder_that_cannot_write_an_index_says_so_and_records(tmp_path: Path) -> None:
    (tmp_path / FILE).mkdir()
    time, told = Time("2026-01-31 12:00:00"), list[str]()
    recording = Recorder(
        configured(), tmp_path, index=SessionIndex(tmp_path), live=False, wall_ns=time.wall,
        monotonic_ns=time.monotonic, warn=told.append,
    )  # fmt: skip
    recording.records(made.records(0.1).tobytes())
    recording.close()
    assert ["the index of sessions" in words for words in told] == [True]
    assert of_file(recording.path).cycles == 100


def test_a_recording_that_is_deleted_has_no_row(tmp_path: Path) -> None:
    old = record(tmp_path)
    rested(tmp_path)
    time = Time("2026-02-01 12:00:00")
    recording = Recorder(
        configured(keep_mb=1.0), tmp_path, index=SessionIndex(tmp_path), live=False, wall_ns=time.wall,
        monotonic_ns=time.monotonic,
    )  # fmt: skip
    with old.open("r+b") as file:  # the oldest, and large enough to go alone
        file.truncate(3_000_000)
    os.utime(old, (0.9e9, 0.9e9))
    recording.records(made.records(0.1).tobytes())
    recording.close()
    assert not old.exists()
    with closing(sqlite3.connect(tmp_path / FILE)) as index:
        names = {name for (name,) in index.execute("SELECT name FROM recording")}
        senders = {name for (name,) in index.execute("SELECT DISTINCT name FROM sender")}
    assert names == {path.name for path in tmp_path.glob("*.rrd")}
    assert old.name not in senders


def test_what_is_deleted_by_hand_or_was_cut_off_by_a_kill_is_right_all_the_same(shelf: Path, tmp_path: Path) -> None:
    for path in shelf.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    one, two = sorted(tmp_path.glob("*.rrd"))
    killed = tmp_path / "demo-20260301-120000.rrd"
    killed.write_bytes(two.read_bytes()[: two.stat().st_size * 19 // 20])
    one.unlink()
    (tmp_path / "mine.rrd").write_bytes(b"no recording")
    rested(tmp_path)
    found = {session.session: session for session in sessions(tmp_path)}
    assert set(found) == {two.stem, killed.stem, "mine"}
    assert found["mine"].trouble
    assert 0 < found[killed.stem].cycles <= 500


def test_what_is_being_written_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "demo-20260301-120000.rrd").write_bytes(b"RRF2")
    assert sessions(tmp_path) == []
    index = SessionIndex(tmp_path)
    assert [path.name for path in index.update(now=LATER)] == ["demo-20260301-120000.rrd"]
    assert list(index.update(now=LATER)) == []


names = st.sampled_from(["ann", "ben", "eva"])
outcomes = st.sampled_from(["done", "stopped", "faulted"])
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
                    dict.fromkeys(draw(st.lists(names, max_size=2))),
                    Counter(draw(st.lists(st.tuples(names, outcomes), max_size=3))),
                    draw(st.lists(faults, max_size=2)),
                )
            )  # fmt: skip
    return found


def fits(parts: list[Contents], wanted: Wanted) -> bool:
    """Whether a session is wanted: said once more, without SQL."""
    goals = {goal for part in parts for goal in part.goals}
    said = [f"{f.cause} 0x{f.code:04X} {words}".lower() for part in parts for _, f, words in part.faults]
    users = {user for part in parts for user in part.users}
    return (
        (wanted.robot is None or parts[0].robot == wanted.robot)
        and (wanted.since is None or max(part.ended or 0.0 for part in parts) >= wanted.since)
        and (wanted.until is None or min(part.began or 0.0 for part in parts) <= wanted.until)
        and (wanted.fault is None or any(wanted.fault.lower() in text for text in said))
        and (wanted.user is None or wanted.outcome is not None or wanted.user in users)
        and (wanted.outcome is None or any(o == wanted.outcome and wanted.user in (None, u) for u, o in goals))
    )


def test_a_session_that_runs_is_found_and_one_that_was_cut_off_is_read(tmp_path: Path) -> None:
    time = Time("2026-01-31 12:00:00")
    index = SessionIndex(tmp_path)
    recording = Recorder(
        configured(), tmp_path, index=index, live=False, wall_ns=time.wall, monotonic_ns=time.monotonic
    )
    sent = made.records(2.0)
    for start in range(0, 1500, 50):
        time.ns = int(sent["deadline_ns"][start])
        recording.records(sent[start : start + 50].tobytes())
    (found,) = index.find()
    assert (found.running, found.robot, found.files) == (True, "demo", [recording.path.name])
    assert list(index.update(now=0.0)) == []
    (still,) = index.find()
    assert still == found
    assert list(index.update(now=LATER)) == [recording.path]  # it was killed
    (cut_off,) = index.find()
    assert not cut_off.running
    assert cut_off.cycles > found.cycles
    recording.close()
    (whole,) = index.find()
    assert (whole.running, whole.cycles) == (False, 1500)


@settings(max_examples=60)
@given(
    files(),
    st.builds(
        Wanted,
        st.none() | st.sampled_from(["x", "y"]),
        st.none() | when,
        st.none() | when,
        st.none() | st.sampled_from(["EMCY", "0x8700", "can", "drive a"]),
        st.none() | names,
        st.none() | outcomes,
    ),
)
def test_what_is_wanted_is_found_and_nothing_else(found: list[Contents], wanted: Wanted) -> None:
    with tempfile.TemporaryDirectory() as folder:
        index = SessionIndex(Path(folder))
        index.put(found)
        index.put(found)  # again: in place of the same
        by_session: dict[str, list[Contents]] = {}
        for each in found:
            by_session.setdefault(each.session, []).append(each)
        expected = {name for name, parts in by_session.items() if fits(parts, wanted)}
        answer = index.find(wanted)
        assert {session.session for session in answer} == expected
        for session in answer:
            parts = by_session[session.session]
            assert session.cycles == 10 * len(parts)
            assert Counter(session.goals) == sum(
                (Counter({o: n}) for p in parts for (_, o), n in p.goals.items()), Counter()
            )
            assert len(session.faults) == sum(len(part.faults) for part in parts)
            assert set(session.files) == {part.name for part in parts}
        assert [s.began for s in answer] == sorted(s.began or 0.0 for s in answer)


def test_the_name_of_a_black_box_is_that_of_its_faults_time() -> None:
    moment = datetime(2026, 1, 31, 12, 0, 5).astimezone().timestamp()
    assert contents.box_name(moment) == "fault-20260131-120005"
