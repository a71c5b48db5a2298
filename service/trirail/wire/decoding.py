"""Decoders, one of each type and format: made when the module that needs them is imported, none later.

msgspec 0.22 puts what it knows of a struct on its class before that is complete, and runs Python until it is: a second
thread that decodes or converts such a type meanwhile ends the interpreter with SIGSEGV
(tools/reports/msgspec_first_decode.py). An encoder keeps nothing of a type.
"""

from __future__ import annotations

import json
import threading
from collections import Counter
from typing import Any, TypeVar, overload

import msgspec

from trirail.wire.text import quoted

T = TypeVar("T")
Decoder = msgspec.json.Decoder[Any] | msgspec.msgpack.Decoder[Any]

_MADE: dict[Any, tuple[msgspec.json.Decoder[Any], msgspec.msgpack.Decoder[Any]]] = {}
_MAKING = threading.Lock()
"""Two modules may be imported at once, and their types have others in common."""


def prepare(*kinds: Any) -> None:
    """Make the decoders of types or unions, and of all that is in them."""
    with _MAKING:
        for kind in kinds:
            if kind not in _MADE:
                _MADE[kind] = msgspec.json.Decoder(kind), msgspec.msgpack.Decoder(kind)


def decoder(kind: Any, *, packed: bool = False) -> Decoder:
    """Return the decoder of a prepared type, for JSON or msgpack. Raises LookupError for another type."""
    if kind not in _MADE:
        raise LookupError(f"{kind!r} is not prepared: its decoder would be made while other threads decode")
    return _MADE[kind][packed]


@overload
def decoded(content: bytes | str, kind: type[T]) -> T: ...
@overload
def decoded(content: bytes | str, kind: object) -> Any: ...
def decoded(content: bytes | str, kind: object) -> Any:
    """Return the value of a prepared type that JSON says.

    Raises LookupError, and as msgspec.json.decode; msgspec.ValidationError also where an object has a key twice:
    decoders take the last, others the first (RFC 8259, 4).
    """
    value = decoder(kind).decode(content)  # type: ignore[arg-type]  # JSON may be text
    _KEYS.decode(content if isinstance(content, str) else content.decode())
    return value


def _refuse_twice(pairs: list[tuple[str, object]]) -> None:
    if len({key for key, _ in pairs}) < len(pairs):
        (key, times), *_ = Counter(key for key, _ in pairs).most_common()
        often = "twice" if times == 2 else f"{times} times"
        raise msgspec.ValidationError(f"{quoted(key)} stands {often}: once would be right")


_KEYS = json.JSONDecoder(object_pairs_hook=_refuse_twice, parse_int=len, parse_float=len)
"""Looks at keys alone: no numbers are made. It takes as long as the decoder itself, 3 µs for a pose."""


@overload
def converted(value: object, kind: type[T]) -> T: ...
@overload
def converted(value: object, kind: object) -> Any: ...
def converted(value: object, kind: Any) -> Any:
    """Return a value of a prepared type from what is built in. Raises LookupError, and as msgspec.convert."""
    decoder(kind)
    return msgspec.convert(value, kind)
