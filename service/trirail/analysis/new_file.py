"""New files, which are written completely or not at all, and never replace another file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from trirail.errors import ServiceError


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Create a file and open it for writing; delete it if the context ends with an error.

    Raises ServiceError if the file already exists or cannot be written.
    """
    try:
        file = path.open("xb")
        try:
            with file:
                yield file
        except BaseException:
            path.unlink(missing_ok=True)
            raise
    except FileExistsError as error:
        raise ServiceError(f"{path} already exists: choose another file") from error
    except OSError as error:
        raise ServiceError(f"cannot write {path}: {error.strerror or error}") from error
