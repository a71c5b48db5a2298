"""The guides' pictures show what there is: each carries a digest of the files that decide how it looks."""

from __future__ import annotations

import re
from pathlib import Path

import picture_stamps
import pytest
from picture_stamps import PICTURES, ROOT, SOURCES, digest, stamp
from PIL import Image


@pytest.mark.parametrize("name", SOURCES)
def test_no_picture_is_older_than_what_it_shows(name: str) -> None:
    assert stamp(name) == digest(name), f"{name}.png is older than what it shows: make screenshots"


def test_every_picture_of_the_guides_has_its_sources() -> None:
    guides = "".join(guide.read_text() for guide in (*ROOT.glob("*.md"), *ROOT.glob("service/*.md")))
    assert set(re.findall(r"tools/pictures/(\w+)\.png", guides)) == set(SOURCES)
    assert {file.stem for file in PICTURES.glob("*.png")} == set(SOURCES)


def test_a_file_that_changes_comes_goes_or_is_renamed_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture_stamps, "ROOT", tmp_path)
    monkeypatch.setattr(picture_stamps, "PICTURES", tmp_path)
    monkeypatch.setattr(picture_stamps, "SOURCES", {"shown": ("page/*",)})
    monkeypatch.setattr("sys.argv", ["picture_stamps.py"])
    Image.new("RGB", (8, 8)).save(tmp_path / "shown.png")
    (tmp_path / "page").mkdir()
    with pytest.raises(FileNotFoundError):
        digest("shown")
    one = tmp_path / "page/one.js"
    one.write_text("1")
    assert stamp("shown") is None
    picture_stamps.main()
    assert stamp("shown") == digest("shown")
    seen = {digest("shown")}
    for change in (
        lambda: one.write_text("2"),
        lambda: (tmp_path / "page/two.js").write_text("2"),
        lambda: one.rename(tmp_path / "page/three.js"),
    ):
        change()
        assert stamp("shown") != digest("shown")
        assert digest("shown") not in seen
        seen.add(digest("shown"))
