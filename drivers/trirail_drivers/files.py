"""Files: those that people name are read without waiting, if they are regular ones; what must last is written whole."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path
from typing import BinaryIO

from trirail_drivers.errors import FileError

LARGEST_TEXT = 16_000_000
"""The largest text that is read [bytes]: some hundred thousand points of a trajectory."""

_KINDS = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFDIR: "a folder",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file to be read. Raises FileError, where there is none or where reading might never end."""
    try:
        # Opening a device may do something, and a FIFO without O_NONBLOCK waits for somebody to write to it.
        check(path)
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))  # noqa: SIM115
    except OSError as error:
        raise FileError(f"{path}: {error.strerror}") from error
    except ValueError as error:  # a null character in the name
        raise FileError(f"{str(path)!r}: {error}") from error
    try:
        _check(path, os.fstat(file.fileno()))
    except FileError:
        file.close()
        raise
    return file


def text(path: Path) -> str:
    """Read a text file in UTF-8. Raises FileError."""
    with open_regular(path) as file:
        try:
            content = file.read(LARGEST_TEXT + 1)
        except OSError as error:
            raise FileError(f"{path}: {error.strerror}") from error
    if len(content) > LARGEST_TEXT:
        raise FileError(f"{path}: larger than {LARGEST_TEXT // 1_000_000} MB")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: not text in UTF-8: {error.reason} at byte {error.start}") from error


def replace(path: Path, content: bytes, mode: int = 0o644) -> None:
    """Write a file such that a crash or a power cut, whenever it comes, leaves the old one or the new one, whole.

    It is written beside its place, where only its owner can read it, and is on the disk before it takes its name; the
    name is on the disk when this returns. Raises OSError.
    """
    descriptor, beside = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)  # 0600
    try:
        with os.fdopen(descriptor, "wb") as written:
            written.write(content)
            written.flush()
            os.fchmod(descriptor, mode)
            os.fsync(descriptor)
        os.replace(beside, path)
    except BaseException:
        Path(beside).unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it that are missing, such that a power cut does not take them. Raises OSError."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        _sync_folder(folder.parent)


def check(path: Path) -> None:
    """Raise FileError for what is there but is no regular file, OSError where nothing is there."""
    _check(path, os.stat(path))


def _sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk: fsync of a file keeps its content, not its name."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _check(path: Path, found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise FileError(f"{path}: {_KINDS.get(stat.S_IFMT(found.st_mode), 'no file')}; wanted a regular file")
