"""Timed trajectories from files: CSV or JSON."""

from __future__ import annotations

import csv
from pathlib import Path

import msgspec
from trirail_drivers import files

from trirail.errors import TrirailError
from trirail.wire.messages import TrajectoryPoint
from trirail.wire.text import quoted

COLUMNS = ("t", "x", "y", "phi")
VELOCITY, ACCELERATION = ("vx", "vy", "w"), ("ax", "ay", "e")


def read(path: Path) -> list[TrajectoryPoint]:
    """Read the points of a trajectory. Raises TrirailError with file, line and what would be right."""
    text = files.text(path)
    if path.suffix == ".json":
        try:
            return msgspec.json.decode(text, type=list[TrajectoryPoint])
        except RecursionError as error:
            raise TrirailError(f"{path}: nested too deep; a list of points is wanted") from error
        except (msgspec.MsgspecError, ValueError) as error:
            raise TrirailError(f"{path}: {quoted(str(error).replace('`', ''))}") from error
    try:
        return _from_csv(path, text)
    except csv.Error as error:
        raise TrirailError(f"{path}: not CSV: {error}") from error


def _from_csv(path: Path, text: str) -> list[TrajectoryPoint]:
    rows = csv.DictReader(text.splitlines())
    names = [name.strip() for name in rows.fieldnames or ()]
    allowed = {*COLUMNS, *VELOCITY, *ACCELERATION}
    if not set(COLUMNS) <= set(names) <= allowed:
        raise TrirailError(
            f"{path}: line 1: columns {quoted(', '.join(names)) or 'none'}; wanted {', '.join(COLUMNS)}, "
            f"and if known {', '.join((*VELOCITY, *ACCELERATION))}"
        )
    points = []
    for row in rows:
        try:
            values = {name.strip(): float(value) for name, value in row.items()}
            points.append(
                TrajectoryPoint(
                    **{name: values[name] for name in COLUMNS},
                    velocity=_triple(values, VELOCITY),
                    acceleration=_triple(values, ACCELERATION),
                )
            )
        except (TypeError, ValueError, AttributeError) as error:
            raise TrirailError(f"{path}: line {rows.line_num}: {quoted(str(error))}") from error
    return points


def _triple(values: dict[str, float], names: tuple[str, str, str]) -> tuple[float, float, float] | None:
    if not all(name in values for name in names):
        return None
    a, b, c = (values[name] for name in names)
    return a, b, c
