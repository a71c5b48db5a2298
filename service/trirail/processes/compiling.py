"""The first start compiles the mathematics, once: what is said of it, and doing it ahead of the first start.

`python -m trirail.processes.compiling` compiles all that a service needs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from trirail.processes.systemd import notify

QUARTERS = 4
"""So many parts of the work are told of."""


class Progress:
    """Says that the mathematics is being compiled, and how far that is; tells systemd to wait as long as it goes on."""

    def __init__(self, say: Callable[[str], None], patience: float) -> None:
        self._say = say
        self._patience = patience
        self._begun: set[str] = set()

    def begin(self, name: str) -> None:
        """Take in that a function is being compiled; `patience` seconds may pass until the next one [s]."""
        from trirail.kinematics.compiled import FUNCTIONS  # with numba, which a start without compiling goes without

        before = len(self._begun)
        self._begun.add(name)
        now = len(self._begun)
        words = f"{now} of {FUNCTIONS} functions"
        if not before:
            self._say(f"the first start compiles the mathematics, {FUNCTIONS} functions; once, a minute or two")
        elif now * QUARTERS // FUNCTIONS > before * QUARTERS // FUNCTIONS:
            self._say(f"compiling: {words}")
        notify(f"STATUS=compiling, once: {words}\nEXTEND_TIMEOUT_USEC={self._patience * 1e6:.0f}")


def main() -> int:
    """Compile what is not kept yet."""
    from trirail.kinematics.compiled import tell_of_compiling

    tell_of_compiling(Progress(lambda words: print(f"trirail: {words}", flush=True), 0.0).begin)  # noqa: T201
    from trirail.control import cycle  # noqa: F401 - importing compiles
    from trirail.motion import planner  # noqa: F401

    return 0


if __name__ == "__main__":
    sys.exit(main())
