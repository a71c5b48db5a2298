"""Reading and writing of camera calibration files in JSON."""

from __future__ import annotations

import stat
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from msgspec import structs
from trirail_drivers import files
from trirail_drivers.errors import FileError

from trirail.alignment.camera_calibration import CameraCalibration, Marks, separate_noises
from trirail.alignment.images import Pair
from trirail.wire.decoding import INVALID, decoded, prepare

VERSION: Literal[1] = 1
MAX_CONDITION = 1e6
"""Condition number of the matrix of a view above which it maps the table to a line."""


class CalibrationFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a camera calibration file."""

    version: Literal[1]
    robot: str
    made: datetime
    """Time of the calibration, with its time zone."""
    calibration: CameraCalibration
    targets: dict[str, Pair] = {}
    """Targets of the marks [pixel]; before targets are taught, the marks' pixels at the calibration's first look."""
    geometry: str = ""
    """Checksum of the robot's [geometry] during the calibration; "" if an earlier version wrote the file without it."""

    def is_of_geometry(self, geometry: str) -> bool:
        """Return True if the calibration was made with this geometry, or if the file does not contain the geometry."""
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
    """Write a calibration file atomically: after a power cut, the file has its old or its new content.

    Raises FileError.
    """
    content = CalibrationFile(VERSION, robot, made or datetime.now(UTC), calibration, dict(targets), geometry)
    try:
        files.replace(path, msgspec.json.format(msgspec.json.encode(content)) + b"\n")
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error


def check_replaceable(path: Path) -> None:
    """Raise FileError unless a calibration can be written to a file, so that this is known before the stage moves.

    Its folder must exist, and an existing file must be a calibration, which may be damaged.
    """
    if not path.parent.is_dir():
        raise FileError(f"{path}: there is no folder {path.parent}")
    if not path.exists():
        return
    content = files.text(path, "replace").strip()
    if content and not (content.startswith("{") and '"calibration"' in content):
        raise FileError(f"{path} already exists and is not a camera calibration; choose another file, or remove it")


def keep_old(path: Path) -> Path | None:
    """Copy a calibration file to NAME.old to preserve the taught targets; return the path of the copy.

    Return None if there is no file. Raises FileError.
    """
    if not path.exists():
        return None
    old = path.with_name(f"{path.name}.old")
    try:
        files.replace(old, path.read_bytes(), stat.S_IMODE(path.stat().st_mode))
    except OSError as error:
        raise FileError(f"cannot copy {path} to {old}: {error.strerror}") from error
    return old


def _problem(calibration: CameraCalibration) -> str | None:
    """Return the first contradiction in a calibration, which a damaged or edited file can contain; None if valid."""
    if not calibration.marks or not calibration.poses or calibration.looks < 1:
        return "calibration: expected at least one mark, one pose and one picture a look"
    for name, mark in calibration.marks.items():
        if mark.view not in calibration.views:
            return f"calibration.marks: mark {name} has the unknown view {mark.view}"
    for name, view in calibration.views.items():
        shown = sum(mark.view == name for mark in calibration.marks.values())
        covariance = calibration.covariances.get(name, ())
        # In a calibration of the geometry, the unknowns also include the centre of a radial lens.
        sizes = {6 + bend + 2 * shown for bend in {"affine": (0,), "perspective": (2,), "radial": (1, 3)}[view.lens]}
        if len(covariance) not in sizes or any(len(row) != len(covariance) for row in covariance):
            return f"calibration.covariances: that of view {name} does not fit its lens and its marks"
        if np.linalg.cond(view.matrix) > MAX_CONDITION:
            return f"calibration.views: the matrix of view {name} is singular"
    if min([calibration.noise, *calibration.noises.values()]) < 0.0:
        return "calibration: a noise is negative"
    return None


def read(path: Path) -> CalibrationFile:
    """Read a calibration file. Raises FileError that names the file, the field and the expected value."""
    if not path.exists():
        raise FileError(f"{path}: no such file; create it with trirail align calibrate")
    text = files.text(path)
    try:
        content = decoded(text, CalibrationFile)
    except INVALID as error:
        problem = str(error).replace("`", "")
        raise FileError(f"{path}: {problem}; create it again with trirail align calibrate") from error
    if defect := _problem(content.calibration):
        raise FileError(f"{path}: {defect}; create it again with trirail align calibrate")
    if content.calibration.noises:
        return content
    # Earlier versions wrote one noise for all views, from which all covariances follow.
    return structs.replace(content, calibration=separate_noises(content.calibration))
