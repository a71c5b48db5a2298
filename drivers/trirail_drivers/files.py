"""Reading of regular files without blocking, and writing of files so that a crash leaves them complete."""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from trirail_drivers.errors import FileError

LARGEST_TEXT = 16_000_000
"""Maximum size of a text file that is read [bytes], enough for some hundred thousand points of a trajectory."""

_NO_LINKS = (errno.EPERM, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of a file system that has no links."""
_KINDS = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFDIR: "a folder",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Raises FileError if the file is missing, or is not regular and might never end.
    """
    try:
        # Checked first: opening a device may have effects, and opening a FIFO without O_NONBLOCK waits for a writer.
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


def expand_home(path: str) -> str:
    """Return a path with the home folder in place of a leading ~.

    Raises FileError if the home folder is unknown, as that of a user whom the system does not know, without HOME.
    """
    expanded = os.path.expanduser(path)
    if path.startswith("~") and not os.path.isabs(expanded):
        raise FileError(f"{path}: the home folder is unknown: set HOME")
    return expanded


def text(path: Path, errors: str = "strict") -> str:
    """Return the content of a UTF-8 text file. Raises FileError. `errors` is that of bytes.decode."""
    with open_regular(path) as file:
        try:
            content = file.read(LARGEST_TEXT + 1)
        except OSError as error:
            raise FileError(f"{path}: {error.strerror}") from error
    if len(content) > LARGEST_TEXT:
        raise FileError(f"{path}: larger than {LARGEST_TEXT // 1_000_000} MB")
    try:
        return content.decode("utf-8-sig", errors)
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: not text in UTF-8: {error.reason} at byte {error.start}") from error


def replace(path: Path, content: bytes, mode: int = 0o644) -> None:
    """Replace a file so that a crash or a power cut leaves either the old or the new file, complete.

    The content is written to a temporary file in the same folder, which only its owner can read, and is synced to the
    disk before the rename; the rename is synced before this function returns. Raises OSError.
    """
    descriptor, beside = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)  # 0600
    try:
        _write_synced(descriptor, content, mode)
        os.replace(beside, path)
    except BaseException:
        Path(beside).unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def create(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Create a file so that a crash or a power cut leaves either no file or the complete file.

    The umask is applied to `mode`. Raises FileExistsError if the file already exists, and OSError.
    """
    if os.path.lexists(path):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    beside = path.with_name(f".{path.name}-{secrets.token_hex(4)}")
    descriptor = os.open(beside, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode)
    try:
        _write_synced(descriptor, content)
        _link(beside, path)
    finally:
        beside.unlink(missing_ok=True)
    sync_folder(path.parent)


def _write_synced(descriptor: int, content: bytes, mode: int | None = None) -> None:
    """Write a file and sync it to the disk; close the descriptor in any case."""
    with os.fdopen(descriptor, "wb") as written:
        written.write(content)
        written.flush()
        if mode is not None:
            os.fchmod(descriptor, mode)
        os.fsync(descriptor)


def _link(beside: Path, path: Path) -> None:
    """Give a file the name `path`; unlike a rename, a link does not replace another file."""
    try:
        os.link(beside, path)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
    else:
        return
    # FAT, for example on a USB stick, has no links. There, a power cut between these two steps leaves an empty file.
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    try:
        os.replace(beside, path)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def make_folder(folder: Path, mode: int = 0o777) -> None:
    """Create a folder and its missing parents, and sync them to the disk. Raises OSError.

    The umask is applied to `mode`, which is that of the folder itself.
    """
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(mode, exist_ok=True)
        sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Sync the file names in a folder to the disk, since fsync of a file covers its content but not its name.

    Raises OSError.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


PREFIX = "trirail-run-"
"""Prefix of the names of temporary folders; folders with other names are never removed."""


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Create a folder and remove it afterwards. Also remove the folders of this user's processes that were killed.

    A folder is in use while a process has locked it; the lock ends with the process. Raises OSError.
    """
    base = Path(tempfile.gettempdir())
    for left in base.glob(f"{PREFIX}*"):
        _remove_unused(left)
    folder, lock = _locked_folder(base)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _locked_folder(base: Path) -> tuple[Path, int]:
    """Return a new folder and the descriptor of its lock; retry if another process removes the folder before it is
    locked.
    """
    while True:
        folder = tempfile.mkdtemp(prefix=PREFIX, dir=base)
        with suppress(FileNotFoundError, BlockingIOError):
            lock = _lock(folder)
            if os.fstat(lock).st_nlink:
                return Path(folder), lock
            os.close(lock)


def _remove_unused(folder: Path) -> None:
    """Remove a folder of this user unless it is locked."""
    with suppress(OSError):
        if folder.lstat().st_uid != os.getuid():
            return
        lock = _lock(folder)
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _lock(folder: Path | str) -> int:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def check(path: Path) -> None:
    """Raise FileError if a path is not a regular file, and OSError if it does not exist."""
    _check(path, os.stat(path))


def _check(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise FileError(f"{path}: {_KINDS.get(stat.S_IFMT(status.st_mode), 'no file')}; expected a regular file")
