"""Tells a process that hangs from one that a busy machine keeps waiting: killing that one would help nobody.

Without a sign of life counts the time in which a process could have given one: what its main thread has used of a
processor, and the turns in which it wanted none, as when it is stopped or waits for what does not come. While it waits
for a processor or for a disk, nothing counts.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from trirail.processes.heartbeats import Heart

READY, ON_DISK = "R", "D"
"""States of proc(5): it runs or would, and it waits for a disk, where no signal reaches it."""
_STATE, _UTIME, _STIME = 0, 11, 12
"""Fields of /proc/PID/stat behind the name, which stands in parentheses and may hold some."""
_TICK: Final = 1.0 / os.sysconf("SC_CLK_TCK")


class Effort(NamedTuple):
    """What the kernel says of a thread."""

    state: str
    """A letter of proc(5)."""
    used: float
    """Processor time since it began [s]."""

    @property
    def kept_waiting(self) -> bool:
        """Whether it would go on if the machine had a processor or a disk for it; or it runs."""
        return self.state in (READY, ON_DISK)


def effort(pid: int) -> Effort | None:
    """Return what the kernel says of a process's main thread; None where it says nothing."""
    try:
        said = Path(f"/proc/{pid}/task/{pid}/stat").read_bytes()
    except OSError:  # it has just ended, or there is no such file system
        return None
    fields = said[said.rindex(b")") + 1 :].split()
    return Effort(fields[_STATE].decode(), (int(fields[_UTIME]) + int(fields[_STIME])) * _TICK)


class HangWatch:
    """Looks at the heart of another process, once in each turn of who watches."""

    def __init__(
        self, heart: Heart, patience: float, turn: float, effort: Callable[[int], Effort | None] = effort
    ) -> None:
        self._heart = heart
        self._patience = patience
        self._turn = turn
        self._effort = effort
        self._seen = 0
        self._could = 0.0
        self._used: float | None = None

    def hangs(self, pid: int) -> bool:
        """Look, in every turn; whether it could have given a sign of life for longer than there is patience [s]."""
        count = self._heart.count
        if count != self._seen or not count:
            self._seen, self._could, self._used = count, 0.0, None
            return False
        now = self._effort(pid)
        if now is None or not now.kept_waiting:
            self._could += self._turn
        elif self._used is not None:
            self._could += now.used - self._used
        self._used = now.used if now is not None else None
        return self._could > self._patience + self._turn / 2.0
