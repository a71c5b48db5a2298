"""Monitoring of the gateway's Zenoh links to clients, whose number is limited, and to routers.

Zenoh limits the total number of sessions, but not the number per certificate. The gateway therefore checks the links.
If few sessions are left, it ends the newest sessions of the user with the most sessions, beginning with users without a
role. Zenoh itself connects to the routers in [zenoh] connect. This module reports whether these links exist.
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

CHECK_PERIOD_S: Final = 1.0
"""Interval between two checks of the links [s]."""
WARNING_SHARE: Final = 0.8
"""Fraction of a limited resource at which a warning begins. The warning ends below nine tenths of this fraction."""
FREE_SHARE: Final = 0.1
"""Fraction of all sessions that is kept free for users with few sessions."""
PROTECTED_SESSIONS: Final = 8
"""Number of sessions of each user with a role that are never ended."""


class ResourceUse(NamedTuple):
    """Number of sessions and file descriptors in use, and their limits."""

    sessions: int
    sessions_most: int
    descriptors: int
    descriptors_most: int
    unopened: int = 0
    """Number of connections to TLS endpoints that have not opened a session."""


def surplus(links: Mapping[str, str], users: Container[str], most: int) -> set[str]:
    """Return the addresses whose sessions must be ended, so that the fraction FREE_SHARE of all sessions is free.

    Parameters
    ----------
    links
        Name in the certificate of each link, by address, from the oldest to the newest link. Links without a
        certificate are not included.
    users
        Users with a role.
    most
        Maximum number of sessions.

    """
    of: dict[str, list[str]] = {}
    for at, name in links.items():
        of.setdefault(name, []).append(at)
    ending: set[str] = set()
    for _ in range(len(links) - round(most * (1.0 - FREE_SHARE))):
        greedy = [(name not in users, len(own), name) for name, own in of.items() if own]
        spare = [one for one in greedy if one[0] or one[1] > PROTECTED_SESSIONS]
        if not spare:
            break
        *_, name = max(spare)
        ending.add(of[name].pop())
    return ending


FAILED_A_SECOND: Final = 10.0
"""Number of failed handshakes that Zenoh handles per second. After each, Zenoh accepts no connection for 0.1 s."""
UNOPENED: Final = 20
"""Number of connections without a session at which a warning begins."""


class LinkMonitor:
    """Monitor of the links to clients, which checks them once per second.

    It ends surplus sessions, and warns before limits are reached.

    Parameters
    ----------
    links
        Function that returns the name in the certificate of each link, by address; None without a certificate.
    end
        Function that ends the sessions of a set of addresses.
    users
        Users with a role.
    most
        Maximum number of sessions.
    unopened
        Function that returns the number of connections without a session, by host, given the addresses of all links.

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
        self.use = ResourceUse(0, most, 0, sockets.descriptor_limit())
        """Resources in use at the last check."""

    def warnings(self) -> tuple[str, ...]:
        """Return warnings about resources that are nearly used up, with one line per warning."""
        return tuple(self._warnings.values())

    def poll(self) -> None:
        """Check the links if it is time."""
        now = self._clock()
        if now < self._due:
            return
        self._due = now + CHECK_PERIOD_S
        links = self._links()
        self._seen = {at: None for at in (*self._seen, *links) if at in links}
        unopened = self._unopened(links)
        descriptors = sockets.descriptors_used(), sockets.descriptor_limit()
        self.use = ResourceUse(len(links), self._most, *descriptors, unopened.total())
        named = {at: name for at in self._seen if (name := links[at]) is not None}
        if ending := surplus(named, self._users, self._most):
            self._end(ending)
        (name, own), *_ = Counter(named.values()).most_common(1) or [("", 0)]
        by = f", {own} by {name}" if name else ""
        self._check_use("sessions", self.use.sessions, self._most, by)
        self._check_use("descriptors", self.use.descriptors, self.use.descriptors_most, "")
        count = unopened.total()
        by = ", ".join(f"{number} from {host}" for host, number in unopened.most_common(1))
        wait = count / FAILED_A_SECOND
        words = (
            f"{count} connections to the gateway have not opened a session ({by}): new ones wait {wait:.0f} s; stops "
            "do not"
        )
        text = coded(words, EventCode.CONNECTIONS_WAIT, count=count, wait=wait)
        self._warn(count >= UNOPENED * self._hysteresis(text.code), text)

    def _check_use(self, what: str, used: int, most: int, by: str) -> None:
        """Set or clear the warning that a resource is nearly used up."""
        code = EventCode.SESSIONS_FULL if what == "sessions" else EventCode.DESCRIPTORS_FULL
        words = (
            f"{used} of {most} {what} of the gateway are in use{by}: when all are in use, new clients can only stop "
            "the robot"
        )
        self._warn(used >= most * WARNING_SHARE * self._hysteresis(code), coded(words, code, used=used, most=most))

    def _hysteresis(self, code: EventCode) -> float:
        """Return the factor for the threshold of a warning, which is below 1 while the warning is active."""
        return 0.9 if code in self._warnings else 1.0

    def _warn(self, too_much: bool, text: EventText) -> None:
        """Set a warning if `too_much`, otherwise clear it. Announce the warning if it is new."""
        if not too_much:
            self._warnings.pop(text.code, None)
            return
        if text.code not in self._warnings:
            self._announce(Notice("service", "warning", text.text, **text.fields))
        self._warnings[text.code] = text.text


ROUTER_GRACE_S = 5.0
"""Time after the start in which there are no warnings about unreachable routers [s]."""
DIAGNOSIS_PERIOD_S = 15.0
"""Interval at which the reason for a missing link is diagnosed again [s]."""


@dataclass
class _Router:
    endpoint: str
    ask_at: float
    """Time of the next diagnosis, if the link is missing [s]."""
    linked: bool | None = None
    """Whether the link existed when it was last announced; None before the first announcement."""
    asked: Future[str] | None = None
    warning: str = ""
    """Warning that the link is missing; empty while the link exists."""


class RouterLinks:
    """Monitor of the links to routers, which announces each new, lost or missing link once.

    Parameters
    ----------
    endpoints
        Endpoints of the routers.
    linked
        Function that returns the endpoints with a link. It must not block.
    why_not
        Function that returns the reason why an endpoint has no link. It is called in a thread, because it may take
        seconds.

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
        self._routers = [_Router(endpoint, clock() + ROUTER_GRACE_S) for endpoint in endpoints]
        self._due = 0.0
        self._asking = ThreadPoolExecutor(1, "router")

    def warnings(self) -> tuple[str, ...]:
        """Return warnings about routers without a link, with one line per warning."""
        return tuple(router.warning for router in self._routers if router.warning)

    def poll(self) -> None:
        """Check the links if it is time."""
        now = self._clock()
        if not self._routers or now < self._due:
            return
        self._due = now + CHECK_PERIOD_S
        linked = self._linked()
        for router in self._routers:
            if router.endpoint in linked:
                self._on_linked(router, now)
            else:
                self._on_missing(router, now)

    def close(self) -> None:
        """Close the monitor without waiting for a pending diagnosis."""
        self._asking.shutdown(wait=False, cancel_futures=True)

    def _on_linked(self, router: _Router, now: float) -> None:
        if not router.linked:
            words = f"linked to the router {router.endpoint}"
            text = coded(words, EventCode.ROUTER_LINKED, router=router.endpoint)
            self._announce(Notice("service", "info", text.text, **text.fields))
        router.linked, router.asked, router.warning, router.ask_at = True, None, "", now

    def _on_missing(self, router: _Router, now: float) -> None:
        if router.asked is None and now >= router.ask_at:
            router.asked = self._asking.submit(self._why_not, router.endpoint)
            router.ask_at = now + DIAGNOSIS_PERIOD_S
        if router.asked is None or not router.asked.done():
            return
        error = router.asked.exception()  # not raised, because an error with an unknown peer must not end the service
        why = quoted(f"{error!r}") if error is not None else router.asked.result()
        router.asked = None
        why = why or "the router answers, but opens no session: check that it is a router for this robot"
        router.warning = (
            f"no link to the router {router.endpoint}: {why}; the connection is retried, and local control continues"
        )
        if router.linked is not False:
            router.linked = False
            text = coded(router.warning, EventCode.ROUTER_LOST, router=router.endpoint)
            self._announce(Notice("service", "warning", text.text, **text.fields))
