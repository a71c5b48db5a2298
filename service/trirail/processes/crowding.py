"""How many sessions and descriptors of the gateway are in use: told before they are used up, shared by certificate.

Zenoh bounds the sessions of all, and not those of one certificate. So the gateway looks at the links, and where few
places are left it ends the newest sessions of whom has most, those of names without a role before all.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Container, Mapping
from typing import Final, NamedTuple

from trirail.processes import descriptors
from trirail.wire.packets import Remark

LOOK_EVERY: Final = 1.0
"""How often it is looked [s]."""
NEARLY: Final = 0.8
"""Share in use from which on it is told; it is over below nine tenths of that."""
PLACES_FREE: Final = 0.1
"""Share of the sessions that is kept free for whoever has fewer than others."""
EACH: Final = 8
"""So many sessions of a user are never ended."""


class InUse(NamedTuple):
    """What is in use, and of how many."""

    sessions: int
    sessions_most: int
    descriptors: int
    descriptors_most: int


def surplus(links: Mapping[str, str], users: Container[str], most: int) -> set[str]:
    """Return the addresses whose sessions are to end, that a share of `most` stays free.

    `links` has the name in the certificate of each address, the oldest first, none where nobody shows one.
    """
    of: dict[str, list[str]] = {}
    for at, name in links.items():
        of.setdefault(name, []).append(at)
    ending: set[str] = set()
    for _ in range(len(links) - round(most * (1.0 - PLACES_FREE))):
        greedy = [(name not in users, len(own), name) for name, own in of.items() if own]
        spare = [one for one in greedy if one[0] or one[1] > EACH]
        if not spare:
            break
        *_, name = max(spare)
        ending.add(of[name].pop())
    return ending


class Crowding:
    """Looks once a second. `links` returns the name by address of every link, `end` ends those of some addresses."""

    def __init__(
        self,
        links: Callable[[], Mapping[str, str | None]],
        end: Callable[[set[str]], object],
        users: Container[str],
        most: int,
        tell: Callable[[Remark], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._links, self._end, self._users, self._most, self._tell, self._clock = links, end, users, most, tell, clock
        self._seen: dict[str, None] = {}
        self._warnings: dict[str, str] = {}
        self._due = 0.0
        self.use = InUse(0, most, 0, descriptors.limit())
        """As it was looked last."""

    def warnings(self) -> tuple[str, ...]:
        """Return what is nearly used up, one line each."""
        return tuple(self._warnings.values())

    def poll(self) -> None:
        """Look, when it is time."""
        now = self._clock()
        if now < self._due:
            return
        self._due = now + LOOK_EVERY
        links = self._links()
        self._seen = {at: None for at in (*self._seen, *links) if at in links}
        self.use = InUse(len(links), self._most, descriptors.used(), descriptors.limit())
        named = {at: name for at in self._seen if (name := links[at]) is not None}
        if ending := surplus(named, self._users, self._most):
            self._end(ending)
        (name, own), *_ = Counter(named.values()).most_common(1) or [("", 0)]
        by = f", {own} by {name}" if name else ""
        self._judge("sessions", self.use.sessions, self._most, by)
        self._judge("descriptors", self.use.descriptors, self.use.descriptors_most, "")

    def _judge(self, what: str, used: int, most: int, by: str) -> None:
        """Warn of what is nearly used up, and tell it once."""
        was = what in self._warnings
        if used < most * NEARLY * (0.9 if was else 1.0):
            self._warnings.pop(what, None)
            return
        self._warnings[what] = (
            f"{used} of {most} {what} of the gateway are in use{by}: soon nobody new is let in, but for stops"
        )
        if not was:
            self._tell(Remark("warning", self._warnings[what]))
