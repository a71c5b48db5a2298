"""The configuration that is written: only what was found changes, and comments stay."""

from __future__ import annotations

import contextlib
import difflib
import operator
import resource
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trirail.client.stage_as_built import built_otherwise
from trirail.commissioning import config_edit
from trirail.config import SIM, as_built, everything, geometry, load, parse, parse_values
from trirail.errors import ConfigError
from trirail.kinematics.correction import Correction
from trirail_drivers.interface import NAMES

SHIPPED = sorted(SIM.parent.rglob("*.toml"))
changes = st.fixed_dictionaries(
    {},
    optional={
        f"drives.{name}.{key}": values
        for name in NAMES
        for key, values in (
            ("direction", st.sampled_from((1, -1))),
            ("counts_per_metre", st.floats(5e6, 1e8)),
        )
    },
)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
@settings(max_examples=8)
@given(found=changes)
def test_only_what_was_found_changes(path: Path, found: dict[str, int | float]) -> None:
    text = path.read_text(encoding="utf-8")
    if "odrive" in text:
        found = {key: value for key, value in found.items() if "counts" not in key}
    written = config_edit.edit_text(text, found)
    assert parse(written) == config_edit.replace_values(parse(text), found)
    lines = list(difflib.ndiff(text.splitlines(), written.splitlines()))
    assert sum(line.startswith(("- ", "+ ")) for line in lines) <= 2 * len(found)
    for line in text.splitlines():
        if line.lstrip().startswith("#"):
            assert line in written


def test_an_inline_table_is_changed_too() -> None:
    text = SIM.read_text(encoding="utf-8").replace("[drives.B]\nnode = 2\ncounts_per_metre = 1e7\n", "")
    inline = 'protocol = "cia402"\nB = { node = 2, counts_per_metre = 1e7 }  # mine'
    text = text.replace('protocol = "cia402"', inline)
    written = config_edit.edit_text(text, {"drives.B.direction": -1, "drives.B.node": 7})
    assert "# mine" in written
    assert (parse(written).drives.B.direction, parse(written).drives.B.node) == (-1, 7)


SYMMETRIC = "[geometry]\nl0 = 0.3"


@pytest.mark.parametrize("way", ["geometry = { l0 = 0.3 }", "geometry.l0 = 0.3", f"\n{SYMMETRIC}"])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_symmetric_geometry_gets_legs_however_it_is_written(way: str, seed: int) -> None:
    text = SIM.read_text(encoding="utf-8")
    assert text.count(SYMMETRIC) == 1
    head, _, tail = text.partition(SYMMETRIC)
    text = f"{head}{way}{tail}" if way.endswith(SYMMETRIC) else f"{way}\n{head}{tail.partition(chr(10))[2]}"
    rng = np.random.default_rng(seed)
    robot = built_otherwise(geometry(parse(text).geometry), rng, 1e-4, 1e-3)
    written = parse_values(config_edit.edit_geometry(text, robot, (1e-4, 0.0, -1e-4), None))
    assert as_built.geometry_of(geometry(written.geometry)) == as_built.geometry_of(robot)


def test_what_would_be_no_configuration_is_not_written() -> None:
    with pytest.raises(ConfigError, match="node ids"):
        config_edit.edit_text(SIM.read_text(encoding="utf-8"), {"drives.A.node": 2})


def test_no_file_is_written_over(tmp_path: Path) -> None:
    source = tmp_path / "mine.toml"
    first = config_edit.find_free_path(source)
    config_edit.write_new_file(first, "precious")
    second = config_edit.find_free_path(source)
    assert (first.name, second.name) == ("mine-commissioned.toml", "mine-commissioned-2.toml")
    with pytest.raises(ConfigError, match="already exists"):
        config_edit.write_new_file(first, "other")
    assert first.read_text() == "precious"


@contextlib.contextmanager
def disk_room(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond `size` bytes."""
    handler, limits = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("room", [0, 4096, 5000])
def test_a_full_disk_leaves_no_part_of_a_file(tmp_path: Path, room: int) -> None:
    path, text = tmp_path / "mine.toml", "a line of text\n" * 1000
    with disk_room(room), pytest.raises(ConfigError, match=f"{path}: File too large"):
        config_edit.write_new_file(path, text)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("section", "line", "key", "file"),
    [
        ("[drives.B]", 'eds = "maker.eds"', "drives.B.eds", "maker.eds"),
        ("[drives.C]", 'endpoints = "flat.json"', "drives.C.endpoints", "flat.json"),
        ("[correction]", 'map = "errors.toml"', "correction.map", "errors.toml"),
        ("[zenoh.tls]", "", "zenoh.tls.directory", "keys"),
        ("[zenoh.tls]", 'directory = "certificates"', "zenoh.tls.directory", "certificates"),
    ],
)
def test_files_are_found_from_another_folder(tmp_path: Path, section: str, line: str, key: str, file: str) -> None:
    here, moved = tmp_path / "here", tmp_path / "moved.toml"
    here.mkdir()
    errors = Correction((-1.0,) * 3, (1.0,) * 3, np.zeros((4, 4, 4, 3)))
    made = as_built.measured_today(errors, geometry(load(SIM).geometry))
    (here / "errors.toml").write_text(as_built.format_map(made), encoding="utf-8")
    text = SIM.read_text(encoding="utf-8")
    text = text.replace(f"{section}\n", f"{section}\n{line}\n") if section in text else f"{text}{section}\n{line}\n"
    config_edit.write_new_file(moved, config_edit.resolve_paths(text, here))
    assert operator.attrgetter(key)(everything(moved).config) == str(here / file)


def test_a_robot_with_a_correction_map_is_changed_too() -> None:
    text = SIM.read_text(encoding="utf-8") + '[correction]\nmap = "errors.toml"\n'
    assert config_edit.edit_text(text, {"drives.A.node": 9}) == text.replace("node = 1\n", "node = 9\n")
