"""The links to the routers of [zenoh] connect: Zenoh dials and dials again, and what is told of it is told here."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from trirail.wire.packets import Remark
from trirail.wire.text import quoted

LOOK_EVERY = 1.0
"""How often it is looked which links there are [s]."""
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
