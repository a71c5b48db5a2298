"""A message as it has come to the gateway, before anything of it is decoded; and stops that come twice.

A stop goes over Zenoh and to the door: it is carried out once, and each copy is answered alike. The slower copy may
come when the robot moves again: it must not stop goals that were sent after the first was confirmed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import msgspec
import zenoh

from trirail.errors import RefusalCode
from trirail.wire import boundary
from trirail.wire.messages import ErrorReply

Kind = Literal["goal", "cmd", "info", "role", "poses", "teach", "forget", "alignment"]


class Incoming(NamedTuple):
    """A query or a put, as Zenoh handed it over, or a request at the door for stops."""

    kind: Kind
    key: str
    """As it was sent: it may have wildcards."""
    size: int
    """Of the payload [bytes]."""
    payload: bytes
    """Empty where it is larger than is decoded."""
    encoding: str
    query: zenoh.Query | None
    """None for a put, which has no answer, and for a request at the door."""
    arrived_ns: int
    """When it came, by the monotonic clock: it may have waited since, behind its user's others."""
    number: int = 0
    """Messages are numbered as they come."""
    id: str = ""
    """Of a stop: the same in every copy of it; "" where it has none."""
    at_door: Callable[[Any], None] | None = None
    """Of a request at the door: takes its answer."""
    alike: tuple[Incoming, ...] = ()
    """Stops of the same user, kind and content that came behind it before it was read: one is carried out for all."""

    @property
    def user(self) -> str:
        """Who is said to have sent it; "" for what names nobody."""
        return self.key.split("/")[3] if self.key.count("/") > 2 else ""

    def content(self, kind: Any, what: str) -> Any:
        """Return its payload as a message of that kind, a type or union. Raises RefusedError, beginning with `what`."""
        boundary.check_size(self.size)
        return boundary.decode(self.payload, kind, what, self.encoding)

    def unanswered(self) -> Incoming:
        """Return it as one that nobody waits for an answer to."""
        return self._replace(query=None, at_door=None, alike=())


REMEMBERED = 60.0
"""How long an answer is kept for a copy that is to come; nobody waits longer for one [s]."""
MOST = 4096
"""So many are remembered at once; beyond that the oldest are forgotten."""

_Id = tuple[str, str, bytes]


class _Stop:
    """What is known of one."""

    def __init__(self, came: float) -> None:
        self.came = came
        self.answer: msgspec.Struct | None = None
        self.waiting: list[Incoming] = []


class Copies:
    """Keeps which stops have come, by key, id and content. One without an id has no copies. `clock` gives seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._stops: dict[_Id, _Stop] = {}  # in the order in which they came

    def first(self, incoming: Incoming) -> bool:
        """Whether none of it has come before; a later one waits for the answer of the first, or has it `known`."""
        if not incoming.id:
            return True
        if (stop := self._stops.get(_id(incoming))) is not None:
            if stop.answer is None:
                stop.waiting.append(incoming)
            return False
        self._forget()
        self._stops[_id(incoming)] = _Stop(self._clock())
        return True

    def known(self, incoming: Incoming) -> msgspec.Struct | None:
        """Return what the first was answered; None where it was not yet."""
        stop = self._stops.get(_id(incoming))
        return stop.answer if stop is not None else None

    def answered(self, incoming: Incoming, content: msgspec.Struct) -> list[Incoming]:
        """Note an answer, and return who else has waited for it. What was not carried out is not remembered."""
        stop = self._stops.get(_id(incoming))
        if stop is None or stop.answer is not None:
            return []
        stop.answer = content
        if isinstance(content, ErrorReply) and content.code == RefusalCode.BUSY:
            del self._stops[_id(incoming)]
        waiting, stop.waiting = stop.waiting, []
        return waiting

    def _forget(self) -> None:
        """Forget what nobody asks for any more."""
        while self._stops:
            name, oldest = next(iter(self._stops.items()))
            if len(self._stops) < MOST and self._clock() - oldest.came < REMEMBERED:
                return
            del self._stops[name]


def _id(stop: Incoming) -> _Id:
    return stop.key, stop.id, stop.payload
