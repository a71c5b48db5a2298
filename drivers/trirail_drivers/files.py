"""Files that people name, read and written without waiting: regular ones, no FIFOs, devices or folders."""

from __future__ import annotations

import os
import stat
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


def opened(path: Path) -> BinaryIO:
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
    with opened(path) as file:
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


def check(path: Path) -> None:
    """Raise FileError for what is there but is no regular file, OSError where nothing is there."""
    _check(path, os.stat(path))


def _check(path: Path, found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise FileError(f"{path}: {_KINDS.get(stat.S_IFMT(found.st_mode), 'no file')}; wanted a regular file")
