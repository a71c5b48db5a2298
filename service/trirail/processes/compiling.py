"""Compilation of the numerical functions at the first start, with progress reports.

`python -m trirail.processes.compiling` compiles all functions before the first start.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from trirail.processes.operating_system import notify
from trirail.processes.realtime import release_startup_memory

LAST_MODULE = "trirail.processes.loop_process"
"""Module that is imported last. Once it has been imported, all modules with compiled functions have been imported."""
QUARTERS = 4
"""Number of parts of the compilation, with one progress report for each."""


class Progress:
    """Progress of the compilation, reported to users and to systemd.

    The reports extend the time that systemd waits for the service to start.
    """

    def __init__(self, say: Callable[[str], None], patience: float) -> None:
        self._say = say
        self._patience = patience
        self._begun: set[str] = set()

    @property
    def interrupted(self) -> str:
        """Message for a user who interrupts the start, which explains the consequence."""
        if not self._begun:
            return "the start was interrupted; nothing has moved"
        place = len(self._begun)
        return f"compilation was interrupted at function {place}: the next start continues from there"

    def begin(self, name: str) -> None:
        """Report that a function is being compiled. The next report must follow within `patience` seconds."""
        from trirail.kinematics.compiled import FUNCTIONS  # imports numba, which is not needed if nothing is compiled

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
    """Error raised if a function is not in the cache and would have to be compiled."""


def load() -> bool:
    """Import the modules with compiled functions, which takes a second.

    Return True if all functions were in the cache, and False as soon as a function is missing.
    """
    if LAST_MODULE in sys.modules:
        return True
    # numba imports scipy if it is installed. That costs 0.15 s and 10 MB, and is only needed for linear algebra that no
    # compiled function here uses.
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
    """Compile the functions that are not in the cache. Call `begin` with the name of each function beforehand."""
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
