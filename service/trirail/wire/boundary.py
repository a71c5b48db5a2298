"""What comes from outside becomes a value here, or a refusal that says what would be right. Nothing behind it raises.

Both ways: keys, goals and commands that come to the service; replies, states, events and records that come to a client.
"""

from __future__ import annotations

from typing import Any

import msgspec

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.decoding import decoded, decoder, prepare
from trirail.wire.goals import Goal
from trirail.wire.looks import AlignmentLook
from trirail.wire.messages import CommandReply, ErrorReply, Event, GoalReply, RoleReply
from trirail.wire.sizes import MAX_MESSAGE
from trirail.wire.state import Info, NamedPose, NamedPoses, RobotSummary, State
from trirail.wire.text import check_name, printable, quoted
from trirail.wire.vocabulary import Command

JSON, MSGPACK, BINARY = "application/json", "application/msgpack", "application/octet-stream"
_READ_AS = {
    "": JSON,
    "zenoh/bytes": JSON,  # what Zenoh says where nobody said anything
    "zenoh/string": JSON,
    "text/plain": JSON,
    "text/json": JSON,
    JSON: JSON,
    MSGPACK: MSGPACK,
}

_NULL = {JSON: b"null", MSGPACK: b"\xc0"}

prepare(Goal, *(command.accepts for command in Command), GoalReply, CommandReply, RoleReply, ErrorReply)
prepare(State, Event, Info, NamedPose, NamedPoses, RobotSummary, AlignmentLook)


def names(key: str, prefix: str, wanted: tuple[str, ...]) -> list[str]:
    """Return the parts of a key after its prefix, as many as are wanted; the first is a user.

    Raises RefusedError for wildcards, for too few or too many parts, and for what cannot name a user or a pose.
    """
    form = "/".join((prefix, *(f"<{name}>" for name in wanted)))
    if "*" in key:
        raise RefusedError(RefusalCode.WILDCARD, f"{quoted(key)}: name one robot and one user, as {form}")
    parts = key.removeprefix(f"{prefix}/").split("/")
    if not key.startswith(f"{prefix}/") or len(parts) != len(wanted):
        raise RefusedError(RefusalCode.UNKNOWN_KEY, f"{quoted(key)}: no such key; there is {form}")
    for part, name in zip(parts, wanted, strict=True):
        if name in ("user", "pose"):
            check_name(part, name)
    return parts


def check_size(size: int) -> None:
    """Raise RefusedError for more bytes than are decoded."""
    if size > MAX_MESSAGE:
        raise RefusedError(RefusalCode.TOO_LARGE, too_large(size))


def too_large(size: int) -> str:
    """Return why a message of so many bytes is refused."""
    return f"the message has {size} bytes: at most {MAX_MESSAGE} are taken"


def encoding(name: str) -> str:
    """Return how a payload is to be read, JSON or MSGPACK. Raises RefusedError where neither is meant."""
    read_as = _READ_AS.get(name.split(";", maxsplit=1)[0])
    if read_as is None:
        problem = f"encoding {quoted(name)}: JSON ({JSON}, also where none is given) and {MSGPACK} are taken"
        raise RefusedError(RefusalCode.UNKNOWN_ENCODING, problem)
    return read_as


def decode(payload: bytes, kind: Any, what: str, encoded: str = JSON) -> Any:
    """Read a message of a kind, a type or union; an empty one is null. Raises RefusedError, beginning with `what`."""
    check_size(len(payload))
    read_as = encoding(encoded)
    try:
        content = payload or _NULL[read_as]
        return decoded(content, kind) if read_as == JSON else decoder(kind, packed=True).decode(content)
    except RecursionError as error:
        raise RefusedError(RefusalCode.MALFORMED, f"{what}: nested too deep") from error
    except (msgspec.MsgspecError, ValueError, OverflowError) as error:
        raise RefusedError(RefusalCode.MALFORMED, f"{what}: {quoted(_plain(error))}") from error


def encode(content: msgspec.Struct, encoded: str = JSON) -> bytes:
    """Write a message as JSON, or as msgpack where that is named."""
    return msgspec.msgpack.encode(content) if encoded == MSGPACK else msgspec.json.encode(content)


def _plain(error: Exception) -> str:
    return printable(str(error)).replace("`", "").replace(" - at $.", ": ").replace(" - at $", "")
