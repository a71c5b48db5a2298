"""The tool that draws the paper's figures: what it draws and what it says of the difference from the tables."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import paper
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from service.palette import SLIDERS

PANELS = [f"figure_{number:02}" for number in range(3, 12)]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    t = np.linspace(0.0, paper.DURATION, 301)
    return paper.write(tmp_path_factory.mktemp("paper"), {each: paper.computed(each, t) for each in paper.EXAMPLES})


def test_the_figures_are_the_papers() -> None:
    shown = {number: (example.name, quantity.name) for number, example, quantity in paper.figures()}
    assert sorted(shown) == list(range(3, 12))
    assert shown[3] == ("rotation", "displacement")
    assert shown[5] == ("rotation", "acceleration")
    assert shown[7] == ("translation_x", "velocity")
    assert shown[11] == ("translation_y", "acceleration")


@pytest.mark.parametrize("name", [*PANELS, "paper"])
def test_every_picture_shows_all_three_sliders(pictures: dict[str, Path], name: str) -> None:
    """Also where their curves coincide; the legends alone would not fill so many pixels."""
    image = imread(pictures[name])
    height, width, _ = image.shape
    assert width > height > 400
    below_the_legend = image[height // 8 :, :, :3]
    for colour in SLIDERS:
        near = np.all(np.abs(below_the_legend - np.array(colour[:3]) / 255) < 0.02, axis=2)
        assert near.sum() > width / 3


def test_curves_that_coincide_take_turns() -> None:
    rotation, along_x, along_y = (paper.computed(each, np.linspace(0.0, 3.0, 7)) for each in paper.EXAMPLES)

    def dashes(curves: paper.Curves) -> list[str]:
        axes = Figure().subplots()
        paper.plot(axes, paper.QUANTITIES[0], curves)
        return [str(line.get_linestyle()) for line in axes.get_lines() if np.size(line.get_xdata())]

    assert dashes(rotation) == ["--"] * 3
    assert dashes(along_x) == ["-"] * 3
    assert dashes(along_y) == ["-", "--", "--"]


def test_differences_are_those_of_rounding() -> None:
    found = paper.compare({name: Path(name) for name in PANELS})
    assert [row.figure for row in found] == list(range(3, 12))
    assert [row.unit for row in found] == ["m", "m/s", "m/s²"] * 3
    assert all(row.difference < 1e-14 * row.greatest for row in found)
    assert found[0].greatest == pytest.approx(0.046410, abs=1e-6)
    assert found[8].greatest == pytest.approx(0.031657, abs=1e-6)
    worst = paper.over_all(found)
    assert worst["displacement"] == max(found[0].difference, found[3].difference, found[6].difference)


def test_a_difference_is_seen_in_its_quantity_alone() -> None:
    exact = paper.tabulated(paper.EXAMPLES[1])
    velocity = exact.velocity.copy()
    velocity[17, 2] -= 1e-6
    wrong = exact._replace(velocity=velocity)
    seen = [paper.greatest_difference(wrong, exact, quantity) for quantity in paper.QUANTITIES]
    assert seen == pytest.approx([0.0, 1e-6, 0.0])


def test_json_names_differences_and_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pictures: dict[str, Path]
) -> None:
    monkeypatch.setattr(paper, "write", lambda *_: pictures)
    assert paper.main(["--output", str(tmp_path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [row["figure"] for row in said["figures"]] == list(range(3, 12))
    assert set(said["differences"]) == {"displacement", "velocity", "acceleration"}
    assert all(Path(row["picture"]).exists() for row in [*said["figures"], {"picture": said["paper"]}])

    assert paper.main(["--output", str(tmp_path)]) == 0
    words = capsys.readouterr().out.splitlines()
    assert len(words) == 1 + 9 + 3 + 1
    assert words[1].split()[:3] == ["3", "rotation", "displacement"]


def test_errors_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pictures: dict[str, Path]
) -> None:
    taken = tmp_path / "taken"
    taken.write_text("a file")
    assert paper.main(["--output", str(taken)]) == 1
    assert capsys.readouterr().err == f"paper: cannot write pictures to {taken}: File exists\n"

    monkeypatch.setattr(paper, "write", lambda *_: pictures)
    monkeypatch.setattr(paper, "TABLES", tmp_path)
    assert paper.main([]) == 1
    assert capsys.readouterr().err == f"paper: {tmp_path}/paper_rotation.csv: No such file or directory\n"
