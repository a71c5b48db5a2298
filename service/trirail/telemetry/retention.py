"""The folder of recordings: which are in it, and which go when they take too much room."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

BLACK_BOX = "fault-"
"""What the name of a black box begins with."""
_NAME = re.compile(r"[A-Za-z0-9_-]+-\d{8}-\d{6}(-part\d+)?(-\d+)?\.rrd")
"""Names that the recorder gives. Files with other names are somebody's own, and never deleted."""
IN_USE = 10.0
"""A file that was written to so short a time ago is being written, by this service or another one [s]."""


class _Kept(NamedTuple):
    path: Path
    size: int
    written: float
    """[s since 1970]"""

    @property
    def files(self) -> list[Path]:
        """The recording, and the log of CAN frames beside it."""
        return [path for path in (self.path, self.path.with_suffix(".log")) if path.exists()]


def tidy(directory: Path, at_most: float, now: float | None = None) -> list[Path]:
    """Delete the oldest recordings until all take no more than `at_most` bytes together; return which.

    Black boxes go last, when nothing else is left to delete; what is being written stays. OSError if a file
    cannot be deleted.
    """
    found = sorted(_recordings(directory), key=lambda kept: (kept.path.name.startswith(BLACK_BOX), kept.written))
    total = sum(kept.size for kept in found)
    free_since = (time.time() if now is None else now) - IN_USE
    deleted: list[Path] = []
    for kept in found:
        if total <= at_most:
            break
        if kept.written > free_since:
            continue
        for path in kept.files:
            path.unlink()
        total -= kept.size
        deleted.append(kept.path)
    return deleted


def _recordings(directory: Path) -> Iterator[_Kept]:
    for path in directory.glob("*.rrd"):
        if not _NAME.fullmatch(path.name):
            continue
        try:
            status = path.stat()
            log = path.with_suffix(".log")
            beside = log.stat().st_size if log.exists() else 0
        except FileNotFoundError:  # somebody else deleted it just now
            continue
        yield _Kept(path, status.st_size + beside, status.st_mtime)
