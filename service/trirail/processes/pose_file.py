"""The file of taught poses, in the service's state directory: intact after a power cut at any time."""

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
    """A taught pose; in the file an array."""

    x: Coordinate
    """[m]."""
    y: Coordinate
    """[m]."""
    phi: Coordinate
    """[rad]."""
    geometry: str = ""
    """Checksum of the [geometry] with which it was taught; "" where an earlier version did not note it."""

    @property
    def pose(self) -> Coordinates:
        """x, y [m] and phi [rad]."""
        return self.x, self.y, self.phi


Taught = dict[PoseName, TaughtPose]
"""Taught poses by their names."""
prepare(Taught)


def state_directory(robot: str) -> Path:
    """Return the directory of a robot's lasting data: below systemd's directory for the service, else the user's."""
    of_unit = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if of_unit:
        return Path(of_unit) / robot
    base = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    return Path(base) / "trirail" / robot


class PoseFile:
    """Access to the file. Reading and changing raise ServiceError, with the file and the remedy."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME

    def read(self) -> Taught:
        """Return the taught poses; none if there is no file yet."""
        try:
            return decoded(files.text(self.path), Taught) if self.path.exists() else {}
        except (FileError, OSError) as error:
            raise ServiceError(f"{error}; it has the taught poses") from error
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            problem = str(error).replace("`", "")
            raise ServiceError(f"{self.path}: {problem}; mend it, or move it away and teach the poses anew") from error

    def set_aside(self) -> Path:
        """Rename it, never over another file, and return its new name. Raises OSError."""
        with _alone_in(self.path.parent):
            names = (self.path.with_name(f"{NAME}.broken{number or ''}") for number in itertools.count())
            aside = next(name for name in names if not os.path.lexists(name))
            self.path.rename(aside)
        return aside

    @property
    def gone(self) -> bool:
        """Whether it has been deleted or moved away: its folder is made with it, and it stays without a pose in it."""
        return self.path.parent.is_dir() and not self.path.exists()

    def change(self, name: str, pose: TaughtPose | None, known: Taught | None = None) -> None:
        """Save a pose under a name, or remove it for None; return once that is on the disk, however long it takes.

        Poses that another service of the same robot has written meanwhile stay; if the file has gone, it starts from
        `known`.
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
