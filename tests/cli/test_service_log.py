"""The service's own output: one line for each thing that happens, once, as text or as JSON."""

from __future__ import annotations

import fcntl
import io
import json
import os
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.cli import service_log
from trirail.cli.service_log import MAX_WAITING, Form, Log, is_journal, unbuffered
from trirail.config import SIM
from trirail.wire.messages import Event
from waiting import WITHIN, wait_until

FAULT = Event(
    "fault", "error", "drive B: following error", mode="fault", seq=7, t=1.0, cycle=1000, time=1_700_000_000.25
)


def written(form: Form, *events: Event, to_journal: bool = False) -> list[str]:
    out = io.StringIO()
    log = Log(form, out.write, clock=lambda: 1_700_000_000.0, to_journal=to_journal)
    for event in events:
        log.event(event)
    log.log("the planner has died", "warning")
    return out.getvalue().splitlines()


def test_a_line_has_time_level_and_words() -> None:
    fault, words = written("text", FAULT)
    assert re.fullmatch(r"2023-11-1[45] \d\d:\d\d:20\.250  error    drive B: following error", fault)
    assert re.fullmatch(r"2023-11-1[45] \d\d:\d\d:20\.000  warning  the planner has died", words)


def test_journald_is_told_the_level() -> None:
    fault, words = written("text", FAULT, to_journal=True)
    assert fault.startswith("<3>2023-11-1")
    assert words.startswith("<4>2023-11-1")


def test_journald_reads_only_the_stream_that_it_has_given(tmp_path: Path) -> None:
    """Whatever runs in a terminal of a desktop session inherits the variable of the session."""
    with socket.socket(socket.AF_UNIX) as journal, (tmp_path / "log").open("w") as file:
        status = os.fstat(journal.fileno())
        session = {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
        assert is_journal(journal.fileno(), session)
        assert not is_journal(file.fileno(), session)
        assert not is_journal(journal.fileno(), {})


def test_a_service_in_a_terminal_writes_no_priorities(tmp_path: Path) -> None:
    config = SIM.read_text().replace('"tcp/127.0.0.1:7447"', '"tls/127.0.0.1:7447"') + "\n[zenoh.tls]\n"
    (tmp_path / "no-keys.toml").write_text(config)
    command = [sys.executable, "-m", "trirail", "run", str(tmp_path / "no-keys.toml")]
    ran = subprocess.run(command, env=os.environ | {"JOURNAL_STREAM": "8:1"}, capture_output=True, check=False)
    assert b"  info     starting robot" in ran.stdout
    assert b"<6>" not in ran.stdout


def test_lines_of_json_are_the_events() -> None:
    fault, words = written("json", FAULT)
    assert msgspec.json.decode(fault, type=Event) == FAULT
    said = {"time": 1_700_000_000.0, "kind": "service", "level": "warning", "message": "the planner has died"}
    assert json.loads(words) == said


@given(st.text(max_size=50))
def test_whatever_is_said_stays_one_line(words: str) -> None:
    event = msgspec.structs.replace(FAULT, message=words)
    assert all(len(written(form, event)) == 2 for form in ("text", "json"))
    assert "\x1b" not in written("text", event)[0]


def test_a_flood_of_events_is_cut_short_and_says_so_but_errors_are_written() -> None:
    out, now = io.StringIO(), 1_700_000_000.0
    log = Log("text", out.write, clock=lambda: now)
    refused = msgspec.structs.replace(FAULT, kind="refused", level="warning", message="refused: too many")
    for seq in range(1, 60_001):  # a thousand a second
        now += 0.001
        log.event(msgspec.structs.replace(refused, seq=seq))
    assert 150 <= len(out.getvalue().splitlines()) <= 100 + 60 + 2
    log.event(msgspec.structs.replace(FAULT, seq=60_001))
    told = out.getvalue()
    assert told.splitlines()[-1].endswith("drive B: following error")
    left_out = sum(map(int, re.findall(r"(\d+) events came too quickly", told)))
    assert left_out + told.count("refused: too many") == 60_000


def test_what_comes_slowly_is_written_whole() -> None:
    out, now = io.StringIO(), 1_700_000_000.0
    log = Log("text", out.write, clock=lambda: now)
    for seq in range(1, 501):
        now += 1.0
        log.event(msgspec.structs.replace(FAULT, seq=seq, level="info"))
    assert len(out.getvalue().splitlines()) == 500


def test_a_full_disk_stops_no_robot() -> None:
    with open("/dev/full", "w") as full:
        log = Log("text", unbuffered(full))
        for _ in range(1000):
            log.log("the planner has died", "warning")
        log.close()


def test_a_reader_that_has_gone_stops_no_robot() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as nobody:
        log = Log("text", unbuffered(nobody))
        log.event(FAULT)
        log.close()


def test_what_the_output_cannot_encode_is_written_with_escapes(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w", encoding="ascii") as ascii_only:
        Log("text", unbuffered(ascii_only)).log("goal \u2192 of ann")
    assert (tmp_path / "log").read_text().endswith("goal \\u2192 of ann\n")


class Reader:
    """The end of a pipe at which a log is read, of little room."""

    def __init__(self) -> None:
        self._end, write_end = os.pipe()
        fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, 4096)
        self.output = open(write_end, "w")  # noqa: SIM115 - closed by the fixture

    def lines_until(self, last: str) -> list[str]:
        read = b""
        while not read.rstrip().endswith(last.encode()):
            read += os.read(self._end, 65_536)
        return read.decode().splitlines()

    def close(self) -> None:
        os.close(self._end)  # ends a write that is blocked
        wait_until(lambda: all(thread.name != "log" for thread in threading.enumerate()))
        self.output.close()


@pytest.fixture
def reader() -> Iterator[Reader]:
    made = Reader()
    yield made
    made.close()


def test_lines_come_in_order_and_at_once(reader: Reader) -> None:
    log = Log("text", unbuffered(reader.output))
    log.log("before the thread")
    log.start()
    log.text("as it is\n")
    log.event(FAULT)
    lines = reader.lines_until("following error")
    assert [line.rpartition("  ")[2] for line in lines] == ["before the thread", "as it is", "drive B: following error"]
    log.close()


def test_a_reader_that_hangs_blocks_nobody_and_learns_how_many_lines_it_lacks(reader: Reader) -> None:
    log = Log("text", unbuffered(reader.output))
    log.start()
    for number in range(3000):
        log.log(f"line {number}")
    *lines, told = reader.lines_until("lines of this log are missing")
    written = [line.rpartition(" ")[2] for line in lines]
    assert written == [str(number) for number in range(len(written))]
    assert MAX_WAITING <= len(written) < 3000
    assert told.endswith(f"warning  the output was blocked: {3000 - len(written)} lines of this log are missing")
    log.log("again")
    assert len(reader.lines_until("again")) == 1
    log.close()


def test_the_end_writes_what_waits_and_does_not_wait_for_a_reader_that_hangs(
    reader: Reader, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_log, "FLUSH_WITHIN", WITHIN)
    out = io.StringIO()
    log = Log("text", out.write)
    log.start()
    for number in range(100):
        log.log(f"line {number}")
    log.close()
    assert len(out.getvalue().splitlines()) == 100
    monkeypatch.setattr(service_log, "FLUSH_WITHIN", 0.1)
    log = Log("text", unbuffered(reader.output))
    log.start()
    log.text("x" * 100_000)
    log.close()
