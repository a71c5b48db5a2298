"""Detection of other services with the same robot name, to which Zenoh would deliver the same messages.

Two services can have links to the same router, for example if a configuration was copied without a new robot name. A
goal would then move both robots. Each gateway therefore declares a liveliness token with the identity of its run of the
service, and watches the tokens of other runs.

A router passes nothing from one peer to another. The gateway's session is a peer, so a further session watches each
router as a client.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Final

import zenoh

from trirail.errors import RefusalCode, RefusedError
from trirail.wire import zenoh_session
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.messages import Notice
from trirail.wire.vocabulary import Command

CHECK_PERIOD_S: Final = 1.0
"""Interval between two checks for new links to routers [s]."""
GRACE_S: Final = 12.0
"""Time after the start of the gateway in which another service is not reported [s].

The other service may be an earlier run that lost its connection. Its token stays until Zenoh's lease of 10 s ends.
"""
REFUSED: Final = frozenset({Command.ENABLE, Command.HOME, Command.RESUME, Command.SET_OUTPUT})
"""Commands that are refused while another service has the same robot name, because they would act on both robots."""
REFUSED_IF_HIGHER: Final = frozenset({Command.OVERRIDE})
"""Commands that are refused in the same case if their value is higher than the present one."""
_REMEDY = "give each robot its own [robot] name; a service that lost its connection disappears after 10 s"


class NameConflict:
    """Watch for other services with the same robot name.

    Parameters
    ----------
    run
        Identity of this run of the service. A restarted gateway of the same run is not another service.
    linked
        Function that returns the endpoints of the routers with a link. It must not block.
    open_client
        Function that opens a client session to an endpoint. It is called in a thread. Raises ServiceError.
    announce
        Function that announces a notice.

    """

    def __init__(
        self,
        session: zenoh.Session,
        robot: str,
        run: str,
        linked: Callable[[], Collection[str]],
        open_client: Callable[[str], zenoh.Session],
        announce: Callable[[Notice], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._robot, self._linked, self._open_client = robot, linked, open_client
        self._announce, self._clock = announce, clock
        self._own = zenoh_session.key(robot, "run", run)
        self._tokens: set[tuple[str, str]] = set()
        """Endpoint and key of each token of another service; the endpoint of the gateway's own session is ""."""
        self._warning = ""
        self._grace_ends = clock() + GRACE_S
        self._check_at = clock()
        self._routers: dict[str, Future[tuple[zenoh.Session, object]]] = {}
        """Session and subscriber for each router, by endpoint. The session reconnects when its link is lost."""
        self._opening = ThreadPoolExecutor(1, "name")
        self._declared = self._watch("", session), session.liveliness().declare_token(self._own)

    def poll(self) -> None:
        """Watch new links to routers, and update the warning. Announce the warning if it is new."""
        now = self._clock()
        if now >= self._check_at:
            self._check_at = now + CHECK_PERIOD_S
            for endpoint in self._linked():
                opened = self._routers.get(endpoint)
                if opened is None or (opened.done() and opened.exception() is not None):
                    self._routers[endpoint] = self._opening.submit(self._watch_router, endpoint)
        if not self._tokens:
            self._warning = ""
        elif not self._warning and now >= self._grace_ends:
            words = (
                f"robot name {self._robot}: another service in this Zenoh network has the same name; goals, enable, "
                f"home, resume, set_output and a higher override are refused; {_REMEDY}"
            )
            text = coded(words, EventCode.NAME_IN_USE, robot=self._robot)
            self._announce(Notice("service", "error", text.text, **text.fields))
            self._warning = text.text

    def warnings(self) -> tuple[str, ...]:
        """Return the warning that another service has the same robot name, if there is one."""
        return (self._warning,) if self._warning else ()

    @property
    def exists(self) -> bool:
        """Whether another service has the same robot name."""
        return bool(self._tokens)

    def check(self, request: str) -> None:
        """Raise RefusedError if a request, such as "a goal", would act on the robot of another service too."""
        if self.exists:
            problem = (
                f"robot name {self._robot}: another service in this Zenoh network has the same name; {request} would "
                f"act on both robots; {_REMEDY}"
            )
            raise RefusedError(RefusalCode.NAME_IN_USE, problem)

    def close(self) -> None:
        """Close the sessions to the routers."""
        self._opening.shutdown(cancel_futures=True)
        for opened in self._routers.values():
            if not opened.cancelled() and opened.exception() is None:
                zenoh_session.close(opened.result()[0])

    def _watch_router(self, endpoint: str) -> tuple[zenoh.Session, object]:
        session = self._open_client(endpoint)
        return session, self._watch(endpoint, session)

    def _watch(self, endpoint: str, session: zenoh.Session) -> object:
        on_token = zenoh.handlers.Callback(partial(self._on_token, endpoint), indirect=False)
        every = zenoh_session.key(self._robot, "run", "*")
        return session.liveliness().declare_subscriber(every, on_token, history=True)

    def _on_token(self, endpoint: str, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.DELETE:
            self._tokens.discard((endpoint, key))
        elif key != self._own:
            self._tokens.add((endpoint, key))
