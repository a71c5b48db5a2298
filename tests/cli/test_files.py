"""Files that people name: whatever they are and hold, each command ends, and says what is wrong in one short line."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from trirail.cli import app
from trirail.config import SIM
from trirail_drivers import files
from trirail_drivers.errors import MAX_MESSAGE_LENGTH, FileError, TrirailError, shortened

pytestmark = pytest.mark.filterwarnings("ignore:Cyclopts application invoked without tokens")

Say = Callable[[list[str]], str]
MARGIN = len("trirail: ") + len("\n")


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Say:
    """Call a command as from a terminal; it is to end with exit 1 and one short line, which is returned."""

    def call(arguments: list[str]) -> str:
        monkeypatch.setattr(sys, "argv", ["trirail", *arguments])
        with pytest.raises(SystemExit) as ended:
            app.main()
        said = capsys.readouterr()
        assert (ended.value.code, said.out) == (1, "")
        assert said.err.startswith("trirail: ")
        assert said.err.count("\n") == 1
        assert len(said.err) <= MAX_MESSAGE_LENGTH + MARGIN
        return said.err

    return call


COMMANDS = [
    ["report", "FILE.rrd"],
    ["replay", "FILE.rrd"],
    ["replay", "FILE.rrd", "--config", "FILE.toml"],
    ["run", "FILE.toml"],
    ["doctor", "FILE.toml"],
    ["ik", "0", "0", "0", "--config", "FILE.toml"],
    ["follow", "FILE.csv"],
    ["follow", "FILE.json"],
]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
@pytest.mark.parametrize("kind", ["FIFO", "folder", "socket", "device", "nothing"])
def test_what_is_no_regular_file_is_refused(kind: str, command: list[str], tmp_path: Path, refused: Say) -> None:
    given = [word.replace("FILE", str(tmp_path / "x")) for word in command]
    path = Path(next(word for word in given if word.startswith(str(tmp_path))))
    said = {"FIFO": "a FIFO; expected a regular file", "folder": "a folder;", "nothing": "No such file or directory"}
    if kind == "FIFO":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(os.path.relpath(path))  # its name is to be short
    assert f"{path}: {said.get(kind, f'a {kind};')}" in refused(given)


def test_who_names_no_configuration_is_told_how_to_get_one(tmp_path: Path, refused: Say) -> None:
    assert "create a configuration to start from with `trirail config copy sim`" in refused(
        ["run", str(tmp_path / "x.toml")]
    )


def test_a_fifo_that_nobody_writes_to_is_refused_by_the_program(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.rrd")
    command = [sys.executable, "-m", "trirail", "report", str(tmp_path / "x.rrd")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (1, 1)


def test_a_file_without_end_is_not_read_to_its_end(tmp_path: Path) -> None:
    with (tmp_path / "x.csv").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(FileError, match="larger than 16 MB"):
        files.text(tmp_path / "x.csv")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("x.csv", "t,x,y,phi\n" + "1" * 200_000 + ",0,0,0\n"),
        ("x.csv", "t,x,y,phi\n" + "x" * 100_000 + ",0,0,0\n"),
        ("x.csv", "[" * 100_000),
        ("x.json", "[" * 100_000),
        ("x.json", '[{"t":' + "[" * 100_000),
        ("x.json", '[{"' + "y" * 100_000 + '":1}]'),
        ("x.toml", "a=" + "[" * 100_000),
        ("x.toml", "a=" + "{a=" * 100_000),
        ("x.toml", ".".join("a" * 5_000) + "=1"),
        ("x.toml", "[" + ".".join("a" * 5_000) + "]"),
        ("x.toml", "a=" + "1" * 5000),
        ("x.toml", SIM.read_text().replace("rate_hz = 1000", f"rate_hz = '{'9' * 100_000}'")),
        ("x.toml", SIM.read_text().replace("rate_hz", "k" * 100_000)),
        ("x.toml", SIM.read_text().replace("l0 = 0.3", f"l0 = {'1' * 400}")),
        ("x.rrd", "RRF2" + "[" * 100_000),
        ("x.rrd", "[" * 100_000),
    ],
    ids=lambda value: value if len(value) < 10 else "",
)
def test_large_nonsense_gets_one_short_line(name: str, content: str, tmp_path: Path, refused: Say) -> None:
    path = tmp_path / name
    path.write_text(content)
    command = {".rrd": ["report"], ".toml": ["config", "show"]}.get(path.suffix, ["follow"])
    assert f"{path}: " in refused([*command, str(path)])


ROWS = st.lists(st.text("0123456789.,-e \"'\0\n", max_size=60), max_size=5).map("\n".join)
CONTENTS = (
    st.binary(max_size=200)
    | ROWS.map(lambda rows: f"t,x,y,phi\n{rows}".encode())
    | ROWS.map(lambda rows: f"t,x,y,phi,vx,vy,w\n{rows}".encode())
    | st.recursive(st.none() | st.floats() | st.text(max_size=9), lambda inner: st.lists(inner, max_size=3)).map(
        lambda value: repr(value).replace("'", '"').encode()
    )
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("suffix", [".csv", ".json", ".toml", ".rrd"])
@given(content=CONTENTS)
@example(content=b"\xff\xfe")
@example(content=b"")
def test_any_content_is_read_or_refused(suffix: str, content: bytes, tmp_path: Path) -> None:
    from trirail import config
    from trirail.client import trajectory
    from trirail.telemetry import reading

    readers: dict[str, Callable[[Path], object]] = {".toml": config.load, ".rrd": reading.read}
    path = tmp_path / f"x{suffix}"
    path.write_bytes(content)
    said = str(path)
    try:
        readers.get(suffix, trajectory.read)(path)
    except TrirailError as error:
        said = str(error)
    assert str(path) in said
    assert len(said) <= MAX_MESSAGE_LENGTH


@given(st.text(max_size=2000), st.integers(10, 1000))
def test_a_text_that_is_too_long_keeps_its_beginning_and_its_end(text: str, longest: int) -> None:
    short = shortened(text, longest)
    if len(text) <= longest:
        assert short == text
    else:
        assert len(short) == longest
        begin, _, end = short.rpartition(" … ")
        assert text.startswith(begin)
        assert text.endswith(end)
        assert min(len(begin), len(end)) >= longest // 3 - 3


HOLDS = """
import time
from trirail_drivers import files
with files.temporary_folder() as folder:
    (folder / "socket").touch()
    print(folder, flush=True)
    time.sleep(600)
"""


def test_a_temporary_folder_that_a_killed_process_has_left_goes_with_the_next_one_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    command = [sys.executable, "-c", HOLDS]
    others = [tmp_path / name for name in ("trirail-other", "run-trirail-run-", "file")]
    for other in others:
        other.mkdir()
    (tmp_path / "trirail-run-link").symlink_to(others[0])
    (tmp_path / "trirail-run-file").touch()
    kept = [*others, tmp_path / "trirail-run-link", tmp_path / "trirail-run-file"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as living:
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as killed:
            folders = [Path(each.stdout.readline().strip()) for each in (living, killed) if each.stdout]
            killed.kill()
        assert all((folder / "socket").exists() for folder in folders)
        with files.temporary_folder() as folder:
            assert set(tmp_path.iterdir()) == {*kept, folders[0], folder}
        assert set(tmp_path.iterdir()) == {*kept, folders[0]}
        living.kill()
