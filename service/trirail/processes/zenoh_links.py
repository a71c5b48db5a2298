"""Links of the gateway: those of clients, with warnings before they run out, and those to routers, if one is missing.

Zenoh bounds the sessions of all, and not those of one certificate. So the gateway checks the links, and if few places
are left it ends the newest sessions of the name with most, names without a role first. Zenoh itself dials the routers
of [zenoh] connect, again and again; their links are reported here.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, NamedTuple

from trirail.processes import sockets
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.messages import Notice
from trirail.wire.text import quoted

LOOK_EVERY: Final = 1.0
"""Interval between two checks [s]."""
NEARLY: Final = 0.8
"""Share in use that starts a warning; it ends below nine tenths of that."""
PLACES_FREE: Final = 0.1
"""Share of the sessions that is kept free for users with fewer than others."""
EACH: Final = 8
"""Number of a user's sessions that are never ended."""


class InUse(NamedTuple):
    """Resources in use, and their totals."""

    sessions: int
    sessions_most: int
    descriptors: int
    descriptors_most: int
    unopened: int = 0
    """Connections to endpoints with TLS that have opened no session."""


def surplus(links: Mapping[str, str], users: Container[str], most: int) -> set[str]:
    """Return the addresses whose sessions must end so that a share of `most` stays free.

    `links` has the name in the certificate of each address, the oldest first, none without a certificate.
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


FAILED_A_SECOND: Final = 10.0
"""Failed handshakes that Zenoh handles in a second: it pauses for 0.1 s after each, for all connections."""
UNOPENED: Final = 20
"""Number of connections without a session that starts a warning."""


class Crowding:
    """Monitor of links, once a second. `links` returns the name by address of each link, `end` ends those of addresses.

    `unopened` is given the addresses of all links, and counts by host the connections that have none.
    """

    def __init__(
        self,
        links: Callable[[], Mapping[str, str | None]],
        end: Callable[[set[str]], object],
        users: Container[str],
        most: int,
        announce: Callable[[Notice], object],
        clock: Callable[[], float] = time.monotonic,
        unopened: Callable[[Iterable[str]], Counter[str]] = lambda _: Counter(),
    ) -> None:
        self._unopened = unopened
        self._links, self._end, self._users, self._most = links, end, users, most
        self._announce, self._clock = announce, clock
        self._seen: dict[str, None] = {}
        self._warnings: dict[EventCode, str] = {}
        self._due = 0.0
        self.use = InUse(0, most, 0, sockets.descriptor_limit())
        """Use at the last check."""

    def warnings(self) -> tuple[str, ...]:
        """Return warnings of resources nearly used up, one line each."""
        return tuple(self._warnings.values())

    def poll(self) -> None:
        """Check the links if it is time."""
        now = self._clock()
        if now < self._due:
            return
        self._due = now + LOOK_EVERY
        links = self._links()
        self._seen = {at: None for at in (*self._seen, *links) if at in links}
        unopened = self._unopened(links)
        descriptors = sockets.descriptors_used(), sockets.descriptor_limit()
        self.use = InUse(len(links), self._most, *descriptors, unopened.total())
        named = {at: name for at in self._seen if (name := links[at]) is not None}
        if ending := surplus(named, self._users, self._most):
            self._end(ending)
        (name, own), *_ = Counter(named.values()).most_common(1) or [("", 0)]
        by = f", {own} by {name}" if name else ""
        self._judge("sessions", self.use.sessions, self._most, by)
        self._judge("descriptors", self.use.descriptors, self.use.descriptors_most, "")
        count = unopened.total()
        by = ", ".join(f"{number} from {host}" for host, number in unopened.most_common(1))
        wait = count / FAILED_A_SECOND
        words = f"{count} connections to the gateway open no session ({by}): a new one waits {wait:.0f} s, no stop does"
        text = coded(words, EventCode.CONNECTIONS_WAIT, count=count, wait=wait)
        self._warn(count >= UNOPENED * self._less(text.code), text)

    def _judge(self, what: str, used: int, most: int, by: str) -> None:
        """Warn if a resource is nearly used up."""
        code = EventCode.SESSIONS_FULL if what == "sessions" else EventCode.DESCRIPTORS_FULL
        words = f"{used} of {most} {what} of the gateway are in use{by}: soon nobody new is let in, but for stops"
        self._warn(used >= most * NEARLY * self._less(code), coded(words, code, used=used, most=most))

    def _less(self, code: EventCode) -> float:
        """Return the factor on a warning's threshold: less than 1 once it has been given."""
        return 0.9 if code in self._warnings else 1.0

    def _warn(self, too_much: bool, text: EventText) -> None:
        """Warn while there is too much of something, and announce it once."""
        if not too_much:
            self._warnings.pop(text.code, None)
            return
        if text.code not in self._warnings:
            self._announce(Notice("service", "warning", text.text, **text.fields))
        self._warnings[text.code] = text.text


PATIENCE = 5.0
"""Time after the start for which a router may be dialled without a warning [s]."""
ASK_EVERY = 15.0
"""Interval between two checks why a router is not reached [s]."""


@dataclass
class _Router:
    endpoint: str
    ask_at: float
    """Time of the next check why there is no link."""
    linked: bool | None = None
    """State announced last; None before."""
    asked: Future[str] | None = None
    warning: str = ""
    """Warning while there is no link and that has been announced."""


class RouterLinks:
    """Monitor of router links: announces a new, lost or missing link once; `warnings` lasts as long as it is missing.

    `linked` returns the linked endpoints immediately; `why_not` why there is no link to one, which may take seconds: it
    is called by a thread of its own.
    """

    def __init__(
        self,
        endpoints: Sequence[str],
        linked: Callable[[], Collection[str]],
        why_not: Callable[[str], str],
        announce: Callable[[Notice], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._linked, self._why_not, self._announce, self._clock = linked, why_not, announce, clock
        self._routers = [_Router(endpoint, clock() + PATIENCE) for endpoint in endpoints]
        self._due = 0.0
        self._asking = ThreadPoolExecutor(1, "router")

    def warnings(self) -> tuple[str, ...]:
        """Return which routers are not reached, and why, one line each."""
        return tuple(router.warning for router in self._routers if router.warning)

    def poll(self) -> None:
        """Check the links if it is time."""
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
        """End without waiting for a pending `why_not`."""
        self._asking.shutdown(wait=False, cancel_futures=True)

    def _is_there(self, router: _Router, now: float) -> None:
        if not router.linked:
            words = f"linked to the router {router.endpoint}"
            text = coded(words, EventCode.ROUTER_LINKED, router=router.endpoint)
            self._announce(Notice("service", "info", text.text, **text.fields))
        router.linked, router.asked, router.warning, router.ask_at = True, None, "", now

    def _lacks(self, router: _Router, now: float) -> None:
        if router.asked is None and now >= router.ask_at:
            router.asked = self._asking.submit(self._why_not, router.endpoint)
            router.ask_at = now + ASK_EVERY
        if router.asked is None or not router.asked.done():
            return
        error = router.asked.exception()  # an unknown peer answers there, and must not end this service
        why = quoted(f"{error!r}") if error is not None else router.asked.result()
        router.asked = None
        why = why or "it answers, but opens no session: is it a router that takes this robot?"
        router.warning = f"no link to the router {router.endpoint}: {why}; it is dialled again, local control goes on"
        if router.linked is not False:
            router.linked = False
            text = coded(router.warning, EventCode.ROUTER_LOST, router=router.endpoint)
            self._announce(Notice("service", "warning", text.text, **text.fields))
