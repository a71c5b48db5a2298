"""Time of a program's call, with which a client marks its stops and the requests that may start motion.

A stop may overtake earlier requests of the same connection, because it is also sent to the stop port. The service
refuses such a request if it arrives after the stop.
"""

from __future__ import annotations

import re
import uuid
from typing import NamedTuple

_MARK = re.compile(r"([0-9a-f]{12})\.([0-9]{1,19})(?:\..*)?", re.DOTALL)


class CallMark(NamedTuple):
    """Connection and time of a call. As text, it is the attachment of a request and the beginning of a stop's id."""

    connection: str
    """Identity of the client's connection, which no other connection has."""
    called_ns: int
    """Time of the call on the client's monotonic clock [ns]."""

    def __str__(self) -> str:
        return f"{self.connection}.{self.called_ns}"

    def new_id(self) -> str:
        """Return a new id for a stop of this call."""
        return f"{self}.{uuid.uuid4().hex[:12]}"


def new_connection() -> str:
    """Return the identity of a new connection."""
    return uuid.uuid4().hex[:12]


def mark_in(text: str) -> CallMark | None:
    """Return the mark in the attachment of a request, or in the id of a stop; None if the text contains no mark."""
    parts = _MARK.fullmatch(text)
    return CallMark(parts[1], int(parts[2])) if parts is not None else None
