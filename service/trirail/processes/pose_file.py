"""File of taught poses in the service's state directory; a power cut during a write leaves it intact."""

from __future__ import annotations

import fcntl
import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import msgspec
from trirail_drivers import files
from trirail_drivers.errors import FileError

from trirail.errors import ServiceError
from trirail.wire.decoding import decoded, prepare
from trirail.wire.goal_kind import Coordinate, Coordinates, PoseName

NAME = "poses.json"


class TaughtPose(NamedTuple):
    """Taught pose; stored as an array in the file."""

    x: Coordinate
    """[m]."""
    y: Coordinate
    """[m]."""
    phi: Coordinate
    """[rad]."""
    geometry: str = ""
    """Checksum of the [geometry] with which the pose was taught; "" in files of earlier versions."""

    @property
    def pose(self) -> Coordinates:
        """x, y [m] and phi [rad]."""
        return self.x, self.y, self.phi


Taught = dict[PoseName, TaughtPose]
"""Taught poses by name."""
prepare(Taught)


def state_directory(robot: str) -> Path:
    """Return the directory of a robot's persistent data: in systemd's state directory, if set, else in the user's."""
    of_unit = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if of_unit:
        return Path(of_unit) / robot
    base = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    return Path(base) / "trirail" / robot


class PoseFile:
    """File of taught poses; `read` and `change` raise ServiceError with the path and the remedy."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME

    def read(self) -> Taught:
        """Return the taught poses; none if there is no file."""
        try:
            return decoded(files.text(self.path), Taught) if self.path.exists() else {}
        except (FileError, OSError) as error:
            raise ServiceError(f"{error}; this file holds the taught poses") from error
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            problem = str(error).replace("`", "")
            raise ServiceError(
                f"{self.path}: {problem}; repair the file, or move it away and teach the poses again"
            ) from error

    def set_aside(self) -> Path:
        """Rename the file without replacing another one; return the new path. Raises OSError."""
        with _alone_in(self.path.parent):
            names = (self.path.with_name(f"{NAME}.broken{number or ''}") for number in itertools.count())
            aside = next(name for name in names if not os.path.lexists(name))
            self.path.rename(aside)
        return aside

    @property
    def gone(self) -> bool:
        """Whether the file was deleted or moved away.

        Its folder must exist; removing the last pose does not delete it.
        """
        return self.path.parent.is_dir() and not self.path.exists()

    def change(self, name: str, pose: TaughtPose | None, known: Taught | None = None) -> None:
        """Save a pose under a name, or remove the name; return once the change is on the disk.

        Poses that another service of the same robot has written in the meantime are kept.

        Parameters
        ----------
        pose
            Pose to save; None to remove the name.
        known
            Poses to write as well if the file has been deleted.

        """
        try:
            files.make_folder(self.path.parent)
            with _alone_in(self.path.parent):
                there = self.read() if self.path.exists() else known or {}
                taught = {each: kept for each, kept in there.items() if each != name}
                if pose is not None:
                    taught[name] = pose
                content = msgspec.json.encode(dict(sorted(taught.items())))
                files.replace(self.path, msgspec.json.format(content) + b"\n")
        except OSError as error:
            raise ServiceError(f"{error.filename or self.path}: {error.strerror}") from error


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Lock a folder against other callers."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
