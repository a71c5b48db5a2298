"""Decorators that compile functions with numba, with IEEE arithmetic and a cache on disk that is never out of date."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import operator
import re
from collections.abc import Callable, Iterator
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


def _kept(dispatcher: Any) -> Any:
    """Make the cache of a compiled function invalid after any edit in ROOMS.

    numba only checks the file that defines the function, and would miss edits of called functions in other files. The
    fingerprint is part of the version that numba checks first. Otherwise, numba would unpickle outdated code, which may
    refer to classes that no longer exist.
    """
    kept = dispatcher._cache._cache_file
    kept._version = (kept._version, FINGERPRINT)
    _functions.append(dispatcher)
    return dispatcher


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Inline a function into every compiled function that calls it (decorator).

    Use this for a few lines of arithmetic. If all functions were inlined, compilation would take three times as long,
    and the code would not run faster.
    """
    return _kept(njit(function, error_model="numpy", forceinline=True, cache=True))  # type: ignore[no-any-return]


def compiled(*signatures: Any, releases: bool = False) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile a function immediately for the given signatures or, without signatures, at its first call (decorator).

    Division by zero gives an infinity or NaN, never an exception. Compiled code is cached in the folder of the source,
    or in the user's cache directory if this folder is not writable. Later processes load the code from the cache. If
    `releases` is set, the function releases the GIL during a call.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        dispatcher = _kept(njit(function, error_model="numpy", cache=True, nogil=releases))
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
