"""The commands that need no service, called as from a terminal."""

import json
import math
import random
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cyclopts import App, CycloptsError
from matplotlib.image import imread
from numpy.testing import assert_allclose
from trirail.cli import math_commands
from trirail.config import SIM, load
from trirail.errors import KinematicsError, TrirailError
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import inverse
from trirail.motion.motion_planner import MotionPlanner, revision
from trirail.motion.runs import ZERO_RATES
from trirail.wire.goals import PoseGoal
from trirail.wire.plan_packets import NotPlanned, PlanRequest
from trirail.workspace.singularity import conditioning, sensitivity

PAPER = Geometry.symmetric(0.3)

app = App()
for command in (math_commands.ik, math_commands.fk, math_commands.workspace):
    app.command(command)


def call(line: str) -> object:
    return app(line, exit_on_error=False, print_error=False, result_action="return_value")


@pytest.fixture
def answer(capsys: pytest.CaptureFixture[str]) -> Any:
    def run(line: str) -> dict[str, Any]:
        assert call(f"{line} --json") == 0
        printed = capsys.readouterr()
        assert printed.out.count("\n") == 1
        assert printed.err == ""
        found = json.loads(printed.out)
        assert isinstance(found, dict)
        return found

    return run


def test_ik_prints_everything_about_a_pose(answer: Any) -> None:
    found = answer("ik -0.02 0.01 0.2 --velocity -0.1 0 0.3 --acceleration 1 -2 0.5")
    pose = [-0.02, 0.01, 0.2]
    expected = inverse(PAPER, pose, [-0.1, 0.0, 0.3], [1.0, -2.0, 0.5])
    assert found["pose"] == pose
    for name, values in expected._asdict().items():
        assert found[name] == values.tolist()
    assert_allclose(found["sensitivity"], sensitivity(PAPER, pose))
    assert_allclose(found["conditioning"], conditioning(PAPER, pose))
    assert_allclose(found["distance_to_singularity"], math.pi / 3 - 0.2)
    assert found["warnings"] == []


def test_ik_in_degrees(answer: Any) -> None:
    in_degrees = answer("ik 0.02 0 -20 --velocity 0 0 30 --acceleration 0 0 -90 --deg")
    in_radians = inverse(PAPER, *([x, 0.0, math.radians(a)] for x, a in ((0.02, -20), (0.0, 30), (0.0, -90))))
    assert_allclose(in_degrees["position"], in_radians.position, rtol=1e-14)
    assert_allclose(in_degrees["passive_acceleration"], in_radians.passive_acceleration, rtol=1e-14)


def test_fk_undoes_ik(answer: Any) -> None:
    sliders = answer("ik 0.03 -0.02 -0.3")["position"]
    assert_allclose(answer("fk {} {} {}".format(*sliders))["pose"], [0.03, -0.02, -0.3], atol=1e-12)


def test_words_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("ik 0.05 0 0") == 0
    words = capsys.readouterr().out
    assert "x 50.000 mm" in words
    assert "slider 0.000 -50.000 50.000 mm" in " ".join(words.split())  # by hand: lambda = 0, -x, x
    assert "singular 60.00° away" in words
    assert call("fk 0 -0.05 0.05") == 0
    assert "x 50.000 mm   y 0.000 mm   φ 0.0000°" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "leg", "value", "limit", "words"),
    [
        ("ik 0.2 0 0", "B", -0.2, -0.17, "slider B: position -200 mm is beyond the limit of -170 mm"),
        ("ik 0.2 0 0", "B", -0.2, -0.17, "slider C: passive position -200 mm is beyond the limit of -170 mm"),
        ("ik 0 0 1", "", math.pi / 3 - 1.0, 0.15, "platform phi: distance to singularity 2.70422°"),
        ("ik 0 0 60 --deg", "A", math.pi / 3, math.pi / 3, "leg A: edge parallel to its rail"),
        ("fk 0 0.5 0", "B", 0.5, 0.34, "slider B: position 500 mm is beyond the limit of 340 mm"),
        ("fk 0.085 0.085 0.085", "", None, 0.15, "distance to singularity"),
        ("fk -0.1 0.34 -0.1", "B", None, -0.17, "slider B: passive position"),
    ],
)
def test_what_cannot_be_reached_is_an_error(line: str, leg: str, value: float | None, limit: float, words: str) -> None:
    with pytest.raises(KinematicsError) as refused:
        call(line)
    assert words in str(refused.value)
    assert refused.value.leg == leg
    assert refused.value.value is not None
    assert refused.value.limit is not None
    assert_allclose(refused.value.limit, limit, atol=1e-9)
    if value is not None:
        assert_allclose(refused.value.value, value, atol=1e-9)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("ik 0 0.2 0", "platform y: position 200 mm is beyond the limit of 150 mm"),
        ("ik 0 0 0 --velocity 2 0 0", "slider B: velocity -2000 mm/s is beyond the limit of"),
        ("ik 0 0 0 --acceleration 0 20 0", "slider A: acceleration 23094 mm/s² is beyond the limit of"),
    ],
)
def test_what_only_the_service_refuses_is_a_warning(line: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(line) == 0
    assert words in capsys.readouterr().err
    assert call(f"{line} --json") == 0
    printed = capsys.readouterr()
    assert words in json.loads(printed.out)["warnings"][0]
    assert printed.err == ""


@pytest.mark.parametrize("line", ["ik 0 0 nan", "fk 0 inf 0", "workspace --phi nan"])
def test_numbers_must_be_finite(line: str) -> None:
    with pytest.raises(CycloptsError, match="bare number is in"):
        call(line)


@pytest.mark.parametrize("line", ["ik 0 0", "ik 0 0 x", "ik 0 0 0 --velocity 1 2", "fk 1 2", "workspace --depth 3"])
def test_wrong_usage(line: str) -> None:
    with pytest.raises(CycloptsError):
        call(line)


def test_workspace_measures(answer: Any) -> None:
    found = answer("workspace")
    assert found["robot"] == "demo"
    permitted, reachable = found["permitted"], found["reachable"]
    assert_allclose(permitted["x"], [-0.15, 0.15], atol=1e-9)
    assert_allclose(permitted["phi"][1], 0.85, atol=1e-9)
    assert_allclose(reachable["area_at_zero"], 9 * math.sqrt(3) / 4 * 0.17**2)
    assert_allclose(reachable["best"]["area"], reachable["area_at_zero"], rtol=1e-9)
    assert permitted["volume"] < reachable["volume"]
    degrees = [round(math.degrees(each["phi"]), 9) for each in found["slices"]]
    assert degrees == [-45, -30, -15, 0, 15, 30, 45]
    for each in found["slices"]:
        for kind in ("permitted", "reachable"):
            polygon = np.array(each[kind]["polygon"])
            x, y = polygon.T
            assert_allclose((x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2, each[kind]["area"], rtol=1e-9)


def test_slices_where_one_asks_for_them(answer: Any) -> None:
    found = answer("workspace --deg --phi -30 12.5 170")
    assert_allclose([each["phi"] for each in found["slices"]], np.radians([-30, 12.5, 170]))
    assert found["slices"][2]["reachable"] == {"area": 0.0, "polygon": []}


def test_the_workspace_of_another_robot(answer: Any, tmp_path: Path) -> None:
    config = tmp_path / "short.toml"
    config.write_text(SIM.read_text(encoding="utf-8").replace("[-0.17, 0.34]", "[-0.1, 0.2]"), encoding="utf-8")
    found = answer(f"workspace --phi 0 --config {config}")
    assert_allclose(found["slices"][0]["reachable"]["area"], 9 * math.sqrt(3) / 4 * 0.1**2)
    with pytest.raises(KinematicsError, match=r"beyond the limit of -100 mm"):
        call(f"ik 0.15 0 0 --config {config}")
    with pytest.raises(TrirailError, match=r"nowhere\.toml"):
        call(f"fk 0 0 0 --config {tmp_path / 'nowhere.toml'}")


def test_the_workspace_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("workspace --phi 0 0.5") == 0
    words = capsys.readouterr().out
    for expected in ("-150.00 to 150.00", "-59.38 to 51.41", "1126.266", "814.841", "28.65", "cm²"):
        assert expected in words
    assert "-0.00" not in words


@pytest.mark.generated(*range(30))
def test_the_service_permits_what_its_planner_accepts_also_with_backlash(
    seed: int, answer: Any, tmp_path: Path
) -> None:
    """Straight lines at one phi from the middle of the permitted slice to its corners, and just beyond them."""
    chance, file = random.Random(seed), tmp_path / "backlash.toml"
    backlash = [chance.choice((0.0, chance.uniform(0.0, 1e-3))) for _ in range(3)]
    file.write_text(f"{SIM.read_text(encoding='utf-8')}\n[correction]\nbacklash = {backlash}\n", encoding="utf-8")
    config, phi = load(file), chance.uniform(-1.0, 0.84)
    planner = MotionPlanner(config)
    polygon = np.array(answer(f"workspace --config {file} --phi {phi}")["slices"][0]["permitted"]["polygon"])
    middle = polygon.mean(axis=0)
    for corner in polygon:
        for beyond in (-1e-5, 1e-5):
            x, y = (corner + beyond * (corner - middle) / np.linalg.norm(corner - middle)).tolist()
            goal, start = PoseGoal(x, y, phi), (middle[0], middle[1], phi)
            planned = planner.plan(
                PlanRequest(1, 1, revision(config), 0, 2, 1.0, (start, ZERO_RATES, ZERO_RATES), (), goal)
            )
            try:
                warned = answer(f"ik {x} {y} {phi} --config {file}")["warnings"] != []
            except KinematicsError:
                warned = True
            assert isinstance(planned, NotPlanned) is warned is (beyond > 0.0), planned


@pytest.mark.long
@pytest.mark.parametrize("angles", ["", "--phi 0", "--deg --phi -100 -20 0 20 40"])
def test_the_plot_is_a_picture(angles: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "workspace.png"
    assert call(f"workspace --plot {file} {angles}") == 0
    assert f"drawn to {file}" in capsys.readouterr().out
    assert file.read_bytes().startswith(b"\x89PNG")
    picture = imread(file)
    height, width, _ = picture.shape
    assert min(height, width) > 800
    colourful = np.ptp(picture[..., :3], axis=2) > 0.2
    assert colourful.mean() > 0.02  # slices and strip, not only lines


@pytest.mark.long
def test_a_range_without_a_whole_degree_has_one_slice(answer: Any, tmp_path: Path) -> None:
    config, file = tmp_path / "narrow.toml", tmp_path / "workspace.png"
    config.write_text(re.sub(r"(?m)^phi = .*", "phi = [0.002, 0.012]", SIM.read_text(encoding="utf-8"), count=1))
    assert [each["phi"] for each in answer(f"workspace --config {config}")["slices"]] == [pytest.approx(0.007)]
    assert call(f"workspace --plot {file} --config {config}") == 0
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_a_plot_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(TrirailError, match=r"cannot draw to .*Format 'xyz' is not supported"):
        call(f"workspace --phi 0 --plot {tmp_path / 'a.xyz'}")
    with pytest.raises(TrirailError, match=r"cannot draw to \S*a\.png: No such file or directory$"):
        call(f"workspace --phi 0 --plot {tmp_path / 'nowhere' / 'a.png'}")


@pytest.mark.parametrize("name", ["a", "a.", ".png"])
def test_a_plot_is_written_to_the_named_file_or_not_at_all(name: str, tmp_path: Path) -> None:
    with pytest.raises(TrirailError, match=r"the name must end in \.png, \.svg or \.pdf$"):
        call(f"workspace --phi 0 --plot {tmp_path / name}")
    assert list(tmp_path.iterdir()) == []


def test_without_matplotlib_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delitem(sys.modules, "trirail.workspace.plots", raising=False)
    monkeypatch.delattr("trirail.workspace.plots", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(TrirailError, match=r"pip install 'trirail\[analysis\]'"):
        call(f"workspace --plot {tmp_path / 'a.png'}")
