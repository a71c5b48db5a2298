"""The door for stops: where it is beside an endpoint of Zenoh's, and what is said there, a line of JSON each way.

What others do on an endpoint of Zenoh's keeps no stop out here: its handshakes and sessions have no part in this.
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

STOPS = frozenset(name for name in Command if name.stops and name.everybodys)
"""What is taken there: what brings the robot to rest, whoever has the lease."""
MAX_LINE = 4096
"""A request or an answer [bytes]."""
FARTHER = 1000
"""Its port is so many more than that of the endpoint, or less where there are none: the next may be another robot's."""
SUFFIX = ".stop"
"""Of the socket's file, behind that of Zenoh's."""


class StopRequest(Struct, frozen=True, forbid_unknown_fields=True):
    """A stop, as its copy over Zenoh has it."""

    key: str
    """That of the query: trirail/<robot>/cmd/<user>/<name>."""
    id: str = ""
    """The same in every copy: the stop is carried out once, and each copy is answered."""
    content: str = ""
    """The query's payload, JSON."""


class StopAnswer(Struct, frozen=True, omit_defaults=True):
    """What was made of it: one of the two."""

    reply: CommandReply | None = None
    error: ErrorReply | None = None


prepare(StopRequest, StopAnswer)


class StopAddress(NamedTuple):
    """Where the door is."""

    where: tuple[str, int] | str
    """Host and port, or the file of a Unix socket."""
    secured: bool
    """Whether both sides show certificates."""

    def __str__(self) -> str:
        return self.where if isinstance(self.where, str) else f"{self.where[0]}:{self.where[1]}"


def stop_address(endpoint: str) -> StopAddress | None:
    """Return where the door is that belongs to an endpoint: a port FARTHER, or the file beside a socket's.

    None where there is none: of protocols but tcp, tls and unixsock-stream.
    """
    if (file := socket_file(endpoint)) is not None:
        return StopAddress(f"{file}{SUFFIX}", secured=False)
    address = tcp_address(endpoint)
    if address is None or endpoint.startswith("ws/"):
        return None
    host, port = address
    door = port + FARTHER if port + FARTHER <= LAST_PORT else port - FARTHER
    return StopAddress((host, door), secured=reach(endpoint) is ReachableBy.CERTIFICATE)


def command_of(request: StopRequest, robot: str) -> tuple[str, Command]:
    """Return who asks a robot for what. Raises RefusedError for what is no stop of it."""
    user, name = boundary.names(request.key, f"trirail/{robot}/cmd", ("user", "command"))
    if name not in STOPS:
        raise RefusedError(RefusalCode.UNKNOWN_COMMAND, f"only {', '.join(sorted(STOPS))} are taken here")
    return user, Command(name)


def encode(message: StopRequest | StopAnswer) -> bytes:
    """Return a message as a line."""
    return msgspec.json.encode(message) + b"\n"


def answer_with(content: CommandReply | ErrorReply) -> bytes:
    """Return a reply or an error as an answer's line."""
    return encode(StopAnswer(error=content) if isinstance(content, ErrorReply) else StopAnswer(reply=content))
