"""A message as it has come to the gateway, before anything of it is decoded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import zenoh

from trirail.wire import boundary

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
