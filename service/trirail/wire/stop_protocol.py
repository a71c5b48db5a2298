"""The stop port: a TCP or Unix socket beside each Zenoh endpoint, with one line of JSON in each direction.

Other clients cannot delay a stop here by occupying the Zenoh endpoint, because this port uses neither its handshakes
nor its sessions.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
from msgspec import Struct

from trirail.errors import RefusalCode, RefusedError
from trirail.wire import boundary
from trirail.wire.decoding import prepare
from trirail.wire.endpoints import LAST_PORT, ReachableBy, reach, socket_file, tcp_address
from trirail.wire.messages import CommandReply, ErrorReply
from trirail.wire.vocabulary import Command

STOPS = frozenset(name for name in Command if name.stops and name.ignores_lease)
"""Commands that the stop port accepts: those that stop the robot and ignore the lease."""
MAX_LINE = 4096
"""Maximum size of a request or an answer [bytes]."""
PORT_OFFSET = 1000
"""Difference to the endpoint's port, subtracted if the sum is too large; the next port may belong to another robot."""
SUFFIX = ".stop"
"""Suffix of the socket's file, appended to that of Zenoh's."""


class StopRequest(Struct, frozen=True, forbid_unknown_fields=True):
    """A stop; the client also sends a copy over Zenoh."""

    key: str
    """Key of the query: trirail/<robot>/cmd/<user>/<name>."""
    id: str = ""
    """Id that all copies share: the stop is executed once, and each copy gets a reply."""
    content: str = ""
    """Payload of the query, as JSON."""


class StopAnswer(Struct, frozen=True, omit_defaults=True):
    """Answer to a stop, with one of the two fields."""

    reply: CommandReply | None = None
    error: ErrorReply | None = None


prepare(StopRequest, StopAnswer)


class StopAddress(NamedTuple):
    """Address of a stop port."""

    where: tuple[str, int] | str
    """Host and port, or the file of a Unix socket."""
    secured: bool
    """Whether both sides show certificates."""

    def __str__(self) -> str:
        return self.where if isinstance(self.where, str) else f"{self.where[0]}:{self.where[1]}"


def stop_address(endpoint: str) -> StopAddress | None:
    """Return the stop port of an endpoint: its port plus PORT_OFFSET, or its socket's file with SUFFIX.

    None for protocols other than tcp, tls and unixsock-stream.
    """
    if (file := socket_file(endpoint)) is not None:
        return StopAddress(f"{file}{SUFFIX}", secured=False)
    address = tcp_address(endpoint)
    if address is None or endpoint.startswith("ws/"):
        return None
    host, port = address
    door = port + PORT_OFFSET if port + PORT_OFFSET <= LAST_PORT else port - PORT_OFFSET
    return StopAddress((host, door), secured=reach(endpoint) is ReachableBy.CERTIFICATE)


def command_of(request: StopRequest, robot: str) -> tuple[str, Command]:
    """Return user and command of a request. Raises RefusedError if it is not a stop for this robot."""
    user, name = boundary.names(request.key, f"trirail/{robot}/cmd", ("user", "command"))
    if name not in STOPS:
        raise RefusedError(
            RefusalCode.UNKNOWN_COMMAND,
            f"the stop port accepts only {', '.join(sorted(STOPS))}; send other commands over Zenoh",
        )
    return user, Command(name)


def encode(message: StopRequest | StopAnswer) -> bytes:
    """Return the line of a message."""
    return msgspec.json.encode(message) + b"\n"


def answer_with(content: CommandReply | ErrorReply) -> bytes:
    """Return the line of an answer with a reply or an error."""
    return encode(StopAnswer(error=content) if isinstance(content, ErrorReply) else StopAnswer(reply=content))
