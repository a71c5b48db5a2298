"""Conversion of points, rows of numbers, and CSV or JSON files to timed trajectories."""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
from msgspec import structs
from trirail_drivers import files

from trirail.client.goal import Result
from trirail.client.outgoing import number, too_many
from trirail.errors import RefusalCode, RefusedError, TrirailError
from trirail.wire.decoding import decoded, prepare
from trirail.wire.goals import PoseGoal, TrajectoryPoint
from trirail.wire.text import number as number_in
from trirail.wire.text import quoted

COLUMNS = ("t", "x", "y", "phi")
Points = str | os.PathLike[str] | Iterable[TrajectoryPoint | Iterable[float]]
POINTS_FORMAT = (
    "TrajectoryPoints, rows of t [s], x, y [m], phi [rad], as an array (N, 4), or the path of a CSV or JSON file"
)
MIN_POINTS = 2
"""Minimum number of points of a trajectory; the first point is the robot's pose at the start."""
prepare(list[TrajectoryPoint])
VELOCITY, ACCELERATION = ("vx", "vy", "w"), ("ax", "ay", "e")


def points_of(source: Points) -> tuple[TrajectoryPoint, ...]:
    """Return the points of a trajectory. Raises TrirailError if the source is invalid.

    `source` may be a sequence of points, an array with rows of t [s], x, y [m], phi [rad], or the path of a file.
    """
    if isinstance(source, str | os.PathLike):
        return tuple(read(Path(source)))
    try:
        points = tuple(itertools.starmap(_point_of, enumerate(source)))
    except TypeError as error:
        raise RefusedError(
            RefusalCode.MALFORMED, f"points: {quoted(repr(source))} has no accepted format; expected {POINTS_FORMAT}"
        ) from error
    if why := too_many(len(points)):
        raise RefusedError(RefusalCode.MALFORMED, f"points: {why}")
    return points


def _point_of(n: int, row: TrajectoryPoint | Iterable[float]) -> TrajectoryPoint:
    """Convert a row of numbers to a point; return a point unchanged, but with its time as a float.

    Raises TypeError if the row is not iterable, and RefusedError if its values are invalid.
    """
    if isinstance(row, TrajectoryPoint):  # a goal computes with the times of its points
        return row if isinstance(row.t, float) else structs.replace(row, t=number(row.t, f"points: t of point {n}"))
    values = [] if isinstance(row, str | bytes | Mapping) else list(row)
    if len(values) != len(COLUMNS):
        actual = f"{len(values)} values" if values else quoted(repr(row))
        raise RefusedError(RefusalCode.MALFORMED, f"points: row {n} is {actual}; expected {POINTS_FORMAT}")
    t, x, y, phi = (number(value, f"points: {name} of row {n}") for name, value in zip(COLUMNS, values, strict=True))
    return TrajectoryPoint(t, x, y, phi)


def first_pose(points: Sequence[TrajectoryPoint]) -> Callable[[str], PoseGoal]:
    """Return a function that takes a goal id and returns the goal to the first pose of a trajectory.

    Raises RefusedError if the trajectory has no points.
    """
    if not points:
        raise RefusedError(RefusalCode.MALFORMED, f"points: the list is empty; expected {POINTS_FORMAT}")
    x, y, phi = points[0].x, points[0].y, points[0].phi
    return lambda name: PoseGoal(x=x, y=y, phi=phi, id=name)


def check_arrived(result: Result) -> None:
    """Raise RefusedError if the outcome of the goal to a trajectory's first point is not done."""
    if result.outcome != "done":
        text = f"the trajectory was not sent, because the robot did not reach its first point: {result.message}"
        raise RefusedError(RefusalCode.WRONG_START, text)


def read(path: Path) -> list[TrajectoryPoint]:
    """Read the points of a trajectory file.

    Raises TrirailError that names the file, the line and the expected value.
    """
    return parse(path, files.text(path))


def parse(name: Path | str, text: str) -> list[TrajectoryPoint]:
    """Parse the content of a trajectory file, as JSON if the file's name ends in .json, otherwise as CSV.

    Raises TrirailError if the content is invalid.
    """
    path = Path(name)
    points = _points(path, text)
    if len(points) < MIN_POINTS:
        raise TrirailError(
            f"{path}: {'one point' if points else 'no points'}: a trajectory needs at least {MIN_POINTS}"
        )
    if why := too_many(len(points)):
        raise TrirailError(f"{path}: {why}")
    return points


def _points(path: Path, text: str) -> list[TrajectoryPoint]:
    if path.suffix == ".json":
        try:
            return decoded(text, list[TrajectoryPoint])
        except (msgspec.MsgspecError, ValueError) as error:
            raise TrirailError(f"{path}: {quoted(str(error).replace('`', ''))}") from error
    try:
        return _from_csv(path, text)
    except csv.Error as error:
        raise TrirailError(f"{path}: not CSV: {error}") from error


def _from_csv(path: Path, text: str) -> list[TrajectoryPoint]:
    rows = csv.reader(text.splitlines())
    names = [name.strip() for name in next(rows, ())]
    allowed = {*COLUMNS, *VELOCITY, *ACCELERATION}
    whole = all(not set(group) & set(names) or set(group) <= set(names) for group in (VELOCITY, ACCELERATION))
    if not set(COLUMNS) <= set(names) <= allowed or len(set(names)) < len(names) or not whole:
        raise TrirailError(
            f"{path}: line 1: columns {quoted(', '.join(names)) or 'none'}; expected {', '.join(COLUMNS)}, "
            f"and if known {', '.join(VELOCITY)} and {', '.join(ACCELERATION)}, each once"
            + (
                "; separate columns with commas, and write numbers with a decimal point"
                if ";" in "".join(names)
                else ""
            )
        )
    points = []
    for row in rows:
        if not row:
            continue
        values = _numbers(f"{path}: line {rows.line_num}", names, row)
        points.append(
            TrajectoryPoint(
                **{name: values[name] for name in COLUMNS},
                velocity=_triple(values, VELOCITY),
                acceleration=_triple(values, ACCELERATION),
            )
        )
    return points


def _numbers(where: str, names: Sequence[str], row: Sequence[str]) -> dict[str, float]:
    """Return the numbers of a row by column name. Raises TrirailError if the row is invalid."""
    if len(row) != len(names):
        raise TrirailError(f"{where}: {len(row)} columns; expected {len(names)}")
    values = {}
    for name, cell in zip(names, row, strict=True):
        try:
            values[name] = number_in(cell)
        except ValueError as error:
            what = f"{where}, column {name}: {error}; write numbers without units, in metres, radians and seconds"
            raise TrirailError(what) from error
    return values


def _triple(values: dict[str, float], names: tuple[str, str, str]) -> tuple[float, float, float] | None:
    if not all(name in values for name in names):
        return None
    a, b, c = (values[name] for name in names)
    return a, b, c
