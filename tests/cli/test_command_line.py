"""The manners of the command line: pages of help, errors, tab completion, and what is said where nobody answers."""

from __future__ import annotations

import errno
import io
import itertools
import json
import os
import queue
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import made
import msgspec
import pytest
from cyclopts import App
from generated import thinned
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from trirail import __main__
from trirail.cli import app, help_pages, live, notation, recording_commands, stop_commands, terminal, view
from trirail.client import client, connection, new_stop
from trirail.client.goal import Result
from trirail.config import SIM, load
from trirail.errors import RefusalCode, RefusedError, ServiceError
from trirail.telemetry import contents
from trirail.telemetry.reading import read
from trirail.telemetry.recorder import Recorder
from trirail.telemetry.retention import MAGIC
from trirail.wire.goal_kind import GoalKind, field_description
from trirail.wire.goals import MoveGoal, PoseGoal, SlidersGoal, TrajectoryGoal, VelocityGoal
from trirail.wire.messages import GoalReply, Outcome
from trirail.wire.state import NamedPose
from trirail.wire.text import json_printable
from trirail.wire.vocabulary import Command
from waiting import WITHIN

Run = Callable[..., tuple[int, str, str]]
NOBODY = "tcp/127.0.0.1:1"


def pages(app: App = app.app, *path: str) -> Iterator[tuple[str, App]]:
    """Yield every command with what is typed to call it."""
    for name in app:
        if not name.startswith("-"):
            if app[name].default_command is not None or not path:
                yield " ".join((*path, name)), app[name]
            yield from pages(app[name], *path, name)


def test_every_command_is_in_a_group_with_examples_that_can_be_typed() -> None:
    listed = [name for group in help_pages.GROUPS.values() for name in group]
    assert sorted(listed) == sorted(name for name, _ in pages() if " " not in name and name != "help")
    for group in help_pages.GROUPS.values():
        for name, examples in group.items():
            assert examples
            for line in examples:
                program, command, *words = shlex.split(line)
                assert (program, command) == ("trirail", name)
                app.app.parse_args(notation.numbers([command, *words]), exit_on_error=False, print_error=False)


@pytest.mark.parametrize(("name", "page"), list(pages()))
def test_every_argument_is_described(name: str, page: App, run: Run) -> None:
    for argument in page.assemble_argument_collection(parse_docstring=True) if page.default_command else ():
        if argument.show:
            assert argument.parameter.help, f"{name} {argument.name}"


@pytest.mark.parametrize(
    ("command", "kind"),
    [
        ("goto", PoseGoal),
        ("move", MoveGoal),
        ("sliders", SlidersGoal),
        ("jog", VelocityGoal),
        ("follow", TrajectoryGoal),
    ],
)
def test_an_option_of_a_goal_is_described_as_its_field_is(command: str, kind: type[GoalKind]) -> None:
    page = dict(pages())[command]
    told = {
        argument.name.removeprefix("--"): argument.parameter.help
        for argument in page.assemble_argument_collection(parse_docstring=True)
    }
    for field in {"speed", "blend", "tool", "frame", "stretch"} & set(told):
        assert str(told[field]).lower().startswith(field_description(kind, field).lower())


def test_help_shows_groups_and_examples(run: Run) -> None:
    code, out, _ = run("--help")
    assert code == 0
    titles = [out.index(f"─ {name} ─") for name in help_pages.GROUPS if name != "Mathematics"]
    assert titles == sorted(titles)
    assert "trirail goto 30mm 20mm 10deg --wait" in run("goto", "--help")[1]


def test_what_is_seldom_needed_is_on_the_page_of_all_alone(run: Run) -> None:
    names = {name for group in help_pages.GROUPS.values() for name in group}
    assert set(help_pages.ADVANCED_COMMANDS) < names
    for line, shown in (("--help", names - {*help_pages.ADVANCED_COMMANDS}), ("help all", names), ("help", None)):
        code, out, _ = run(*line.split())
        found = {line.split()[1] for line in out.splitlines() if line.startswith("│ ") and line[2].isalpha()}
        assert code == 0
        assert found & names == (shown if shown is not None else names - {*help_pages.ADVANCED_COMMANDS})
    lines = run("--help")[1].splitlines()
    assert not [line for line in lines if line.startswith("│   ")]  # each command takes one line
    assert run("help", "keys", "add")[1] == run("keys", "add", "--help")[1]
    assert "Unknown command" in run("help", "nonsense")[2]


@given(
    st.lists(st.sampled_from(["10mm", "-20", "5deg", "0.5", "-.1e-3", "1in"]), min_size=3, max_size=3),
    st.sampled_from([" ", ",", ", ", ";", "; "]),
    st.sampled_from(notation.OF_THREE),
)
def test_three_numbers_may_have_commas_between(numbers: list[str], between: str, command: str) -> None:
    assert notation.spread([command, *between.join(numbers).split()]) == [command, *numbers]


@pytest.mark.parametrize(
    "line", ["goto 10,5 20 3", "goto pick", "goto a,b,c", "goto 1 2 3 --tool 20,0", "export x --columns 1,2,3", ""]
)
def test_nothing_else_is_read_otherwise_for_its_commas(line: str) -> None:
    assert notation.spread(line.split()) == line.split()


@pytest.mark.long
@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("status --connect nowhere", "a locator is protocol/address, such as tcp/192.168.1.7:7447"),
        ("status --connect tcp/127.0.0.1:x", "no service at tcp/127.0.0.1:x"),
        (f"watch --connect {NOBODY}", f"no service at {NOBODY}"),
        ("status --robot a/b", "robot 'a/b' is not a valid name"),
        ("status --robot *", "robot '*' is not a valid name"),
        ("view no.rrd", "no.rrd is not a file"),
        ("report no.rrd", "no.rrd: No such file or directory"),
        ("replay no.rrd", "no.rrd: No such file or directory"),
        ("run no.toml", "no.toml: No such file or directory"),
        ("follow no.csv", "no.csv: No such file or directory"),
        ("config copy nothing", "no configuration 'nothing' is shipped"),
        ("ik 0 0 0 --config no.toml", "no.toml: No such file or directory"),
        ("goto 0 0 0 --connect nowhere", "a locator is protocol/address"),
    ],
)
def test_what_is_not_there_is_one_line_and_with_json_one_object(line: str, said: str, run: Run) -> None:
    code, out, err = run(*line.split())
    assert (code, out) == (1, "")
    assert said in err
    assert err.count("\n") == 1
    if "follow" in line or "status" in line or "report" in line:
        code, out, err = run(*line.split(), "--json")
        assert (code, err) == (1, "")
        assert out.count("\n") == 1
        found = json.loads(out)
        assert found["ok"] is False
        assert said in found["message"]


NO_FILE = "n" * 300
"""Name that no file can have: the operating system refuses to look for it."""


@pytest.mark.parametrize(
    "line",
    [
        f"view {NO_FILE}",
        f"sessions {NO_FILE}",
        f"report {NO_FILE}",
        f"replay {NO_FILE}",
        f"export {NO_FILE}",
        f"run {NO_FILE}",
        f"doctor {NO_FILE} --quick",
        f"follow {NO_FILE}",
        f"config show {NO_FILE}",
        f"ik 0 0 0 --config {NO_FILE}",
        f"panel --token {NO_FILE}",
    ],
)
def test_an_error_of_the_operating_system_is_one_line_with_the_file_and_the_reason(line: str, run: Run) -> None:
    for words in (line.split(), [*line.split(), "--json"]):
        code, out, err = run(*words)
        if code == 2 and "--json" in words:  # not a command with this option
            continue
        said = json.loads(out)["message"] if "--json" in words and out else err
        assert code == 1
        assert f"{NO_FILE[:200]}" in said
        assert "File name too long" in said
        assert (out + err).count("\n") == 1


@pytest.mark.parametrize("name", ["", ".", "..", "/"])
@pytest.mark.parametrize("command", ["view", "report", "replay", "export", "run", "follow"])
def test_a_folder_in_the_place_of_a_file_is_an_error_in_one_line(command: str, name: str, run: Run) -> None:
    """Such as the empty value of a variable of the shell."""
    code, out, err = run(command, name)
    assert (code, out, err.count("\n")) == (1, "", 1), err


def test_a_folder_that_cannot_be_read_is_not_an_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    def refuse(folder: str) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(folder))

    for function in ("listdir", "scandir"):
        monkeypatch.setattr(os, function, refuse)
    assert run("sessions", str(tmp_path)) == (1, "", f"trirail: {tmp_path}: Permission denied\n")


@pytest.mark.parametrize("columns", thinned(["0", "1"]))
@pytest.mark.parametrize(("line", "said"), [("fk 0 0 0", "φ"), ("fk 9 9 9", "out of reach"), ("fk --help", "Usage")])
def test_every_command_speaks_if_the_terminal_is_said_to_have_no_columns(line: str, said: str, columns: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "trirail", *line.split()], capture_output=True, text=True,
        env=os.environ | {"COLUMNS": columns, "LINES": columns}, check=False, timeout=WITHIN,
    )  # fmt: skip
    assert said in done.stdout + done.stderr


@pytest.mark.parametrize("line", ["fk 0 0 0", "fk 0 0 0 --json", "fk 9 9 9 --json", "help all", "completion bash"])
@pytest.mark.parametrize("unbuffered", thinned(["", "1"]))
def test_output_to_a_full_disk_is_an_error_in_one_line(line: str, unbuffered: str) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "trirail", *line.split()], stdout=full, stderr=subprocess.PIPE, text=True,
            env=os.environ | {"PYTHONUNBUFFERED": unbuffered}, check=False,
        )  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    told = "out of reach" if " 9 " in line else "trirail: standard output: No space left on device"
    assert told in done.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        ("goto ../../etc", 1, "pose '../../etc' is not a valid name; use at most 64 letters, digits, - and _"),
        ("goto a/b", 1, "letters, digits, - and _"),
        ("goto 5mm", 2, "goto takes X, Y and PHI, or the NAME of a pose"),
        ("goto 5mm 0", 2, "goto takes X, Y and PHI, but only X = 5mm and Y = 0.000 mm are given: add the angle PHI"),
        ("acquire --timeout 60s", 2, "--timeout: 60 s: use 0.1 to 10 s"),
        ("teach 5mm", 1, "pose '5mm' reads as a number or a quantity"),
        ("teach 10", 1, "pose '10' reads as a number or a quantity"),
        ("goto 0 0 0 --speed 50", 2, "--speed: '50' is not a share of the limits: use 0.001 to 1, or 0.1% to 100%"),
        ("move 0 0 0 --speed 0", 2, "--speed: '0' is not a share of the limits"),
        ("sliders 0 0 0 --speed x", 2, "--speed: 'x' is not a share of the limits"),
        ("goto 0 0 0 4 5", 2, "trirail: 4 5 are more than the command takes (trirail goto --help shows the usage)"),
        ("enable now", 2, "trirail: now is more than the command takes (trirail enable --help shows the usage)"),
        (
            "workspace my.toml",
            2,
            "trirail: my.toml is more than the command takes: a configuration is --config my.toml "
            "(trirail workspace --help shows the usage)",
        ),
        (
            "enable my.toml",
            2,
            "trirail: my.toml is more than the command takes (trirail enable --help shows the usage)",
        ),
        ("goto 0,5 0 0", 2, ": write 0.5 with a decimal point"),
        ("goto -12,5mm 0 0", 2, ": write -12.5 with a decimal point"),
        ("override 12,5", 2, ": write 12.5 with a decimal point"),
        ("goto 0 0 0 --blend -1mm", 2, "--blend: '-1mm' is negative: use a length such as 5mm"),
        ("jog 1mm/s 0 0 --seconds -1", 2, "--seconds: '-1' is negative: use a time such as 2s"),
        ("override 300", 2, "'300' is not an override: use 0, or 1 to 200 %"),
        ("override 0.5%", 2, "'0.5%' is not an override: use 0, or 1 to 200 %"),
        ("sessions --since yesterday", 2, "'yesterday' is not a day or time such as 2026-01-31 or 2026-01-31T12:00:00"),
        (
            f"stop --connect {NOBODY}",
            1,
            f"no service at {NOBODY}: connection refused; start trirail run or zenohd there"
            ", or name another address with --connect (in Python connect=)",
        ),
        ("stop --connect tcp/127.0.0.1", 1, "the port is missing: an endpoint is protocol/address"),
        ("stop --connect tcp/no..name:1", 1, "invalid host name; start trirail run or zenohd there"),
        ("stop --connect tcp/127.0.0.1", 1, "no service at tcp/127.0.0.1: the port is missing"),
    ],
)
def test_what_is_typed_wrongly_is_told_with_what_would_be_right(line: str, code: int, said: str, run: Run) -> None:
    assert run(*line.split())[:2] == (code, "")
    assert said in run(*line.split())[2]
    ended, out, err = run(*line.split(), "--json")
    assert (ended, err) == (code, "")
    answer = json.loads(out)
    assert answer["ok"] is False
    assert said.removeprefix("trirail: ") in answer["message"]


@pytest.mark.parametrize("command", thinned(["stop", "status", "fleet", "view --web"], every=4))
@pytest.mark.long
def test_a_folder_of_the_environment_is_for_certificates_alone(
    command: str, run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TRIRAIL_TLS", str(tmp_path / "keys"))
    assert f"no service at {NOBODY}" in run(*command.split(), "--connect", NOBODY)[2]
    assert f"{tmp_path}/keys/ca.pem" in run(*command.split(), "--connect", "tls/127.0.0.1:1")[2]


class Slow:
    """A robot that takes what it is sent, and so many times slower."""

    def __init__(self, slowed: float) -> None:
        self.id, self.name, self.duration, self.error = "g-1", "demo", 1.0, None
        self.reply, self.result = GoalReply("g-1", 1.0, slowed), Result("g-1", "done", "goal g-1 done")
        self.move = self.move_to = self.move_to_named = self.move_sliders = self.follow = self.jog = lambda *_, **__: (
            self
        )

    def __enter__(self) -> Slow:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def states(self, timeout: float) -> Iterator[SimpleNamespace]:
        yield SimpleNamespace(goal=None)

    def info(self) -> SimpleNamespace:
        return SimpleNamespace(limits=msgspec.to_builtins(load(SIM).limits), labels=("A", "B", "C"))


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("jog 0.01 0 0", "slowed 40 times, to keep within the limits"),
        ("goto 0 0 0 --wait", "slowed 40 times"),
        ("goto pick --wait", "slowed 40 times"),
        ("move 0 0 0 --wait", "slowed 40 times"),
        ("sliders 0 0 0 --wait", "slowed 40 times"),
    ],
)
def test_what_is_slowed_is_said_beside_its_end_and_with_json_a_field(
    line: str, said: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "table", lambda *_: "")
    monkeypatch.setattr(client, "Robot", lambda *_, **__: Slow(40.0))
    code, out, err = run(*line.split())
    assert (code, err.count("\n")) == (0, 1)
    assert said in err
    assert "goal g-1 done" in out
    code, out, err = run(*line.split(), "--json")
    assert (code, err, json.loads(out)["slowed"]) == (0, "", 40.0)
    monkeypatch.setattr(client, "Robot", lambda *_, **__: Slow(1.0))
    assert run(*line.split())[2] == ""


class Unanswered(Slow):
    """A robot whose answer to a jog does not come before Ctrl-C."""

    def __init__(self) -> None:
        super().__init__(1.0)
        self.reply = self.result = None  # type: ignore[assignment]
        self.opened = False

    def __enter__(self) -> Slow:
        if self.opened:
            raise KeyboardInterrupt
        self.opened = True
        return self


def test_ctrl_c_before_a_jog_is_accepted_is_a_line(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "Robot", lambda *_, **__: Unanswered())
    assert run("jog", "0.01", "0", "0") == (1, "the jog has no known end\n", "")


def test_what_is_not_utf_8_is_refused_in_a_line(run: Run) -> None:
    not_utf_8 = os.fsdecode(b"\xff")
    assert "not a goal" in run("goal", f'{{"kind": "{not_utf_8}"}}', "--connect", NOBODY)[2]
    message = json.loads(run("follow", f"{not_utf_8}.csv", "--json")[1])["message"]
    assert message.startswith(f"{not_utf_8}.csv: No such file")


@given(st.floats(120.0, 1e6))
@example(179.7)
def test_a_report_has_no_minute_of_sixty_seconds(time: float) -> None:
    minutes, _, seconds, _ = recording_commands._seconds(time).split()
    assert int(seconds) < 60
    assert abs(60 * int(minutes) + int(seconds) - time) <= 0.5


WRONG = ["report", "replay", "goto", "goto 1 2", "nothing", "watch extra", "status --wat", "config wat"]


@pytest.mark.parametrize("line", WRONG)
def test_wrong_usage_is_one_line_and_exit_2(line: str, run: Run) -> None:
    code, out, err = run(*line.split())
    assert (code, out) == (2, "")
    assert err.count("\n") == 1


def test_a_refusal_is_json_with_its_code_and_what_is_allowed(capsys: pytest.CaptureFixture[str]) -> None:
    terminal.print_error_json(RefusedError(RefusalCode.OUT_OF_WORKSPACE, "x: 0.5 m", slider="A", value=0.5, limit=0.15))
    assert json.loads(capsys.readouterr().out) == {
        "ok": False,
        "error": "RefusedError",
        "code": "out_of_workspace",
        "message": "x: 0.5 m",
        "slider": "A",
        "value": 0.5,
        "limit": 0.15,
    }
    terminal.print_error_json(ServiceError("no robot"))
    assert json.loads(capsys.readouterr().out) == {"ok": False, "error": "ServiceError", "message": "no robot"}


def test_a_viewer_that_finds_no_display_is_an_error(monkeypatch: pytest.MonkeyPatch, run: Run, tmp_path: Path) -> None:
    """Rerun's viewer says so and exits with 0."""
    file = tmp_path / "empty.rrd"
    file.write_bytes(MAGIC + bytes(8))
    monkeypatch.setenv("DISPLAY", ":77")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(view, "python", lambda *_: [sys.executable, "-c", "print('Error: no X server')"])
    code, _, err = run("view", str(file))
    assert code == 1
    assert "the viewer failed: Error: no X server" in err


def test_the_banner_names_the_next_command_where_it_reaches_the_service(capsys: pytest.CaptureFixture[str]) -> None:
    ready: dict[str, dict[str, Any]] = {
        "loop": {"lacking": [], "bus_load": 0.5},
        "recorder": {"live": "", "recording": "x.rrd"},
        "gateway": {"warnings": []},
    }
    config = load(SIM)
    terminal.up(config, ready)
    assert "next       trirail enable\n" in capsys.readouterr().out
    zenoh = msgspec.structs.replace(config.zenoh, listen=("tcp/0.0.0.0:7999",))
    robot = msgspec.structs.replace(config.robot, name="left")
    terminal.up(msgspec.structs.replace(config, zenoh=zenoh, robot=robot), ready)
    said = capsys.readouterr().out
    assert "next       trirail enable --robot left --connect tcp/127.0.0.1:7999\n" in said


def test_the_banner_says_how_much_of_the_bus_is_used_and_why_setpoints_are_short(
    capsys: pytest.CaptureFixture[str],
) -> None:
    ready: dict[str, dict[str, Any]] = {
        "loop": {"lacking": [], "bus_load": 0.786},
        "recorder": {"live": "", "recording": "x.rrd"},
        "gateway": {"warnings": []},
    }
    config = load(SIM)
    fast = msgspec.structs.replace(config, loop=msgspec.structs.replace(config.loop, rate_hz=1250))
    can = msgspec.structs.replace(config.can, interface="socketcan", channel="can0")
    terminal.up(msgspec.structs.replace(fast, can=can), ready)
    said = capsys.readouterr().out
    assert "bus load   1.25 kHz uses 79 % of can0\n" in said
    assert "warning setpoints without velocity offset (4 bytes), because 8 bytes would use 94 %\n" in said
    terminal.up(config, ready)
    assert "velocity offset" not in capsys.readouterr().out


def test_who_asks_for_a_command_that_there_is_not_is_led_to_the_list_of_them(run: Run) -> None:
    code, _, err = run("dance")
    assert code == 2
    assert err.endswith("(trirail --help shows the usage)\n")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
@pytest.mark.long
def test_the_completion_script_knows_commands_and_options(shell: str, run: Run) -> None:
    code, out, err = run("completion", shell)
    assert (code, err) == (0, "")
    for word in ("quick-stop", "override", "robot", "blend"):
        assert word in out


def test_bash_completes_commands_options_and_robots(run: Run) -> None:
    _, script, _ = run("completion", "bash")
    asks = """
trirail() { [ "$1" = __complete ] && printf '\\x1fbegin\\nleft\\nright\\n'; }
type() { return 0; }
complete_words() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=(); _trirail; echo "${COMPREPLY[@]}"; }
complete_words trirail qui
complete_words trirail goto --bl
complete_words trirail status --robot l
"""
    done = subprocess.run(
        ["bash", "--norc"], input=script + asks, capture_output=True, text=True, timeout=300, check=True
    )
    assert done.stdout.splitlines() == ["quick-stop", "--blend", "left"]


def test_the_names_of_robots_are_asked_for_where_the_line_says(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    monkeypatch.setattr(connection, "robots_at", lambda connect: [f"at-{connect}"])
    code, out, _ = run("__complete", "status", "--connect", "tcp/1.2.3.4:5", "--robot", "")
    assert code == 0
    assert out.splitlines()[-1] == "at-tcp/1.2.3.4:5"


class Known:
    """A robot that knows poses, tools and frames; stands in for the client."""

    def __init__(self, robot: str, connect: str, tls: object) -> None:
        assert (robot, connect, tls) == ("left", "tcp/1.2.3.4:5", None)

    def __enter__(self) -> Known:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def poses(self) -> dict[str, NamedPose]:
        return {name: NamedPose(name, 0.0, 0.0, 0.0, taught=name != "park") for name in ("park", "pick", "place")}

    def info(self) -> SimpleNamespace:
        return SimpleNamespace(frames={"tool": {"camera": [0.02, 0.0]}, "work": {"part": [0.1, 0.0, 0.0]}})


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ("goto", ["park", "pick", "place"]),
        ("forget", ["pick", "place"]),
        ("goto 0 0 0 --tool", ["camera"]),
        ("move 0 0 0 --tool", ["camera"]),
        ("goto 0 0 0 --frame", ["base", "part"]),
        ("move 0 0 0 --frame", ["base", "platform", "part"]),
    ],
)
def test_the_names_that_a_robot_knows_are_completed(
    monkeypatch: pytest.MonkeyPatch, run: Run, words: str, names: list[str]
) -> None:
    monkeypatch.setattr(client, "Robot", Known)
    command, *rest = words.split()
    code, out, _ = run("__complete", command, "--robot", "left", "--connect", "tcp/1.2.3.4:5", *rest, "")
    assert code == 0
    assert out.splitlines()[-len(names) :] == names


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
@pytest.mark.parametrize("command", ["goto", "forget"])
def test_each_shell_asks_for_the_names_of_poses(shell: str, command: str, run: Run, tmp_path: Path) -> None:
    """In the shell itself where there is one: with a program in the place of trirail, that is asked and answers."""
    if shutil.which(shell) is None:
        pytest.skip(f"needs {shell}")
    _, script, _ = run("completion", shell)
    (tmp_path / f"completion.{shell}").write_text(script)
    answer = tmp_path / "trirail"
    answer.write_text("#!/bin/sh\n[ \"$1\" = __complete ] && printf '\\037begin\\nparked\\npicked\\n'\n")
    answer.chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(
        [shell, *NO_START_FILES[shell]],
        input=COMPLETES[shell].format(file=tmp_path / f"completion.{shell}", line=f"trirail {command} p"),
        env=environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert {"parked", "picked"} <= set(done.stdout.split()), done.stdout + done.stderr


NO_START_FILES = {"bash": ["--norc"], "zsh": ["-f"], "fish": ["--no-config"]}
COMPLETES = {
    "bash": "source {file}\nCOMP_WORDS=({line})\nCOMP_CWORD=2\n_trirail\necho ${{COMPREPLY[@]}}\n",
    "fish": "source {file}\ncomplete --do-complete '{line}'\n",
    # zsh completes in a terminal alone: it is enough that its script asks for what follows the command.
    "zsh": "grep -A40 'goto)' {file} | grep -q __complete && echo parked picked # {line}\n",
}


class Interrupted:
    """A robot and its goal under way, while Ctrl-C is pressed a number of times; it ends once it is told to stop."""

    def __init__(self, presses: int, heard: bool) -> None:
        self.id, self.reply, self.name = "g-1", GoalReply("g-1", 1.0), "demo"
        self.result: Result | None = None
        self._left, self._heard = presses, heard
        self.cancelled = threading.Event()

    def cancel(self) -> None:
        if self._heard:
            self.result = Result("g-1", "stopped", "stopped as asked")
        self.cancelled.set()

    def states(self, timeout: float) -> Iterator[SimpleNamespace]:
        while True:
            yield SimpleNamespace(goal=None, seq=1)
            if self.cancelled.is_set() or self._left == 2:
                self._press()
            elif self._left == 1:
                self._press()
                assert self.cancelled.wait(60.0)

    def _press(self) -> None:
        if self._left:
            self._left -= 1
            raise KeyboardInterrupt


def test_ctrl_c_stops_the_goal_that_is_waited_for() -> None:
    goal: Any = Interrupted(presses=1, heard=True)
    assert terminal.follow(goal, goal, "away", show=False) == Result("g-1", "stopped", "stopped as asked")


def test_a_second_ctrl_c_leaves_and_says_that_the_goal_goes_on() -> None:
    goal: Any = Interrupted(presses=2, heard=False)
    with pytest.raises(ServiceError, match="goal g-1 may still be running"):
        terminal.follow(goal, goal, "away", show=False)
    assert goal.cancelled.wait(60.0)


def test_a_goal_of_a_service_that_has_restarted_is_waited_for_no_longer() -> None:
    states = (SimpleNamespace(goal=None, seq=seq) for seq in (900, 920, 20, 40))
    robot: Any = SimpleNamespace(name="demo", states=lambda _: states)
    goal: Any = SimpleNamespace(id="g-1", reply=GoalReply("g-1", 1.0), result=None)
    with pytest.raises(ServiceError, match="the service has restarted: the end of goal g-1 is unknown"):
        terminal.follow(robot, goal, "away", show=False)


@pytest.mark.parametrize("starter", ["", "signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())"])
def test_ctrl_c_while_a_command_is_loaded_ends_it_without_a_word(starter: str) -> None:
    """Whatever signals the program that has started it blocks: a service could not be ended otherwise."""
    loading = (
        f"import signal, sys, os\n{starter}\n"
        "class Loading:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'cyclopts': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Loading())\n"
        "from trirail.__main__ import main\n"
        "main()\n"
    )
    ended = subprocess.run([sys.executable, "-c", loading], capture_output=True, check=False, timeout=300)
    assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGINT, b"", b"")


def test_a_command_draws_though_the_shell_switches_rerun_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Views, demos and recordings would be empty. Such a shell is made for other programs."""
    path = tmp_path / "made.rrd"

    def command(*_: object, **__: object) -> int:
        recorder = Recorder(load(SIM), tmp_path, path=path, live=False)
        recorder.records(made.records(0.1).tobytes())
        recorder.close()
        return 0

    monkeypatch.setenv("RERUN", "off")
    monkeypatch.setattr(app, "app", command)
    monkeypatch.setattr(sys, "argv", ["trirail", "view"])
    with pytest.raises(SystemExit):
        app.main()
    assert len(read(path).records) == 100


def test_a_number_of_things_is_said_as_people_say_it() -> None:
    assert [terminal.counted(number, "robot") for number in (0, 1, 2)] == ["0 robots", "1 robot", "2 robots"]


def test_watch_into_a_pipe_is_a_line_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing can be drawn anew there, and what is drawn at the end never comes."""
    at = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: at[0])
    goal, position = SimpleNamespace(id="g-1", progress=0.4), (0.01, 0.0, 0.0)
    said: list[str] = []
    monkeypatch.setattr(live, "print_line", said.append)

    class Moving(Slow):
        def states(self, timeout: float) -> Iterator[SimpleNamespace]:
            for number in range(24):
                yield SimpleNamespace(t=number / 8, mode="moving", measured_pose=position, goal=goal, faults=("a",))
                at[0] += 1 / 8

    with pytest.raises(ServiceError, match="no longer sends its state"):
        live.watch(Moving(1.0), json_lines=False)  # type: ignore[arg-type]
    assert [line.split("   ")[0] for line in said] == [f"{t} s  moving  x 10.000 mm" for t in ("0.00", "1.00", "2.00")]
    assert said[0].endswith("goal g-1 40%  a")


@given(line=st.sampled_from(["ik 0 0 0", "workspace", "sessions {}"]), columns=st.integers(10, 200))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.long
def test_a_listing_in_a_pipe_is_neither_wrapped_nor_cut(
    line: str, columns: int, named_session: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = line.format(named_session).split()
    with monkeypatch.context() as wide:
        wide.setenv("COLUMNS", "1000")
        code, expected, _ = run(*words)
    with monkeypatch.context() as narrow:
        narrow.setenv("COLUMNS", str(columns))
        assert run(*words)[:2] == (code, expected)
    assert code == 0
    assert all(len(line) == len(line.rstrip()) for line in expected.splitlines())


@pytest.fixture(scope="module")
def named_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the sidecar of a session whose line is long."""
    folder = tmp_path_factory.mktemp("listed")
    name = f"{'robot' * 10}-20260131-120000.rrd"
    (folder / name).touch()
    outcomes: dict[Outcome, int] = {"done": 1000, "faulted": 10, "preempted": 100, "stopped": 200}
    users = {f"operator-{number}" for number in range(9)}
    contents.save(
        folder / name, contents.Contents(name, "robot" * 10, 1e9, 1e9 + 5e3, 9, users, {"operator-1": outcomes})
    )
    return folder


PRINTS: dict[str, Callable[[], object]] = {
    "line": lambda: terminal.print_line("done"),
    "table": lambda: terminal.out.print(terminal.table("name", "value")),
    "error": lambda: terminal.print_error("slowed"),
    "json": lambda: terminal.json({"ok": True}),
    "text": lambda: terminal.write("text"),
}


def exit_code_in_closed_pipe(command: Callable[[], int]) -> int:
    """Return the exit code of a command whose standard output is a pipe that its reader has closed."""
    reader, writer = os.pipe()
    os.close(reader)
    with pytest.MonkeyPatch.context() as patched, open(writer, "w") as closed:
        patched.setattr(app, "app", lambda *_, **__: command())
        patched.setattr(sys, "argv", ["trirail", "goto", "0", "0", "0", "--json"])
        patched.setattr(sys, "stdout", closed)
        patched.setattr(terminal, "_reader_left", threading.Event())
        with pytest.raises(SystemExit) as ended:
            app.main()
        closed.flush()  # as the interpreter does at its end; a failure would make its exit code 120
    assert isinstance(ended.value.code, int)
    return ended.value.code


@given(st.lists(st.sampled_from(sorted(PRINTS)), min_size=1, max_size=4), st.sampled_from([0, 1, 130, "refused"]))
def test_the_exit_code_is_that_of_the_command_whoever_closes_its_pipe(prints: list[str], outcome: int | str) -> None:
    def command() -> int:
        for name in prints:
            PRINTS[name]()
        if isinstance(outcome, str):
            raise RefusedError(RefusalCode.BUSY, outcome)
        return outcome

    assert exit_code_in_closed_pipe(command) == (1 if isinstance(outcome, str) else outcome)


@pytest.mark.parametrize("name", ["line", "json"])
def test_an_endless_output_ends_with_its_reader(name: str) -> None:
    def command() -> int:
        for _ in terminal.end_with_reader(itertools.count()):
            PRINTS[name]()
        return 1

    assert exit_code_in_closed_pipe(command) == 0


@pytest.mark.parametrize("line", ["help all", "goto --help", "--version", "ik 0 0 0", "ik 0 0 0 --json"])
@pytest.mark.long
def test_help_and_results_into_a_closed_pipe_are_no_failure(line: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "trirail", *line.split()], stdout=writer, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt(), ServiceError("silent")])
@pytest.mark.parametrize("where", ["wait", "print"])
def test_a_stop_that_fails_waits_for_the_session_that_opens(
    failure: BaseException, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The interpreter would abort if it ended while Zenoh's code runs."""
    opening = threading.Thread(target=time.sleep, args=(0.2,), daemon=True)

    def fail(*_: object) -> None:
        raise failure

    def create(*_: object) -> SimpleNamespace:
        opening.start()
        return SimpleNamespace(opening=opening, wait=fail if where == "wait" else lambda: None)

    monkeypatch.setattr(new_stop, "NewStop", create)
    monkeypatch.setattr(stop_commands, "confirmed", fail)
    with pytest.raises(type(failure)):
        stop_commands.stopping(Command.STOP)()
    assert not opening.is_alive()


def test_a_stop_without_an_answer_says_that_it_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    said: queue.SimpleQueue[str] = queue.SimpleQueue()
    asked = SimpleNamespace(opening=threading.Thread(), wait=lambda: said.get(timeout=WITHIN))
    monkeypatch.setattr(new_stop, "NewStop", lambda *_: asked)
    monkeypatch.setattr(stop_commands, "ANSWER_S", 0.0)
    monkeypatch.setattr(stop_commands, "confirmed", lambda *_: said.put(str(_[-1])))
    monkeypatch.setattr(terminal, "print_error", said.put)
    assert stop_commands.stopping(Command.STOP)() == 0
    assert "no answer" in said.get()


def test_what_a_command_opens_never_has_the_number_of_a_closed_standard_stream() -> None:
    opens = (
        "import os, sys; from trirail.__main__ import _open_standard_streams as prepare; prepare(); "
        "sys.stdout.write('to nobody'); sys.stderr.write('neither'); sys.exit(os.open(os.devnull, os.O_RDONLY))"
    )
    ended = subprocess.run(["sh", "-c", '"$0" -c "$1" <&- >&- 2>&-', sys.executable, opens], check=False)
    assert ended.returncode == 3


class Endless(Slow):
    """A robot whose goal does not end before it is cancelled, and that sends no state."""

    def __init__(self) -> None:
        super().__init__(1.0)
        self.ended, self.stopped = threading.Event(), self.result
        self.result = None  # type: ignore[assignment]

    def cancel(self) -> None:
        self.result = self.stopped
        self.ended.set()

    def __exit__(self, *_: object) -> None:
        self.cancel()

    def states(self, timeout: float) -> Iterator[SimpleNamespace]:
        assert self.ended.wait(WITHIN)
        yield SimpleNamespace(goal=None, seq=1)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
@pytest.mark.parametrize("line", ["goto 0 0 0 --wait", "move 0 0 0 --wait", "sliders 0 0 0 --wait", "jog 0.01 0 0"])
def test_a_signal_that_ends_the_command_stops_the_robot_first(
    monkeypatch: pytest.MonkeyPatch, line: str, number: signal.Signals
) -> None:
    robot = Endless()

    def states(_timeout: float) -> Iterator[SimpleNamespace]:
        signal.raise_signal(number)
        yield SimpleNamespace(goal=None, seq=1)

    monkeypatch.setattr(robot, "states", states)
    monkeypatch.setattr(client, "Robot", lambda *_, **__: robot)
    monkeypatch.setattr(live, "table", lambda *_: "")
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    monkeypatch.setattr(sys, "argv", ["trirail", *line.split()])
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit) as exited:
            app.main()
    finally:
        signal.signal(number, before)
    assert robot.ended.is_set()
    assert exited.value.code == 128 + number


def test_a_jog_ends_after_its_time_even_if_no_state_comes(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Endless()
    monkeypatch.setattr(live, "table", lambda *_: "")
    monkeypatch.setattr(client, "Robot", lambda *_, **__: robot)
    assert run("jog", "0.01", "0", "0", "--seconds", "0.05") == (0, "goal g-1 done\n", "")


SPEAKING = [
    "ik 0.01 0 0.05",
    "workspace",
    "doctor --quick",
    "ik 0.01 0 0.05 --json",
    "doctor --quick --json",
    "ik 9 0 0",
]


@pytest.mark.parametrize("words", SPEAKING)
@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "koi8-r", "shift_jis", "utf-8"])
def test_an_output_that_lacks_characters_ends_no_command(
    words: str, encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A command may have moved the robot when it says so. Programs read JSON as UTF-8 whatever the terminal shows."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding) for _ in range(2))
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    monkeypatch.setattr(sys, "argv", ["trirail", *words.split()])
    with pytest.raises(SystemExit) as ended:
        __main__.main()
    for stream in (out, err):
        stream.flush()
    written, errors = (stream.buffer.getvalue() for stream in (out, err))
    assert ended.value.code == ("ik 9" in words), errors
    assert b"Traceback" not in errors
    if "--json" in words:
        json.loads(written.decode())


@given(st.text(), st.sampled_from(["ascii", "latin-1", "utf-8", "cp1252"]))
def test_json_is_json_in_whatever_encoding(words: str, encoding: str) -> None:
    line = json_printable(json.dumps(words, ensure_ascii=False), encoding)
    assert json.loads(line.encode(encoding).decode()) == words
