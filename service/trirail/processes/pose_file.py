"""File of taught poses in the service's state directory. A power cut during a write does not damage the file."""

from __future__ import annotations

import fcntl
import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import msgspec
from trirail_drivers import files
from trirail_drivers.errors import FileError

from trirail.errors import ServiceError
from trirail.wire.decoding import INVALID, decoded, prepare
from trirail.wire.goal_kind import Coordinate, Coordinates, PoseName

NAME = "poses.json"


class TaughtPose(NamedTuple):
    """Taught pose, which the file stores as an array."""

    x: Coordinate
    """[m]."""
    y: Coordinate
    """[m]."""
    phi: Coordinate
    """[rad]."""
    geometry: str = ""
    """Checksum of the [geometry] and of the correction map with which the pose was taught, from
    `corrected_geometry_of`; "" in files of earlier versions."""

    @property
    def pose(self) -> Coordinates:
        """x, y [m] and phi [rad]."""
        return self.x, self.y, self.phi


Taught = dict[PoseName, TaughtPose]
"""Taught poses by name."""
prepare(Taught)


def state_directory(robot: str) -> Path:
    """Return the directory of a robot's persistent data.

    It is in the state directory of the systemd unit if there is one, otherwise in that of the user. Raises ServiceError
    if the user has neither.
    """
    of_unit = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if of_unit:
        return Path(of_unit) / robot
    try:
        base = os.environ.get("XDG_STATE_HOME") or files.expand_home("~/.local/state")
    except FileError as error:
        raise ServiceError(f"{error}, or set STATE_DIRECTORY to the folder of the taught poses") from error
    return Path(base) / "trirail" / robot


def may_pass(error: ServiceError) -> bool:
    """Return True if the system could not read the file, so that its content may be valid."""
    cause = error.__cause__
    return isinstance(cause.__cause__ if isinstance(cause, FileError) else cause, OSError)


class PoseFile:
    """File of taught poses. `read` and `change` raise ServiceError, whose message contains the path of the file."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME

    def read(self) -> Taught:
        """Return the taught poses; an empty dict if there is no file."""
        try:
            return decoded(files.text(self.path), Taught) if self.path.exists() else {}
        except (FileError, OSError) as error:
            raise ServiceError(f"{error}; this file holds the taught poses") from error
        except INVALID as error:
            problem = str(error).replace("`", "")
            raise ServiceError(
                f"{self.path}: {problem}; repair the file, or move it away and teach the poses again"
            ) from error

    def set_aside(self) -> Path:
        """Rename the file to an unused name and return the new path. Raises OSError if that fails."""
        with _alone_in(self.path.parent):
            names = (self.path.with_name(f"{NAME}.broken{number or ''}") for number in itertools.count())
            aside = next(name for name in names if not os.path.lexists(name))
            self.path.rename(aside)
        return aside

    def is_gone(self) -> bool:
        """Return True if the file does not exist although its folder exists, because the file was deleted or moved.

        Removing the last pose does not delete the file, and a first change that fails does not leave the folder. A file
        that cannot be looked up, for example because a network folder does not respond, is not gone.
        """
        try:
            self.path.stat()
        except FileNotFoundError:
            return os.path.isdir(self.path.parent)
        except OSError:
            return False
        return False

    def change(self, name: str, pose: TaughtPose | None, known: Taught | None = None) -> None:
        """Save a pose under a name, or remove a pose. Return when the change has been written to the disk.

        Poses that another service of the same robot has written in the meantime stay in the file.

        Parameters
        ----------
        pose
            Pose to save; None to remove the pose with this name.
        known
            Poses to write in addition if the file has been deleted.

        """
        is_first = False
        try:
            is_first = not self.path.parent.is_dir()
            files.make_folder(self.path.parent)
            with _alone_in(self.path.parent):
                there = self.read() if self.path.exists() else known or {}
                taught = {each: kept for each, kept in there.items() if each != name}
                if pose is not None:
                    taught[name] = pose
                content = msgspec.json.encode(dict(sorted(taught.items())))
                files.replace(self.path, msgspec.json.format(content) + b"\n")
        except OSError as error:
            if is_first:
                # An empty folder would mean that poses are lost, see `is_gone`. It stays if it contains anything.
                with suppress(OSError):
                    self.path.parent.rmdir()
            raise ServiceError(f"{error.filename or self.path}: {error.strerror}") from error


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Lock a folder within the context, so that no other process changes the file at the same time."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
