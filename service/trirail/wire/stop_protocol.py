"""Protocol of the stop port, a TCP or Unix socket in addition to each Zenoh endpoint.

Request and answer are one line of JSON each. The stop port uses neither the handshakes nor the sessions of Zenoh, so
clients that occupy the Zenoh endpoint cannot delay a stop.
"""

from __future__ import annotations

import contextlib
import re
from typing import NamedTuple

import msgspec
from msgspec import Struct

from trirail.errors import RefusalCode, RefusedError
from trirail.wire import boundary
from trirail.wire.decoding import INVALID, decoder, prepare
from trirail.wire.endpoints import LAST_PORT, ReachableBy, reach, socket_file, tcp_address
from trirail.wire.messages import CommandReply, ErrorReply
from trirail.wire.vocabulary import Command

STOPS = frozenset(name for name in Command if name.stops and name.ignores_lease)
"""Commands that the stop port accepts, which are all commands that stop the robot and ignore the lease."""
MAX_LINE = 4096
"""Maximum size of a request or an answer [bytes]."""
PORT_OFFSET = 1000
"""Number that is added to the endpoint's port; it is subtracted if the sum exceeds the last port.

The offset is not 1, because the next port may belong to another robot."""
SUFFIX = ".stop"
"""Suffix that is appended to the name of the Zenoh endpoint's Unix socket."""


class StopRequest(Struct, frozen=True, forbid_unknown_fields=True):
    """Request to stop. The client also sends a copy over Zenoh."""

    key: str
    """Key of the query: trirail/<robot>/cmd/<user>/<name>."""
    id: str = ""
    """Id that a stop shares with its copy over Zenoh; the service carries the stop out once, and replies to both.

    Use a new id for every stop, or none."""
    content: str = ""
    """Content of the command as JSON, as in the payload of the query."""


class StopAnswer(Struct, frozen=True, omit_defaults=True):
    """Answer to a stop, either with a reply or with an error."""

    reply: CommandReply | None = None
    error: ErrorReply | None = None


class _KeyOnly(Struct, frozen=True):
    """Request of which only the key is read."""

    key: str


prepare(StopRequest, StopAnswer, _KeyOnly, str)
_KEY = re.compile(rb'"key"\s*:\s*("(?:[^"\\]|\\.)*")')
"""Key in a line that is not JSON, for example because it is cut off."""


class StopAddress(NamedTuple):
    """Address of a stop port."""

    where: tuple[str, int] | str
    """Host and port, or the file of a Unix socket."""
    secured: bool
    """Whether both sides must authenticate with certificates."""

    def __str__(self) -> str:
        return self.where if isinstance(self.where, str) else f"{self.where[0]}:{self.where[1]}"


def stop_address(endpoint: str) -> StopAddress | None:
    """Return the address of the stop port that belongs to a Zenoh endpoint.

    The address is the endpoint's port plus PORT_OFFSET, or the file of the endpoint's socket with SUFFIX. Return None
    if the endpoint is invalid.
    """
    if (file := socket_file(endpoint)) is not None:
        return StopAddress(f"{file}{SUFFIX}", secured=False)
    address = tcp_address(endpoint)
    if address is None:
        return None
    host, port = address
    stop_port = port + PORT_OFFSET if port + PORT_OFFSET <= LAST_PORT else port - PORT_OFFSET
    return StopAddress((host, stop_port), secured=reach(endpoint) is ReachableBy.CERTIFICATE)


def request_without_content(line: bytes) -> StopRequest | None:
    """Return a request with the key of an invalid line. Return None if the line contains no readable key."""
    with contextlib.suppress(*INVALID):
        return StopRequest(decoder(_KeyOnly).decode(line).key)
    if (match := _KEY.search(line)) is not None:
        with contextlib.suppress(*INVALID):
            return StopRequest(decoder(str).decode(match[1]))
    return None


def command_of(request: StopRequest, robot: str) -> tuple[str, Command]:
    """Return the user and the command of a request. Raises RefusedError if the request is not a stop for this robot."""
    user, name = boundary.names(request.key, f"trirail/{robot}/cmd", ("user", "command"))
    if name not in STOPS:
        raise RefusedError(
            RefusalCode.UNKNOWN_COMMAND,
            f"the stop port accepts only {', '.join(sorted(STOPS))}; send other commands over Zenoh",
        )
    return user, Command(name)


def encode(message: StopRequest | StopAnswer) -> bytes:
    """Return a message as a line of JSON."""
    return msgspec.json.encode(message) + b"\n"


def answer_with(content: CommandReply | ErrorReply) -> bytes:
    """Return an answer with a reply or an error as a line of JSON."""
    return encode(StopAnswer(error=content) if isinstance(content, ErrorReply) else StopAnswer(reply=content))
