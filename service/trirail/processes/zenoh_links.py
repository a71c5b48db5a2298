"""The gateway's links: those of clients, told before they are used up, and those to routers, told when one lacks.

Zenoh bounds the sessions of all, and not those of one certificate. So the gateway looks at the links, and where few
places are left it ends the newest sessions of whom has most, those of names without a role before all. The routers of
[zenoh] connect Zenoh dials and dials again; what is told of it is told here.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, NamedTuple

from trirail.processes import sockets
from trirail.wire.packets import Remark
from trirail.wire.text import quoted

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
        self.use = InUse(0, most, 0, sockets.descriptor_limit())
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
        self.use = InUse(len(links), self._most, sockets.descriptors_used(), sockets.descriptor_limit())
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


PATIENCE = 5.0
"""So long after the start a router may still be dialled without a word [s]."""
ASK_EVERY = 15.0
"""How often it is asked anew why a router is not reached [s]."""


@dataclass
class _Router:
    endpoint: str
    ask_at: float
    """When it is asked why there is no link."""
    linked: bool | None = None
    """What was last told; None for nothing."""
    asked: Future[str] | None = None
    warning: str = ""
    """While there is no link and that has been told."""


class RouterLinks:
    """Tells when a link to a router comes, is lost, or does not come, each once; `warnings` lasts as long as it lacks.

    `linked` returns to which endpoints there is a link, at once; `why_not` why there is none to one, and may take
    seconds: it is called by a thread of its own.
    """

    def __init__(
        self,
        endpoints: Sequence[str],
        linked: Callable[[], Collection[str]],
        why_not: Callable[[str], str],
        tell: Callable[[Remark], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._linked, self._why_not, self._tell, self._clock = linked, why_not, tell, clock
        self._routers = [_Router(endpoint, clock() + PATIENCE) for endpoint in endpoints]
        self._due = 0.0
        self._asking = ThreadPoolExecutor(1, "router")

    def warnings(self) -> tuple[str, ...]:
        """Return which routers are not reached, and why, one line each."""
        return tuple(router.warning for router in self._routers if router.warning)

    def poll(self) -> None:
        """Look whether the links are there, when it is time."""
        now = self._clock()
        if not self._routers or now < self._due:
            return
        self._due = now + LOOK_EVERY
        linked = self._linked()
        for router in self._routers:
            if router.endpoint in linked:
                self._is_there(router, now)
            else:
                self._lacks(router, now)

    def close(self) -> None:
        """End; what is being asked is not waited for."""
        self._asking.shutdown(wait=False, cancel_futures=True)

    def _is_there(self, router: _Router, now: float) -> None:
        if not router.linked:
            self._tell(Remark("info", f"linked to the router {router.endpoint}"))
        router.linked, router.asked, router.warning, router.ask_at = True, None, "", now

    def _lacks(self, router: _Router, now: float) -> None:
        if router.asked is None and now >= router.ask_at:
            router.asked = self._asking.submit(self._why_not, router.endpoint)
            router.ask_at = now + ASK_EVERY
        if router.asked is None or not router.asked.done():
            return
        error = router.asked.exception()  # whoever answers there says what he likes, and nobody here may end of it
        why = quoted(f"{error!r}") if error is not None else router.asked.result()
        router.asked = None
        why = why or "it answers, but opens no session: is it a router that takes this robot?"
        router.warning = f"no link to the router {router.endpoint}: {why}; it is dialled again, local control goes on"
        if router.linked is not False:
            router.linked = False
            self._tell(Remark("warning", router.warning))
