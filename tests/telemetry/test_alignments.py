"""Alignments in a recording: every look comes back as it was told, whatever marks are called; and in the live view."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import made
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from telemetry.test_reading import written
from trirail.analysis.summary import summarise
from trirail.telemetry.reading import read
from trirail.telemetry.shown_alignment import MOST_LOOKS, RESIDUALS, ShownAlignment
from trirail.wire.looks import AlignmentLook, SeenMark
from wire.looks import looks, told


@given(st.lists(looks, min_size=1, max_size=8))
@settings(max_examples=10)
def test_every_look_comes_back_by_its_alignment(sent: list[AlignmentLook]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.rrd")
        recorder = written(path, made.records(0.1), tuple(told(n, look) for n, look in enumerate(sent, 1)))
        recording = read(path)
        assert recorder.lost == 0
    found = recording.alignments
    assert len({(each.id, each.purpose) for each in found}) == len(found)
    for each in found:
        mine = tuple(look for look in sent if (look.id, look.purpose) == (each.id, each.purpose))
        assert (each.looks, each.user) == (mine, "ann")
        assert each.residuals.shape == (len(each.marks), len(mine))
    assert sum(len(each.looks) for each in found) == len(sent)
    assert [(each.id, each.purpose, each.end) for each in summarise(recording).alignments] == [
        (each.id, each.purpose, each.end) for each in found
    ]


def look(number: int, way: float, end: str | None = None) -> AlignmentLook:
    marks = (SeenMark("left", (1.0, 2.0), (way, 0.0)), SeenMark("a/b #", (3.0, 4.0), (0.0, -way)))
    return AlignmentLook("align-1", "alignment", number, marks, end=end)  # type: ignore[arg-type]


def test_residuals_are_of_each_mark_before_and_after(tmp_path: Path) -> None:
    before, after = look(1, 4e-4), look(2, 3e-7, "reached")
    written(tmp_path / "a.rrd", made.records(0.1), (told(5, before), told(90, after)))
    (found,) = read(tmp_path / "a.rrd").alignments
    assert found.marks == ("a/b #", "left")
    assert np.allclose(found.residuals, [[4e-4, 3e-7]] * 2, rtol=1e-12)
    assert found.end == "reached"
    assert found.t == (0.005, 0.09)


def test_the_live_view_has_a_curve_for_each_mark_and_a_table_of_the_newest_looks() -> None:
    shown = ShownAlignment()
    for number in range(1, MOST_LOOKS + 4):
        chunks = shown.drawing_of(told(number, look(number, 1e-4 / number)), look(number, 1e-4 / number))
    paths = {chunk.entity_path for chunk in chunks}
    assert {path for path in paths if path.startswith(RESIDUALS)} == {f"{RESIDUALS}/left", f"{RESIDUALS}/a\\/b\\ \\#"}
    (table,) = (chunk for chunk in chunks if chunk.entity_path not in {p for p in paths if p.startswith(RESIDUALS)})
    text = str(table.to_record_batch().column("TextDocument:text")[0])
    assert f"look {MOST_LOOKS + 3}" in text
    assert "look 3 " not in text
    assert math.isclose(1e2 / (MOST_LOOKS + 3), 9.09, abs_tol=0.01)
    assert "9.09 µm" in text
