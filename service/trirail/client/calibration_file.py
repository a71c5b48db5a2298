"""The file of a camera calibration: JSON, of a version, with its date, the robot, and the looks that made it."""

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
    """What is in it."""

    version: Literal[1]
    robot: str
    made: datetime
    """With its time zone."""
    calibration: CameraCalibration
    targets: dict[str, Pair] = {}
    """Where marks should be [pixel]: where they were at the calibration's first look, until others are taught."""


prepare(CalibrationFile)


def write(path: Path, robot: str, calibration: CameraCalibration, targets: Marks, made: datetime | None = None) -> None:
    """Write it such that a power cut leaves the old file or the new one. Raises FileError."""
    content = CalibrationFile(VERSION, robot, made or datetime.now(UTC), calibration, dict(targets))
    try:
        files.replace(path, msgspec.json.format(msgspec.json.encode(content)) + b"\n")
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error


def keep_old(path: Path) -> Path | None:
    """Keep the file that is there beside it, as NAME.old, for targets that were taught; return that. Raises FileError.

    None where there is none.
    """
    if not path.exists():
        return None
    old = path.with_name(f"{path.name}.old")
    try:
        return Path(shutil.copy2(path, old))
    except OSError as error:
        raise FileError(f"cannot keep {path} as {old}: {error.strerror}") from error


def read(path: Path) -> CalibrationFile:
    """Read it. Raises FileError with the file, the field and what would be right."""
    if not path.exists():
        raise FileError(f"{path}: no such file; trirail align calibrate makes it")
    text = files.text(path)
    try:
        return decoded(text, CalibrationFile)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        problem = str(error).replace("`", "")
        raise FileError(f"{path}: {problem}; make it anew with trirail align calibrate") from error
