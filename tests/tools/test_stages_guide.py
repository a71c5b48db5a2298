"""configs/stages.md: its worked numbers are the service's."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import stages_picture
from trirail.config import SIM, geometry, load
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import other_kind, travels
from trirail.kinematics.robot import forward, jacobians

GUIDE = SIM.with_name("stages.md").read_text(encoding="utf-8")
FILES = {"3-PRP": "uvw.toml", "3-PPR": "uvw-ppr.toml"}
ROWS = re.findall(
    r"^\| (.*?), (.*?), (.*?)° \| (3-P.P|3-P.R) \| (.*?) \| (.*?) \| (.*?) \|$", GUIDE.replace("−", "-"), re.M
)


@pytest.mark.parametrize(("x", "y", "degrees", "kind", "u", "v", "w"), ROWS)
def test_worked_numbers(x: str, y: str, degrees: str, kind: str, u: str, v: str, w: str) -> None:
    robot = geometry(load(SIM.with_name(FILES[kind])).geometry)
    pose = float(x) / 1e3, float(y) / 1e3, math.radians(float(degrees))
    assert (travels(robot, pose)[0] * 1e3).tolist() == pytest.approx([float(u), float(v), float(w)], abs=5.1e-7)


def test_both_kinds_are_drawn(tmp_path: Path) -> None:
    """The guide's picture says the same as what is drawn from the geometries now, and is light."""
    stages_picture.draw(tmp_path / "stages.svg")
    words = [
        re.findall(r">([^<>]+)</text>", file.read_text()) for file in (tmp_path / "stages.svg", stages_picture.FILE)
    ]
    assert words[0] == words[1]
    assert sorted(word for word in words[0] if len(word) == 1) == sorted("UVW" * 2)
    assert any("3-PRP" in word for word in words[0])
    assert any("3-PPR" in word for word in words[0])
    assert stages_picture.FILE.stat().st_size < 30_000
    assert f"../tools/pictures/{stages_picture.FILE.name}" in GUIDE


@pytest.mark.parametrize("file", FILES.values())
def test_what_is_left_after_one_correction(file: str) -> None:
    """A camera that does not err shows where the table is; a model says how the drives bring it back to zero."""
    robot = geometry(load(SIM.with_name(file)).geometry)
    off = np.array([1e-3, -0.8e-3, math.radians(1.0)])
    j1, j2 = jacobians(robot, (0.0, 0.0, 0.0))

    def left(correction: Array) -> Array:
        pose = forward(robot, travels(robot, off)[0] + correction)
        return np.array([np.hypot(*pose[:2]) * 1e6, abs(pose[2]) * 1e6])

    exact, mistaken = (-np.subtract(*travels(each, [off, np.zeros(3)])[0]) for each in (robot, other_kind(robot)))
    said = re.search(r"leaves (\S+) µm and (\S+) µrad, small angles leave (\d+) to (\d+) µm", " ".join(GUIDE.split()))
    assert said is not None
    way, turn, least, most = map(float, said.groups())
    assert left(exact) == pytest.approx([0.0, 0.0], abs=1e-6)
    assert left(mistaken) == pytest.approx([way, turn], abs=0.051)
    assert least <= left(-np.linalg.solve(j1, j2 @ off))[0] < most + 0.5


def test_how_far_the_gauge_shows_the_kinds_apart() -> None:
    said = re.search(
        r"two kinds differ by about (\S+) µm. At 5° they differ by (\S+) to (\S+) mm", " ".join(GUIDE.split())
    )
    assert said is not None
    at_1, *at_5 = map(float, said.groups())
    robot = geometry(load(SIM.with_name("uvw.toml")).geometry)

    def apart(degrees: float) -> Array:
        pose = 0.0, 0.0, math.radians(degrees)
        one, other = (np.subtract(*travels(each, [pose, (0.0, 0.0, 0.0)])[0]) for each in (robot, other_kind(robot)))
        return np.array(abs(one - other))

    assert apart(1.0) * 1e6 == pytest.approx([at_1] * 3, abs=1.0)
    assert [min(apart(5.0) * 1e3), max(apart(5.0) * 1e3)] == pytest.approx(at_5, abs=0.0051)


def test_small_angles() -> None:
    (u, v, w) = re.findall(r"small angles \| (\S+) \| (\S+) \| (\S+) \|", GUIDE.replace("−", "-"))[0]
    way = 57.5 * math.radians(1.0)
    assert [float(u), float(v), float(w)] == pytest.approx([way, -way, -way], abs=5.1e-7)
    assert len(ROWS) == 4
