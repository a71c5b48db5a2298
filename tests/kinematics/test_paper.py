"""The tool that draws the paper's figures: what it draws and what it says of the difference from the tables."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import paper
import paper_figures
import paper_motions
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from paper_motions import EXAMPLES, QUANTITIES, Curves, computed
from paper_service import Driven
from trirail.errors import RefusalCode, RefusedError
from trirail.telemetry.palette import SLIDERS

PANELS = [f"figure_{number:02}" for number in range(3, 12)]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return drawn(tmp_path_factory.mktemp("paper"), {})


def drawn(folder: Path, service: dict[str, Curves]) -> dict[str, Path]:
    t = np.linspace(0.0, paper_motions.DURATION, 301)
    return paper_figures.write(folder, {each: computed(each, t) for each in EXAMPLES}, service)


def driven(off: tuple[float, float, float] = (0.0, 0.0, 0.0), lag: float = 0.0) -> dict[str, Driven]:
    """What a service would record whose setpoints are off by so much, and whose sliders by so much more."""
    t = np.arange(1.0, 3001.0) * 1e-3
    made = {}
    for each in EXAMPLES:
        _, *exact = computed(each, t)
        curves = Curves(t, *(values + value for values, value in zip(exact, off, strict=True)))
        made[each.name] = Driven(curves, curves.position - lag)
    return made


def test_the_figures_are_the_papers() -> None:
    shown = {number: (example.name, quantity.name) for number, example, quantity in paper_motions.figures()}
    assert sorted(shown) == list(range(3, 12))
    assert shown[3] == ("rotation", "displacement")
    assert shown[5] == ("rotation", "acceleration")
    assert shown[7] == ("translation_x", "velocity")
    assert shown[11] == ("translation_y", "acceleration")


@pytest.mark.parametrize("name", [*PANELS, "paper"])
@pytest.mark.long
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
    rotation, along_x, along_y = (computed(each, np.linspace(0.0, 3.0, 7)) for each in EXAMPLES)

    def dashes(curves: Curves) -> list[str]:
        axes = Figure().subplots()
        paper_figures.plot(axes, QUANTITIES[0], curves)
        return [str(line.get_linestyle()) for line in axes.get_lines() if np.size(line.get_xdata())]

    assert dashes(rotation) == ["--"] * 3
    assert dashes(along_x) == ["-"] * 3
    assert dashes(along_y) == ["-", "--", "--"]


def test_the_services_circles_lie_on_the_lines_in_turn() -> None:
    service = driven()
    for example, count in zip(EXAMPLES, ([8, 8, 8], [24, 24, 24], [24, 12, 12]), strict=True):
        axes = Figure().subplots()
        paper_figures.plot(axes, QUANTITIES[0], computed(example, np.linspace(0.0, 3.0, 7)), service[example.name][0])
        circles = [line for line in axes.get_lines() if line.get_marker() == "o"]
        assert [np.size(line.get_xdata()) for line in circles] == count
        times = np.unique(np.concatenate([np.asarray(line.get_xdata()) for line in circles]))
        assert times == pytest.approx(np.arange(1, 25) * 0.125)
        for i, line in enumerate(circles):
            exact = computed(example, np.asarray(line.get_xdata())).position[:, i]
            assert np.asarray(line.get_ydata()) == pytest.approx(exact, abs=1e-15)


def test_a_figure_says_how_far_the_service_is_off() -> None:
    example, quantity = EXAMPLES[2], QUANTITIES[1]
    axes = Figure().subplots()
    curves = driven()[example.name].commanded
    paper_figures.draw(axes, "", quantity, curves, curves, 3.24e-9)
    assert [text.get_text() for text in axes.texts] == [
        r"service − computed: $3.2\cdot10^{-9}$ m/s at most",
    ]


@pytest.mark.long
def test_pictures_with_the_service_differ(tmp_path: Path, pictures: dict[str, Path]) -> None:
    with_service = drawn(tmp_path, {name: done.commanded for name, done in driven().items()})
    assert with_service.keys() == pictures.keys()
    for name, path in with_service.items():
        assert path.read_bytes() != pictures[name].read_bytes()


def test_differences_are_those_of_rounding() -> None:
    found = paper.compare({name: Path(name) for name in PANELS}, {})
    assert [row.figure for row in found] == list(range(3, 12))
    assert [row.unit for row in found] == ["m", "m/s", "m/s²"] * 3
    assert all(row.difference < 1e-14 * row.greatest for row in found)
    assert all(row.service is row.measured is None for row in found)
    assert found[0].greatest == pytest.approx(0.046410, abs=1e-6)
    assert found[8].greatest == pytest.approx(0.031657, abs=1e-6)
    worst = paper.over_all(found, "difference")
    assert worst["displacement"] == max(found[0].difference, found[3].difference, found[6].difference)


def test_a_difference_is_seen_in_its_quantity_alone() -> None:
    exact = paper_motions.tabulated(EXAMPLES[1])
    velocity = exact.velocity.copy()
    velocity[17, 2] -= 1e-6
    wrong = exact._replace(velocity=velocity)
    seen = [paper_motions.greatest_difference(wrong, exact, quantity) for quantity in QUANTITIES]
    assert seen == pytest.approx([0.0, 1e-6, 0.0])


def test_the_service_is_held_against_what_is_computed() -> None:
    found = paper.compare({name: Path(name) for name in PANELS}, driven((1e-6, 2e-5, -3e-4), lag=7e-5))
    assert [row.service for row in found] == pytest.approx([1e-6, 2e-5, 3e-4] * 3)
    assert [row.measured for row in found[::3]] == pytest.approx([6.9e-5] * 3)
    assert [row.measured for row in found if row.quantity != "displacement"] == [None] * 6
    assert paper.over_all(found, "service") == pytest.approx(
        {"displacement": 1e-6, "velocity": 2e-5, "acceleration": 3e-4}
    )
    assert paper.over_all(found, "measured") == pytest.approx({"displacement": 6.9e-5})


def test_json_names_differences_and_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pictures: dict[str, Path]
) -> None:
    monkeypatch.setattr(paper, "write", lambda *_: pictures)
    assert paper.main(["--output", str(tmp_path), "--offline", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [row["figure"] for row in said["figures"]] == list(range(3, 12))
    assert set(said["differences"]) == {"displacement", "velocity", "acceleration"}
    assert said["service"] == said["measured"] == {}
    assert said["recording"] is None
    assert all(Path(row["picture"]).exists() for row in [*said["figures"], {"picture": said["paper"]}])

    assert paper.main(["--output", str(tmp_path), "--offline"]) == 0
    words = capsys.readouterr().out.splitlines()
    assert len(words) == 1 + 9 + 3 + 2
    assert words[1].split()[:3] == ["3", "rotation", "displacement"]


def test_words_of_a_run_with_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pictures: dict[str, Path]
) -> None:
    monkeypatch.setattr(paper, "write", lambda *_: pictures)
    made = driven((1e-6, 2e-5, -3e-4), lag=7e-5)
    monkeypatch.setattr(paper, "drive", lambda *_: {each: made[each.name] for each in EXAMPLES})
    assert paper.main(["--output", str(tmp_path / "new")]) == 0
    words = capsys.readouterr().out
    assert words.splitlines()[1].split()[4:] == [*words.splitlines()[1].split()[4:5], "1.0e-06", "6.9e-05", "m"]
    assert words.splitlines()[12].split()[-2:] == ["3.0e-04", "m/s²"]
    assert "a jerk of\n32 m/s³, which the sliders' limit of sim.toml, 400 m/s³, allows" in words
    assert words.endswith(f"recording: {tmp_path}/new/paper.rrd\n")


def test_errors_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pictures: dict[str, Path]
) -> None:
    taken = tmp_path / "taken"
    taken.write_text("a file")
    for options in ([], ["--offline"]):
        assert paper.main(["--output", str(taken), *options]) == 1
        assert capsys.readouterr().err == f"paper: cannot write pictures to {taken}: File exists\n"

    def refuse(*_: object) -> None:
        raise RefusedError(
            RefusalCode.TOO_FAST, "the service refused rotation: the trajectory is 2 times too fast for a slider"
        )

    with monkeypatch.context() as refusing:
        refusing.setattr(paper, "drive", refuse)
        assert paper.main(["--output", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert said.err == "paper: the service refused rotation: the trajectory is 2 times too fast for a slider\n"
    assert said.out == ""

    monkeypatch.setattr(paper, "write", lambda *_: pictures)
    monkeypatch.setattr(paper_motions, "TABLES", tmp_path)
    assert paper.main(["--offline"]) == 1
    assert capsys.readouterr().err == f"paper: {tmp_path}/paper_rotation.csv: No such file or directory\n"
