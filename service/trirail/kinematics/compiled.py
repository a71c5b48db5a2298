"""Decorators that compile functions with numba, with IEEE arithmetic and a cache on disk that is never out of date."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import operator
import os
import re
import stat
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from glob import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from numba import config, njit

# Some shells set NUMBA_DISABLE_JIT for debugging, but a cycle needs compiled code.
config.DISABLE_JIT = 0  # type: ignore[attr-defined]

__all__ = ["compile_no_more", "compiled", "inlined", "on_compile"]

P = ParamSpec("P")
R = TypeVar("R")

ROOMS = ("kinematics", "motion", "control", "processes")
"""Folders with compiled functions. Compiled functions contain code and constants from other files. An edit in any of
these folders therefore invalidates all cached functions."""
DRIVERS = (
    "bus/can_frame.py",
    "driver/axis_row.py",
    "driver/cyclic.py",
    "driver/row_updates.py",
    "driver/scaling.py",
    "interface.py",
)
"""Files of trirail_drivers with constants of compiled functions, or with functions that are also compiled."""


def _sources() -> bytes:
    package = Path(__file__).parents[1]
    drivers = find_spec("trirail_drivers")
    folders = drivers.submodule_search_locations if drivers is not None else None
    shared = b"".join(Path(folder, file).read_bytes() for folder in folders or () for file in DRIVERS)
    files = [file for room in ROOMS for file in sorted((package / room).rglob("*.py"))]
    sources = [(file.relative_to(package).parts[0], file.read_bytes()) for file in files]
    # In the kinematics, any file may define constants of compiled functions; in other folders, only files that contain
    # compiled functions.
    own = (source for room, source in sources if room == ROOMS[0] or b"@compiled(" in source)
    return b"".join(own) + shared


FINGERPRINT = hashlib.sha256(_sources()).hexdigest()
FUNCTIONS = len(re.findall(rb"^@compiled\((?!\))", _sources(), re.MULTILINE))
"""Number of functions in ROOMS that are compiled when their module is imported."""

_listener: list[Callable[[str], None]] = []
_functions: list[Any] = []


def compile_no_more() -> None:
    """Free 16 MB of memory that are only needed to compile functions. No function can be compiled after this call."""
    for function in _functions:
        for library in map(operator.attrgetter("library"), function.overloads.values()):
            library._shared_module = None


def on_compile(listener: Callable[[str], None]) -> None:
    """Set the listener, which is called with the name of each uncached function before the function is compiled.

    A new listener replaces the previous listener.
    """
    _listener[:] = [listener]


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Lock a cache folder against other processes. If the process dies, the kernel releases the lock."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):  # without write access, processes compile without a lock
            folder.mkdir(parents=True, exist_ok=True)
            lock = held.enter_context((folder / "compiling.lock").open("w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _cached(function: Callable[..., Any], **options: Any) -> Any:
    """Return a function that numba compiles and caches.

    If neither the folder of the source nor the user's cache directory can be written, as for a system user without a
    home, the cache is in a folder for temporary files. Raises TrirailError if there is no such folder either.

    Any edit in ROOMS makes the cache invalid. numba only checks the file that defines the function, and would miss
    edits of called functions in other files. The fingerprint is part of the version that numba checks first. Otherwise,
    numba would unpickle outdated code, which may refer to classes that no longer exist.
    """
    compile_later = partial(njit, function, error_model="numpy", cache=True, **options)
    dispatcher: Any
    # Without a home, numba would create a folder named "~" in the working directory.
    user_cache = os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache"))
    if not (config.CACHE_DIR or os.path.isabs(user_cache)):  # type: ignore[attr-defined]
        config.CACHE_DIR = str(_temporary_cache())  # type: ignore[attr-defined]
    try:
        dispatcher = compile_later()
    except RuntimeError:
        config.CACHE_DIR = str(_temporary_cache())  # type: ignore[attr-defined]
        dispatcher = compile_later()
    kept = dispatcher._cache._cache_file
    kept._version = (kept._version, FINGERPRINT)
    kept._load_index, kept._load_data = _or_nothing(kept._load_index, dict), _or_nothing(kept._load_data, _none)
    kept.save = _or_nothing(kept.save, _none)
    if not kept._load_index():
        # numba writes a new index before the new code. If it were interrupted in between, the index would name the code
        # of an earlier version.
        for outdated in Path(kept._cache_path).glob(f"{escape(kept._index_name.removesuffix('.nbi'))}.*.nbc"):
            with contextlib.suppress(OSError):
                outdated.unlink()
    _functions.append(dispatcher)
    return dispatcher


def _none() -> None:
    return None


def _or_nothing(use: Callable[P, R], nothing: Callable[[], R]) -> Callable[P, R]:
    """Return a function that uses a file of the cache, or returns `nothing()` if that fails.

    A power failure can leave files empty or incomplete, and a disk can be full. The function is then compiled again.
    """

    def use_if_possible(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return use(*args, **kwargs)
        except Exception:  # noqa: BLE001 - pickle raises any error for damaged data
            return nothing()

    return use_if_possible


def _temporary_cache() -> Path:
    """Return a folder for compiled code that belongs to this user alone. Raises TrirailError if there is none."""
    folder = Path(tempfile.gettempdir(), f"trirail-compiled-{os.getuid()}")
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022:
            return folder
        why = f"{folder} does not belong to this user alone"
    except OSError as error:
        why = str(error)
    from trirail_drivers.errors import TrirailError

    raise TrirailError(f"no folder for compiled code: {why}; set NUMBA_CACHE_DIR to a folder that can be written")


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Inline a function into every compiled function that calls it (decorator).

    Use this for a few lines of arithmetic. If all functions were inlined, compilation would take three times as long,
    and the code would not run faster.
    """
    return _cached(function, forceinline=True, _nrt=False)  # type: ignore[no-any-return]


def compiled(
    *signatures: Any, releases: bool = False, allocates: bool = False
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile a function immediately for the given signatures or, without signatures, at its first call (decorator).

    Division by zero gives an infinity or NaN, never an exception. Compiled code is cached on disk, and later processes
    load the code from the cache. If `releases` is set, the function releases the GIL during a call.

    Only functions with `allocates` may create arrays or return them. In the others, numba counts no references to
    arrays. In the functions of a cycle, counting would take longer than the mathematics.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        dispatcher = _cached(function, nogil=releases, _nrt=allocates)
        kept = dispatcher._cache._cache_file
        if signatures:
            # If two processes start together, the second process loads the code that the first has compiled.
            with _alone(Path(kept._cache_path)):
                if not kept._load_index():
                    for listener in _listener:
                        listener(function.__qualname__)
                for signature in signatures:
                    dispatcher.compile(signature)
            dispatcher.disable_compile()
        return dispatcher  # type: ignore[no-any-return]

    return decorate
