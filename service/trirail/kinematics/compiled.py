"""Functions compiled by numba: plain IEEE arithmetic, kept on disk, never stale."""

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

__all__ = ["compile_no_more", "compiled", "inlined", "tell_of_compiling"]

P = ParamSpec("P")
R = TypeVar("R")

ROOMS = ("kinematics", "motion", "control", "processes")
"""Where compiled functions stand: what is inlined, or fixed as a constant, goes across files and rooms."""


def _sources() -> bytes:
    package = Path(__file__).parents[1]
    files = [file for room in ROOMS for file in sorted((package / room).rglob("*.py"))]
    sources = [(file.relative_to(package).parts[0], file.read_bytes()) for file in files]
    # Constants come from any file of the kinematics; elsewhere from those that have compiled functions themselves.
    return b"".join(source for room, source in sources if room == ROOMS[0] or b"@compiled(" in source)


FINGERPRINT = hashlib.sha256(_sources()).hexdigest()
FUNCTIONS = len(re.findall(rb"^@compiled\((?!\))", _sources(), re.MULTILINE))
"""How many functions are compiled ahead of their first call, in all rooms."""

_listener: list[Callable[[str], None]] = []
_functions: list[Any] = []


def compile_no_more() -> None:
    """Drop what is needed of the compiled functions to compile others that call them: 16 MB."""
    for function in _functions:
        for library in map(operator.attrgetter("library"), function.overloads.values()):
            library._shared_module = None


def tell_of_compiling(listener: Callable[[str], None]) -> None:
    """Have `listener`, and no other, called with the name of each function that is not kept, before it is compiled."""
    _listener[:] = [listener]


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the lock of a cache folder; the kernel takes it from a process that dies."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):  # somebody else's folder: then each compiles for itself
            folder.mkdir(parents=True, exist_ok=True)
            lock = held.enter_context((folder / "compiling.lock").open("w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _kept(dispatcher: Any) -> Any:
    """Have what is kept of a function compiled anew after every edit of any of the sources.

    To see whether it is out of date numba looks at the file of the function alone; what is called from there would live
    on after an edit elsewhere. The version is read before anything else is unpickled: of older code that may name
    classes that are no more.
    """
    kept = dispatcher._cache._cache_file
    kept._version = (kept._version, FINGERPRINT)
    _functions.append(dispatcher)
    return dispatcher


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate the arithmetic of a few lines to stand, compiled, wherever a compiled function calls it.

    Everything so would take three times as long to compile, and run no faster.
    """
    return _kept(njit(function, error_model="numpy", forceinline=True, cache=True))  # type: ignore[no-any-return]


def compiled(*signatures: Any, releases: bool = False) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a function to run compiled: now, for these signatures; without any, at its first call.

    Division by zero gives an infinity or NaN, never an exception. Compiled code is kept beside the source, or
    in the user's cache directory where that cannot be written, and a later start only loads it. One that `releases` the
    interpreter's lock lets other threads run meanwhile.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        dispatcher = _kept(njit(function, error_model="numpy", cache=True, nogil=releases))
        kept = dispatcher._cache._cache_file
        if signatures:
            # Processes that start together compile each function once: who comes second loads what the first has kept.
            with _alone(Path(kept._cache_path)):
                if not kept._load_index():
                    for listener in _listener:
                        listener(function.__qualname__)
                for signature in signatures:
                    dispatcher.compile(signature)
            dispatcher.disable_compile()
        return dispatcher  # type: ignore[no-any-return]

    return decorate
