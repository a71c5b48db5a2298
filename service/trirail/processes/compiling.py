"""Compilation of the numerical functions at the first start, with progress reports.

`python -m trirail.processes.compiling` compiles everything ahead of the first start.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from trirail.processes.operating_system import notify
from trirail.processes.realtime import release_startup_memory

LAST_MODULE = "trirail.processes.loop_process"
"""Module imported last: once it is loaded, all compiled modules are."""
QUARTERS = 4
"""Number of progress reports."""


class Progress:
    """Progress of the compilation, reported to users and to systemd, which waits for the service meanwhile."""

    def __init__(self, say: Callable[[str], None], patience: float) -> None:
        self._say = say
        self._patience = patience
        self._begun: set[str] = set()

    @property
    def interrupted(self) -> str:
        """Consequence of interrupting the start now, for people."""
        if not self._begun:
            return "the start was interrupted; nothing has moved"
        place = len(self._begun)
        return f"compilation was interrupted at function {place}: the next start continues from there"

    def begin(self, name: str) -> None:
        """Report that a function is being compiled; the next report may take up to the patience [s]."""
        from trirail.kinematics.compiled import FUNCTIONS  # with numba, which a start without compiling does not need

        before = len(self._begun)
        self._begun.add(name)
        now = len(self._begun)
        words = f"{now} of {FUNCTIONS} functions"
        if not before:
            self._say(
                f"the first start compiles {FUNCTIONS} functions, which takes half a minute or more; later starts do "
                "not"
            )
        elif now * QUARTERS // FUNCTIONS > before * QUARTERS // FUNCTIONS:
            self._say(f"compiling: {words}")
        notify(f"STATUS=compiling, once: {words}\nEXTEND_TIMEOUT_USEC={self._patience * 1e6:.0f}")


class NotKeptError(Exception):
    """Raised when a function is not in the cache and would have to be compiled."""


def load() -> bool:
    """Import the compiled modules, which takes a second; return False if a function is not in the cache."""
    if LAST_MODULE in sys.modules:
        return True
    # numba imports scipy if it is installed, 0.15 s and 10 MB, for linear algebra that no compiled function here uses.
    sys.modules.setdefault("scipy", None)  # type: ignore[arg-type]
    from trirail.kinematics.compiled import compile_no_more, on_compile

    def refuse(function: str) -> None:
        raise NotKeptError(function)

    on_compile(refuse)
    try:
        _import_rooms()
    except NotKeptError:
        return False
    compile_no_more()
    release_startup_memory()
    return True


def compile_all(begin: Callable[[str], None]) -> None:
    """Compile the functions that are not in the cache; call `begin` with the name of each one first."""
    from trirail.kinematics.compiled import on_compile

    on_compile(begin)
    _import_rooms()


def _import_rooms() -> None:
    from trirail.processes import loop_process  # noqa: F401 - importing compiles


def main() -> int:
    """Compile the functions that are not in the cache."""
    progress = Progress(lambda words: print(f"trirail: {words}", flush=True), 0.0)  # noqa: T201
    try:
        compile_all(progress.begin)
    except KeyboardInterrupt:
        print(f"trirail: {progress.interrupted}", flush=True)  # noqa: T201
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
