"""Trajectories from files: read as written, or refused with file, line, column and what would be right."""

from __future__ import annotations

import json
import math
import re
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from trirail.client.outgoing import too_many
from trirail.client.trajectory import points_of, read
from trirail.errors import RefusedError, TrirailError
from trirail.wire.goals import TrajectoryGoal, TrajectoryPoint
from trirail.wire.sizes import MAX_POINTS

HEAD = ("t", "x", "y", "phi", "vx", "vy", "w")
NUMBER = st.floats(-100.0, 100.0)
ROWS = st.lists(st.tuples(*(NUMBER,) * len(HEAD)), min_size=2, max_size=5)


def csv_of(rows: list[list[str]], head: tuple[str, ...] = HEAD) -> str:
    return "\n".join(",".join(row) for row in (head, *rows)) + "\n"


def read_text(text: str, name: str = "path.csv") -> list[TrajectoryPoint]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_text(text)
        return read(path)


@given(ROWS)
def test_what_is_written_is_read(rows: list[tuple[float, ...]]) -> None:
    points = read_text(csv_of([[repr(value) for value in row] for row in rows]))
    assert [(each.t, each.x, each.y, each.phi, *(each.velocity or ())) for each in points] == rows


@given(ROWS, st.data())
def test_a_row_that_is_too_short_or_too_long_is_named(rows: list[tuple[float, ...]], data: st.DataObject) -> None:
    cells = [[repr(value) for value in row] for row in rows]
    line = data.draw(st.integers(0, len(rows) - 1))
    count = data.draw(st.integers(1, 9).filter(lambda count: count != len(HEAD)))
    cells[line] = (cells[line] * 2)[:count]
    with pytest.raises(TrirailError, match=rf"path\.csv: line {line + 2}: {count} columns; expected 7$"):
        read_text(csv_of(cells))


@given(ROWS, st.data(), st.sampled_from(["mm", "deg", "s", " m"]))
def test_a_cell_that_is_no_number_is_named(rows: list[tuple[float, ...]], data: st.DataObject, unit: str) -> None:
    cells = [[repr(value) for value in row] for row in rows]
    line, column = data.draw(st.integers(0, len(rows) - 1)), data.draw(st.integers(0, len(HEAD) - 1))
    wrong = cells[line][column] = data.draw(
        st.sampled_from(["10" + unit, "x", "nan", "inf", "", "0_5", "\u0661", "1e400", "0x1"])
    )
    with pytest.raises(TrirailError) as refused:
        read_text(csv_of(cells))
    where = f"path.csv: line {line + 2}, column {HEAD[column]}: {wrong!r} is not a number"
    assert f"{where}; write numbers without units, in metres, radians and seconds" in str(refused.value)


@pytest.mark.parametrize("rows", [0, 1])
def test_a_trajectory_of_fewer_than_two_points_is_told_by_its_file(rows: int) -> None:
    said = rf"path\.(csv|json): {('no points', 'one point')[rows]}: a trajectory needs at least 2"
    with pytest.raises(TrirailError, match=said):
        read_text(csv_of([["0"] * len(HEAD)] * rows))
    with pytest.raises(TrirailError, match=said):
        read_text(json.dumps([{"t": 0.0, "x": 0.0, "y": 0.0, "phi": 0.0}] * rows), "path.json")


@pytest.mark.parametrize("head", ["t,x,y", "t,x,y,phi,vx", "t,x,y,phi,vx,vy,w,ax", "t,t,x,y,phi", "t,x,y,phi,z", ""])
def test_columns_are_those_that_there_are_each_once_and_by_threes(head: str) -> None:
    with pytest.raises(TrirailError, match=r"line 1: columns .*; expected t, x, y, phi, and if known vx, vy, w and"):
        read_text(head + "\n")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("path.csv", "t,x,y,phi\n" + "9" * 200_000, "not CSV: field larger than field limit"),
        ("path.csv", "t;x;y;phi\n0;0;0;0", "expected t, x, y, phi, .*; separate columns with commas"),
        ("path.json", "[" * 100_000, "Expected object, got array"),
        ("path.json", '[{"t": ' + "[" * 100_000, "Expected float, got array"),
        ("path.json", '[{"z": ' + "[" * 100_000, "Object contains unknown field z"),
        ("path.json", '[{"t": 1' + "0" * 5000 + "}]", "Number out of range"),
        ("path.json", "t,x,y,phi", "JSON is malformed"),
    ],
)
def test_what_a_file_has_instead_of_points_is_told_in_one_line(name: str, text: str, said: str) -> None:
    with pytest.raises(TrirailError, match=rf"\A\S*{name}: .*\Z") as refused:
        read_text(text, name)
    assert re.search(said, str(refused.value))


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (3, "points: 3 has no accepted format"),
        (None, "points: None has no accepted format"),
        ([3], r"points: \[3\] has no accepted format"),
        ([()], r"points: row 0 is \(\); expected"),
        (["0123"], "points: row 0 is '0123'; expected"),
        ([(0, 0, 0)], "points: row 0 is 3 values; expected"),
        ([(0, 0, 0, 0), (1, 0, math.nan, 0)], "points: y of row 1 is nan: expected a finite number"),
        ([(0, 0, 0, "0")], "points: phi of row 0 is '0': expected a finite number"),
        ([(10**400, 0, 0, 0)], "points: t of row 0 is 1000.*: expected a finite number"),
    ],
)
def test_what_a_program_gives_instead_of_points_is_told(points: Any, said: str) -> None:
    with pytest.raises(RefusedError, match=f"^{said}"):
        points_of(points)


@pytest.mark.parametrize("number", [5001, 12_000])
def test_more_points_than_fit_are_refused_before_sending_with_both_numbers(tmp_path: Path, number: int) -> None:
    rows = [(0.01 * n, 0.0, 0.0, 0.0) for n in range(number)]
    path = tmp_path / "path.csv"
    path.write_text("t,x,y,phi\n" + "".join(f"{t},{x},{y},{phi}\n" for t, x, y, phi in rows))
    for points in (rows, path):
        with pytest.raises(TrirailError, match=rf"{number} points exceed the maximum of 5000: send one in "):
            points_of(points)


@given(st.integers(MAX_POINTS + 1, 100 * MAX_POINTS))
@example(2 * MAX_POINTS)
def test_as_many_points_as_the_refusal_advises_fit(number: int) -> None:
    advice = re.search(r"send one in (\d+) points and the last", too_many(number))
    assert advice is not None
    assert len({*range(0, number, int(advice[1])), number - 1}) <= MAX_POINTS


@pytest.mark.parametrize("begins", [-86_400.5, 1e6, 1_795_245_300.25])
def test_time_counts_from_the_first_point_whatever_clock_it_is_of(begins: float) -> None:
    points = points_of([(begins + 0.5 * n, 0.001 * n, 0.0, 0.0) for n in range(3)])
    assert [point.t - begins for point in TrajectoryGoal(points).points] == [0.0, 0.5, 1.0]
    with pytest.raises(ValueError, match="the trajectory lasts 86401 s, the maximum is 86400 s"):
        TrajectoryGoal(points_of([(begins, 0.0, 0.0, 0.0), (begins + 86_401.0, 0.0, 0.0, 0.0)]))
