"""Functions compiled by numba, with plain IEEE arithmetic. They are cached on disk, and the cache is never stale."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import operator
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from numba import njit

__all__ = ["compile_no_more", "compiled", "inlined", "on_compile"]

P = ParamSpec("P")
R = TypeVar("R")

ROOMS = ("kinematics", "motion", "control", "processes")
"""Folders with compiled functions. Inlined code and constants cross files and folders, so all of them share one
version."""


def _sources() -> bytes:
    package = Path(__file__).parents[1]
    files = [file for room in ROOMS for file in sorted((package / room).rglob("*.py"))]
    sources = [(file.relative_to(package).parts[0], file.read_bytes()) for file in files]
    # Constants may come from any file of the kinematics, but elsewhere only from files with compiled functions.
    return b"".join(source for room, source in sources if room == ROOMS[0] or b"@compiled(" in source)


FINGERPRINT = hashlib.sha256(_sources()).hexdigest()
FUNCTIONS = len(re.findall(rb"^@compiled\((?!\))", _sources(), re.MULTILINE))
"""Number of functions in these folders that are compiled before their first call."""

_listener: list[Callable[[str], None]] = []
_functions: list[Any] = []


def compile_no_more() -> None:
    """Free the 16 MB of memory that are needed only to compile more functions."""
    for function in _functions:
        for library in map(operator.attrgetter("library"), function.overloads.values()):
            library._shared_module = None


def on_compile(listener: Callable[[str], None]) -> None:
    """Call `listener` with the name of each uncached function before it is compiled, instead of any earlier one."""
    _listener[:] = [listener]


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the lock of a cache folder. The kernel releases the lock if the process dies."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):  # the folder belongs to another user: each process compiles for itself
            folder.mkdir(parents=True, exist_ok=True)
            lock = held.enter_context((folder / "compiling.lock").open("w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _kept(dispatcher: Any) -> Any:
    """Invalidate the cache of a function after every edit of any source file.

    numba checks only the file of the function itself, and would miss an edit of a function that it calls. The version
    is stored where numba reads it first, because unpickling older code may refer to classes that no longer exist.
    """
    kept = dispatcher._cache._cache_file
    kept._version = (kept._version, FINGERPRINT)
    _functions.append(dispatcher)
    return dispatcher


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Inline a few lines of arithmetic into every compiled function that calls them (decorator).

    Inlining everything takes three times as long to compile, and does not run faster.
    """
    return _kept(njit(function, error_model="numpy", forceinline=True, cache=True))  # type: ignore[no-any-return]


def compiled(*signatures: Any, releases: bool = False) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile a function now for the given signatures or, if there are none, at its first call (decorator).

    Division by zero gives an infinity or NaN, never an exception. Compiled code is cached beside the source, or in the
    user's cache directory if the source folder cannot be written. Later starts load it from the cache. `releases`
    releases the GIL during a call.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        dispatcher = _kept(njit(function, error_model="numpy", cache=True, nogil=releases))
        kept = dispatcher._cache._cache_file
        if signatures:
            # If two processes start together, the second loads what the first has compiled and cached.
            with _alone(Path(kept._cache_path)):
                if not kept._load_index():
                    for listener in _listener:
                        listener(function.__qualname__)
                for signature in signatures:
                    dispatcher.compile(signature)
            dispatcher.disable_compile()
        return dispatcher  # type: ignore[no-any-return]

    return decorate
