"""The file of as-built errors: what is one is taken; what is none, another robot's or too steep is refused."""

from __future__ import annotations

import math
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from trirail.cli import doctor
from trirail.config import SIM, Config, as_built, corrected_geometry, geometry, load
from trirail.config.as_built import AsBuilt, format_map, geometry_of, parse
from trirail.errors import ConfigError
from trirail.kinematics.geometry import Geometry
from trirail.motion.feasibility import SLIDER_PLAN_SHARES
from trirail.motion.motion_planner import revision
from trirail.processes.publications import info
from trirail.telemetry import provenance

PLAIN = geometry(CONFIG.geometry)
TEXT = SIM.read_text(encoding="utf-8")
BOTH = 'map = "as_built.toml"\nbacklash = [5e-5, 0.0, 1e-5]'


def a_map(size: float = 2e-5, seed: int = 2, **changes: object) -> AsBuilt:
    """A gentle map of the shipped robot's whole workspace."""
    nodes = np.random.default_rng(seed).uniform(-size, size, (5, 5, 5, 3))
    made = AsBuilt("2026-05-01", geometry_of(PLAIN), (-0.15, -0.15, -1.2), (0.15, 0.15, 0.85), tupled(nodes.tolist()))
    return msgspec.structs.replace(made, **changes)


def tupled(values: object) -> tuple:  # type: ignore[type-arg]
    return tuple(map(tupled, values)) if isinstance(values, list) else values  # type: ignore[return-value]


def robot_file(folder: Path, content: bytes, correction: str = 'map = "as_built.toml"') -> Path:
    (folder / "as_built.toml").write_bytes(content)
    path = folder / "robot.toml"
    path.write_text(f"{TEXT}\n[correction]\n{correction}\n", encoding="utf-8")
    return path


def one_line(error: ConfigError, begins: str) -> None:
    assert str(error).startswith(begins)
    assert "\n" not in str(error)
    assert len(str(error)) < 1500


def refused(folder: Path, content: bytes) -> str:
    path = robot_file(folder, content)
    with pytest.raises(ConfigError) as caught:
        load(path)
    said = str(caught.value)
    one_line(caught.value, f"{path}: correction.map: ")
    return said.removeprefix(f"{path}: ")


def test_what_is_written_is_read(tmp_path: Path) -> None:
    assert parse(format_map(a_map())) == a_map()
    config = load(robot_file(tmp_path, format_map(a_map()).encode()))
    assert config.correction.as_built == a_map()
    assert corrected_geometry(config).correction is not None
    assert corrected_geometry(config) != PLAIN


def test_a_recording_holds_the_map_itself(tmp_path: Path) -> None:
    config = load(robot_file(tmp_path, format_map(a_map()).encode(), BOTH))
    (tmp_path / "as_built.toml").unlink()
    again = provenance.configuration(provenance.text_documents(config))
    assert again == config
    assert msgspec.json.decode(msgspec.json.encode(config), type=Config) == config


def test_another_correction_is_another_revision(tmp_path: Path) -> None:
    config = load(robot_file(tmp_path, format_map(a_map()).encode()))
    other = load(robot_file(tmp_path, format_map(a_map(seed=3)).encode()))
    lash = msgspec.structs.replace(
        config, correction=msgspec.structs.replace(config.correction, backlash=(1e-5, 0.0, 0.0))
    )
    assert len({revision(each) for each in (CONFIG, config, other, lash)}) == 4


def test_the_reserve_is_what_plans_leave() -> None:
    assert pytest.approx([1.0 - share for share in SLIDER_PLAN_SHARES]) == as_built.RESERVE


def test_what_is_wrong_with_a_map_is_said(tmp_path: Path) -> None:
    good = format_map(a_map())

    def said(found: AsBuilt) -> str:
        return refused(tmp_path, format_map(found).encode())

    assert "correction.map:" in refused(tmp_path, b"")
    assert "invalid map of as-built errors" in refused(tmp_path, b"")
    assert "not TOML" in refused(tmp_path, good.encode()[:-100])
    assert "not text in UTF-8" in refused(tmp_path, b"\xff\xfe" + good.encode())
    assert "missing required field made" in refused(tmp_path, good.replace('made = "2026-05-01"', "").encode())
    assert "expected float >= -0.02" in said(a_map(0.5))
    assert "another [geometry]" in said(a_map(geometry="00000000"))
    assert "limits.platform.x is [-0.15, 0.15]" in said(a_map(low=(-0.1, -0.15, -1.2)))
    steep = said(a_map(3e-3))
    assert "too steep near x " in steep
    assert "the limits allow" in steep
    ragged = a_map()
    ragged = msgspec.structs.replace(ragged, nodes=(ragged.nodes[0][:4], *ragged.nodes[1:]))
    assert "correction.as_built.nodes" in said(ragged)
    missing = robot_file(tmp_path, b"")
    (tmp_path / "as_built.toml").unlink()
    with pytest.raises(ConfigError, match=r"No such file or directory; create one with python tools/calibrate\.py "):
        load(missing)


def test_where_it_is_too_steep_and_by_how_much_is_said(tmp_path: Path) -> None:
    """One node that is off: the place that is named is beside it."""
    nodes = np.zeros((11, 11, 11, 3))
    nodes[7, 3, 5, 0] = 2e-3
    said = refused(tmp_path, format_map(a_map(nodes=tupled(nodes.tolist()))).encode())
    place = [float(number) for number in re.findall(r"(?:x|y|phi) (-?[\d.]+)", said.partition("near ")[2])[:3]]
    size = np.array([0.3, 0.3, 2.05]) / 8.0
    place = [place[0] * 1e-3, place[1] * 1e-3, math.radians(place[2])]
    centre = np.array([-0.15, -0.15, -1.2]) + (np.array([7, 3, 5]) - 1.0) * size  # where its spline is greatest
    assert (np.abs(np.array(place) - centre) <= 2.0 * size).all()


def test_a_map_that_brings_the_legs_to_a_singular_angle_is_refused(tmp_path: Path) -> None:
    near = TEXT.replace("phi = [-1.2, 0.85]", "phi = [-1.2, 0.89719]")  # pi / 3 less 0.150008
    path = tmp_path / "robot.toml"
    for turn, right in ((0.0, True), (2e-5, False)):
        nodes = np.zeros((4, 4, 4, 3))
        nodes[..., 2] = turn
        found = a_map(nodes=tupled(nodes.tolist()), high=(0.15, 0.15, 0.9))
        (tmp_path / "as_built.toml").write_text(format_map(found), encoding="utf-8")
        path.write_text(near + '\n[correction]\nmap = "as_built.toml"\n', encoding="utf-8")
        if right:
            assert load(path).correction.as_built == found
        else:
            with pytest.raises(ConfigError, match="singular"):
                load(path)


GOOD = format_map(a_map()).splitlines()
VALUES = ("0", "-1", "1e300", "nan", "inf", '""', "[]", "[[]]", "{}", "true", "[nan, 0, 0]", "9" * 400, "[" * 5000)


@given(
    number=st.integers(0, len(GOOD) - 1),
    value=st.sampled_from(VALUES) | st.text(max_size=30),
    what=st.sampled_from(("value", "line", "drop", "twice", "cut")),
)
def test_any_file_is_a_map_or_is_refused(number: int, value: str, what: str) -> None:
    lines = list(GOOD)
    key, _, _ = lines[number].partition("=")
    lines[number:] = {
        "value": [f"{key}= {value}", *lines[number + 1 :]],
        "line": [value, *lines[number + 1 :]],
        "drop": lines[number + 1 :],
        "twice": [lines[number], *lines[number:]],
        "cut": [],
    }[what]
    with tempfile.TemporaryDirectory() as folder:
        path = robot_file(Path(folder), "\n".join(lines).encode("utf-8", "surrogatepass"))
        try:
            assert load(path).correction.as_built is not None
        except ConfigError as error:
            one_line(error, f"{path}: correction.map: ")


def test_the_geometry_is_told_from_others_by_a_nanometre() -> None:
    a, b, c = PLAIN.legs
    other = Geometry((replace(a, home=a.home + 1e-6), b, c))
    assert geometry_of(other) != geometry_of(PLAIN) == geometry_of(geometry(CONFIG.geometry))


def test_who_asks_is_told_of_the_correction(tmp_path: Path) -> None:
    assert info(CONFIG).correction is None
    assert doctor.correction(CONFIG) == []
    config = load(robot_file(tmp_path, format_map(a_map()).encode(), BOTH))
    told = info(config).correction
    assert told is not None
    assert (told.file, told.made, told.backlash) == (str(tmp_path / "as_built.toml"), "2026-05-01", (5e-5, 0.0, 1e-5))
    assert 0.0 < max(told.greatest) < 2e-5
    (check,) = doctor.correction(config)
    assert check.verdict == "ok"
    assert "as_built.toml, measured 2026-05-01: up to" in check.found
    assert "backlash of A 50.0 µm, B 0.0 µm, C 10.0 µm" in check.found
