"""`trirail commission`, called as from a terminal: answers from standard input, what it refuses, what it leaves."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from trirail.cli import commission
from trirail.cli.app import app
from trirail.commissioning.bench import Bench
from trirail.commissioning.person import Question, QuitRequest
from trirail.config import SIM, load
from trirail.errors import ConfigError
from trirail_drivers.errors import BusError, FileError
from trirail_drivers.interface import Feedback, PowerState, Triple
from trirail_drivers.simulated.faultlines import FaultSyntaxError

PUSH = ["", "0.01", "0", "10", "0"]
"""Answers to the step of the first slider by hand."""


def run(*words: str) -> int:
    return int(app(["commission", *words], result_action="return_value") or 0)


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "robot.toml"
    path.write_text(SIM.read_text(encoding="utf-8"), encoding="utf-8")
    return str(path)


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Return where lines of a script can be written, for standard input."""
    reading, writing = os.pipe()
    with os.fdopen(reading) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield writing
    with contextlib.suppress(OSError):  # where the test has not
        os.close(writing)


def test_a_scripts_lines_are_the_answers_and_its_end_leaves(
    robot: str, typed: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.write(typed, "\n".join(["", "", *PUSH, "s"]).encode() + b"\n")
    os.close(typed)
    assert run(robot, "--fault", "A reversed", "--json", "--report", "first.json") == 1
    told = capsys.readouterr()
    report = json.loads(told.out)
    assert json.loads((tmp_path / "first.json").read_text()) == report
    assert [(step["step"], step["drive"], step["verdict"]) for step in report["steps"]] == [
        ("bus", "", "ok"),
        ("setup", "", "ok"),
        ("push", "A", "wrong"),
    ]
    assert report["changes"] == {"drives.A.direction": -1}
    assert "wrong direction" in told.err
    assert (tmp_path / report["written"]).name == "robot-commissioned.toml"
    assert Path(robot).read_text(encoding="utf-8") == SIM.read_text(encoding="utf-8")


def test_a_file_that_begins_with_a_byte_order_mark_is_corrected_too(robot: str, typed: int) -> None:
    Path(robot).write_text(SIM.read_text(encoding="utf-8"), encoding="utf-8-sig")  # as editors of Windows write it
    os.write(typed, "\n".join(["", "", *PUSH, "s"]).encode() + b"\n")
    os.close(typed)
    assert run(robot, "--fault", "A reversed", "--out", "new.toml") == 1
    assert load(Path("new.toml")).drives.A.direction == -1


def test_what_is_refused_step_by_step_leaves_nothing_wrong(
    robot: str, typed: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.write(typed, b"\n\n" + b"s\n" * 20)
    os.close(typed)
    assert run(robot, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["ok"], report["complete"], report["written"]) == (True, False, None)
    assert {step["verdict"] for step in report["steps"][2:]} == {"skipped"}
    assert len(list(tmp_path.glob("commission-demo-*.json"))) == len(list(tmp_path.glob("commission-demo-*.txt"))) == 1


@pytest.mark.parametrize("answers", [b"", b"q\n", b"\n\nq\n", b"\n\ns\n", b"s\n" * 30])
def test_a_guide_that_was_left_or_of_which_no_step_was_run_is_no_success(
    robot: str, typed: int, capsys: pytest.CaptureFixture[str], answers: bytes
) -> None:
    """By a person, or because the lines of a script have ended."""
    os.write(typed, answers)
    os.close(typed)
    assert run(robot, "--json") == 1
    report = json.loads(capsys.readouterr().out)
    assert (report["ok"], report["complete"]) == (False, False)


def test_values_that_the_other_keys_forbid_are_told_and_reported(
    robot: str, typed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(robot).write_text(SIM.read_text(encoding="utf-8").replace("= 1e7", "= 1e6"), encoding="utf-8")
    os.write(typed, "\n".join(["", "", *PUSH, "s"]).encode() + b"\n")
    os.close(typed)
    assert run(robot, "--fault", "A scale 40", "--json") == 1  # three counts are more than the in-position window
    told = capsys.readouterr()
    report = json.loads(told.out)
    assert (report["changes"], report["written"]) == ({"drives.A.counts_per_metre": 25000.0}, None)
    assert "limits.in_position.sliders[0]" in " ".join(told.err.split())


def test_back_leads_past_steps_that_cannot_run(robot: str, typed: int, capsys: pytest.CaptureFixture[str]) -> None:
    os.write(
        typed, b"\n\n" + b"s\n" * 6 + b"b\nq\n"
    )  # nothing has had power, so no drive may move: b from the switches
    os.close(typed)
    assert run(robot) == 1, "the person has quit"
    assert re.findall(r"^\d+/\d+  (.*)$", capsys.readouterr().out, re.MULTILINE)[-2:] == [
        "Switches of slider A",
        "Power on drive C alone",
    ]


@pytest.mark.parametrize("done", [[], ["bus"], ["bus", "setup"]], ids=["at once", "before set-up", "afterwards"])
@pytest.mark.long
def test_ctrl_c_ends_it_and_the_report_stays(
    done: list[str],
    robot: str,
    typed: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    os.write(typed, b"\n" * len(done))
    ask, questions = commission.Console.ask, []

    def press(self: commission.Console, question: Question, idle: Callable[[], object]) -> str:
        questions.append(question)
        if len(questions) > len(done):
            signal.raise_signal(signal.SIGINT)
        return ask(self, question, idle)

    monkeypatch.setattr(commission.Console, "ask", press)
    with pytest.raises(SystemExit, match="130"):
        run(robot, "--report", "r.json", "--json")
    report, printed = tmp_path / "r.json", capsys.readouterr().out
    assert (json.loads(printed) if printed else None) == (json.loads(report.read_text()) if report.exists() else None)
    assert [step["step"] for step in (json.loads(report.read_text())["steps"] if report.exists() else [])] == done
    assert bool(done) == report.exists() == report.with_suffix(".txt").exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", [signal.SIGQUIT, signal.SIGTSTP, signal.SIGHUP], ids=lambda number: number.name)
def test_a_signal_that_ends_or_suspends_a_process_stops_the_drives_first(
    number: signal.Signals, robot: str, typed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-\\, Ctrl-Z, and a terminal that is closed, in the step in which drive A has power alone."""
    os.write(typed, b"\n\ns\ns\ns\n\nq\n")
    cycle, powered = Bench.cycle, list[Bench]()

    def press(self: Bench, *rates: Triple) -> Feedback:
        feedback = cycle(self, *rates)
        if feedback.state[0] is PowerState.OPERATION_ENABLED and not powered:
            powered.append(self)
            assert {signal.getsignal(background) for background in (signal.SIGTTIN, signal.SIGTTOU)} == {signal.SIG_IGN}
            signal.raise_signal(number)
        return feedback

    def harmless(*_: object) -> None:
        """Replace the default, which would end this process, or suspend it."""

    monkeypatch.setattr(Bench, "cycle", press)
    before = signal.signal(number, harmless)
    try:
        with pytest.raises(SystemExit, match="130"):
            run(robot, "--report", "r.json")
        assert signal.getsignal(number) is harmless
    finally:
        signal.signal(number, before)
    assert powered[0].power_warning == ""
    last = json.loads((tmp_path / "r.json").read_text())["steps"][-1]
    assert (last["step"], last["drive"], last["verdict"]) == ("power", "A", "failed")


def test_a_command_that_failed_before_its_first_step_can_be_run_again(robot: str, tmp_path: Path) -> None:
    for failure in (("--fault", "A reverse"), ("--fault", "A loose, rubbish")):
        for _ in range(2):
            with pytest.raises(FaultSyntaxError):
                run(robot, "--yes", *failure, "--report", "r.json")
    bus = tmp_path / "bus.toml"
    text = SIM.read_text(encoding="utf-8")
    bus.write_text(text.replace('interface = "simulated"', 'interface = "socketcan"\nchannel = "none0"'))
    for _ in range(2):
        with pytest.raises(BusError):
            run(str(bus), "--report", "r.json")
    assert not list(tmp_path.glob("r.*"))


def test_what_cannot_be_is_refused_before_anything_is_asked(robot: str, tmp_path: Path) -> None:
    (tmp_path / "precious.toml").write_text("precious")
    with pytest.raises(ConfigError, match=r"precious\.toml already exists; choose another file with --out"):
        run(robot, "--out", "precious.toml")
    with pytest.raises(ConfigError, match=r"absent/new\.toml: there is no folder absent"):
        run(robot, "--out", "absent/new.toml")
    with pytest.raises(FileError, match=r"precious\.toml already exists; choose another file with --report"):
        run(robot, "--report", "precious.toml")
    (tmp_path / "notes.txt").write_text("precious")
    with pytest.raises(FileError, match=r"notes\.txt already exists; choose another file with --report"):
        run(robot, "--report", "notes.json")
    with pytest.raises(FileError, match=r"one\.txt is the name of the text version"):
        run(robot, "--report", "one.txt")
    with pytest.raises(FaultSyntaxError, match="did you mean reversed"):
        run(robot, "--yes", "--fault", "A reverse", "--report", "a.json")
    real = tmp_path / "real.toml"
    real.write_text(SIM.read_text(encoding="utf-8").replace('interface = "simulated"', 'interface = "socketcan"'))
    for option in (["--yes"], ["--fault", "A loose"]):
        with pytest.raises(ConfigError, match=f"{option[0]} is only for simulated drives"):
            run(str(real), *option)
    assert (tmp_path / "precious.toml").read_text() == (tmp_path / "notes.txt").read_text() == "precious"


@pytest.mark.parametrize(
    ("written", "answers"),
    [
        (b"a\nb", ["a", "b"]),
        (b"\n\n", ["default", "default"]),
        (b" x \xff\n", ["x \N{REPLACEMENT CHARACTER}"]),
        (b"", []),
    ],
)
def test_lines_are_answers_and_the_end_is_none(typed: int, written: bytes, answers: list[str]) -> None:
    os.write(typed, written)
    os.close(typed)
    person = commission.Console(by_itself=False, quiet=True)
    found = [person.ask(Question("?", "default"), lambda: None) for _ in answers]
    assert found == answers
    with pytest.raises(QuitRequest):
        person.ask(Question("?", "default"), lambda: None)


def test_the_drives_are_kept_alive_while_somebody_thinks(typed: int) -> None:
    person = commission.Console(by_itself=False, quiet=True)
    turned: list[int] = []

    def idle() -> None:
        turned.append(len(turned))
        if len(turned) == 5:
            os.write(typed, b"7\n")

    assert person.ask(Question("?"), idle) == "7"
    assert turned == [0, 1, 2, 3, 4]
