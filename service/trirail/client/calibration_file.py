"""File of a camera calibration, in JSON: version, date, robot, and the looks from which it was computed."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import msgspec
from trirail_drivers import files
from trirail_drivers.errors import FileError

from trirail.alignment.camera_calibration import CameraCalibration, Marks
from trirail.alignment.images import Pair
from trirail.wire.decoding import decoded, prepare

VERSION: Literal[1] = 1


class CalibrationFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of the file."""

    version: Literal[1]
    robot: str
    made: datetime
    """Time of the calibration, with its time zone."""
    calibration: CameraCalibration
    targets: dict[str, Pair] = {}
    """Targets of the marks [pixel]: their pixels at the calibration's first look, until others are taught."""
    geometry: str = ""
    """Checksum of the [geometry] of the calibration; "" where an earlier version did not note it."""

    def is_of_geometry(self, geometry: str) -> bool:
        """True unless the calibration was made with another geometry."""
        return self.geometry in ("", geometry)


prepare(CalibrationFile)


def write(
    path: Path,
    robot: str,
    calibration: CameraCalibration,
    targets: Marks,
    made: datetime | None = None,
    geometry: str = "",
) -> None:
    """Write the file atomically, so that a power cut leaves the old or the new one. Raises FileError."""
    content = CalibrationFile(VERSION, robot, made or datetime.now(UTC), calibration, dict(targets), geometry)
    try:
        files.replace(path, msgspec.json.format(msgspec.json.encode(content)) + b"\n")
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error


def keep_old(path: Path) -> Path | None:
    """Save a copy of an existing file as NAME.old, for the taught targets; return its path. Raises FileError.

    Return None if there is no file.
    """
    if not path.exists():
        return None
    old = path.with_name(f"{path.name}.old")
    try:
        return Path(shutil.copy2(path, old))
    except OSError as error:
        raise FileError(f"cannot copy {path} to {old}: {error.strerror}") from error


def read(path: Path) -> CalibrationFile:
    """Read the file. Raises FileError with the file, the field and the expected value."""
    if not path.exists():
        raise FileError(f"{path}: no such file; create it with trirail align calibrate")
    text = files.text(path)
    try:
        return decoded(text, CalibrationFile)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        problem = str(error).replace("`", "")
        raise FileError(f"{path}: {problem}; create it again with trirail align calibrate") from error
