"""Decoding and validation of all data from the network, so that other code need not check the data again.

Invalid input raises RefusedError with the expected form. The service uses this module to decode keys, goals and
commands. Clients use it to decode replies, states and events.
"""

from __future__ import annotations

from typing import Any

import msgspec

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.decoding import decoded, decoder, prepare
from trirail.wire.goals import Goal, PathGoal
from trirail.wire.looks import AlignmentLook
from trirail.wire.messages import CommandReply, ErrorReply, Event, GoalReply, RoleReply
from trirail.wire.sizes import MAX_MESSAGE
from trirail.wire.state import Info, NamedPose, NamedPoses, RobotSummary, State
from trirail.wire.text import check_name, printable, quoted
from trirail.wire.vocabulary import Command

JSON, MSGPACK, BINARY = "application/json", "application/msgpack", "application/octet-stream"
_READ_AS = {
    "": JSON,
    "zenoh/bytes": JSON,  # Zenoh's default if the sender specifies no encoding
    "zenoh/string": JSON,
    "text/plain": JSON,
    "text/json": JSON,
    JSON: JSON,
    MSGPACK: MSGPACK,
}

_NULL = {JSON: b"null", MSGPACK: b"\xc0"}

prepare(Goal, PathGoal, *(command.accepts for command in Command), GoalReply, CommandReply, RoleReply, ErrorReply)
prepare(State, Event, Info, NamedPose, NamedPoses, RobotSummary, AlignmentLook)


def names(key: str, prefix: str, wanted: tuple[str, ...]) -> list[str]:
    """Return the parts of a key after its prefix, one part for each name in `wanted`.

    Raises
    ------
    RefusedError
        If the key contains wildcards, lacks the prefix or has the wrong number of parts, or if a part that names a user
        or a pose is not a valid name.
    """
    form = "/".join((prefix, *(f"<{name}>" for name in wanted)))
    if "*" in key:
        raise RefusedError(RefusalCode.WILDCARD, f"key {quoted(key)} contains a wildcard; send to {form}")
    parts = key.removeprefix(f"{prefix}/").split("/")
    if not key.startswith(f"{prefix}/") or len(parts) != len(wanted):
        raise RefusedError(RefusalCode.UNKNOWN_KEY, f"key {quoted(key)} does not exist; send to {form}")
    for part, name in zip(parts, wanted, strict=True):
        if name in ("user", "pose"):
            check_name(part, name)
    return parts


def command_named(name: str) -> Command:
    """Return the command with this name. Raises RefusedError for an unknown command."""
    try:
        return Command(name)
    except ValueError as error:
        problem = f"unknown command {quoted(str(name))}: use one of {', '.join(Command)}"
        raise RefusedError(RefusalCode.UNKNOWN_COMMAND, problem) from error


def check_size(size: int) -> None:
    """Raise RefusedError if a message exceeds the maximum size."""
    if size > MAX_MESSAGE:
        raise RefusedError(RefusalCode.TOO_LARGE, too_large(size))


def too_large(size: int) -> str:
    """Return the error message for a message that exceeds the maximum size."""
    return f"message: {size} bytes exceed the maximum of {MAX_MESSAGE} bytes"


def encoding(name: str) -> str:
    """Return the format, JSON or MSGPACK, for the name of a Zenoh encoding. Raises RefusedError for other encodings."""
    read_as = _READ_AS.get(name.split(";", maxsplit=1)[0])
    if read_as is None:
        problem = f"encoding {quoted(name)} is not supported; use {JSON} (the default) or {MSGPACK}"
        raise RefusedError(RefusalCode.UNKNOWN_ENCODING, problem)
    return read_as


def decode(payload: bytes, kind: Any, what: str, encoded: str = JSON) -> Any:
    """Decode a payload as a message of the type or union `kind`; an empty payload counts as null.

    Raises RefusedError if the payload is too large or invalid; for an invalid payload, the error message begins with
    `what`.
    """
    check_size(len(payload))
    read_as = encoding(encoded)
    try:
        content = payload or _NULL[read_as]
        return decoded(content, kind) if read_as == JSON else decoder(kind, packed=True).decode(content)
    except RecursionError as error:
        raise RefusedError(RefusalCode.MALFORMED, f"{what}: nested too deeply") from error
    except (msgspec.MsgspecError, ValueError, OverflowError) as error:
        raise RefusedError(RefusalCode.MALFORMED, f"{what}: {quoted(_plain(error))}") from error


def encode(content: msgspec.Struct, encoded: str = JSON) -> bytes:
    """Return a message encoded as JSON, or as msgpack if `encoded` is MSGPACK."""
    return msgspec.msgpack.encode(content) if encoded == MSGPACK else msgspec.json.encode(content)


def _plain(error: Exception) -> str:
    return printable(str(error)).replace("`", "").replace(" - at $.", ": ").replace(" - at $", "")
