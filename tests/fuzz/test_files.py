"""Configurations, trajectories and recordings: each is read, or refused in one line that names the file."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.client import trajectory
from trirail.config import SIM, Config, load
from trirail.errors import ConfigError, ServiceError, TrirailError
from trirail.telemetry.reading import read

LINES = SIM.read_text(encoding="utf-8").splitlines()
VALUES = ("0", "-1", "1e-310", "1e300", "nan", "inf", '""', '"x"', "[]", "{}", "true", "1979-05-27", "[[1]]", "9" * 400)


def written(name: str, content: bytes) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="trirail-fuzz-"))
    path = folder / name
    path.write_bytes(content)
    return path


def refused(error: TrirailError, path: Path) -> None:
    assert str(path) in str(error)
    assert "\n" not in str(error)
    assert len(str(error)) < 1500


@given(
    number=st.integers(0, len(LINES) - 1),
    value=st.sampled_from(VALUES) | st.text(max_size=30),
    what=st.sampled_from(("value", "line", "key", "drop", "twice")),
)
def test_any_configuration_is_one_or_is_refused(number: int, value: str, what: str) -> None:
    lines = list(LINES)
    key, _, _ = lines[number].partition("=")
    lines[number : number + 1] = {
        "value": [f"{key}= {value}"],
        "line": [value],
        "key": [f"{value} = 1"],
        "drop": [],
        "twice": [lines[number]] * 2,
    }[what]
    path = written("robot.toml", "\n".join(lines).encode("utf-8", "surrogatepass"))
    try:
        assert isinstance(load(path), Config)
    except ConfigError as error:
        refused(error, path)
    finally:
        path.unlink()
        path.parent.rmdir()


rows = st.lists(st.lists(st.floats().map(str) | st.text(max_size=8), max_size=11).map(",".join), max_size=6)


@given(
    head=st.sampled_from(("t,x,y,phi", "t,x,y,phi,vx,vy,w", " t , x , y , phi ", "t,x", "t,t,x,y,phi", "")),
    rows=rows,
    suffix=st.sampled_from((".csv", ".json")),
    raw=st.none() | st.binary(max_size=100),
)
@example(head="t,x,y,phi", rows=["9" * 200_000], suffix=".csv", raw=None)
@example(head="", rows=[], suffix=".json", raw=b"[" * 100_000)
def test_any_trajectory_is_one_or_is_refused(head: str, rows: list[str], suffix: str, raw: bytes | None) -> None:
    path = written(f"path{suffix}", raw or "\n".join((head, *rows)).encode("utf-8", "surrogatepass"))
    try:
        assert isinstance(trajectory.read(path), list)
    except TrirailError as error:
        refused(error, path)
    finally:
        path.unlink()
        path.parent.rmdir()


@settings(max_examples=30)
@given(content=st.binary(max_size=400), magic=st.booleans())
def test_any_file_is_a_recording_or_is_refused(content: bytes, magic: bool) -> None:
    path = written("session.rrd", b"RRF2" + content if magic else content)
    try:
        with pytest.raises(ServiceError) as caught:
            read(path)
        assert str(path) in str(caught.value)
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
            path.parent.rmdir()
