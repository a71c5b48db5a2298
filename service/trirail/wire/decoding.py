"""Decoders for each type and format, created only while the module that needs them is imported.

msgspec 0.22 attaches its type information to the class of a struct before this information is complete, and runs Python
code to complete it. If a second thread decodes or converts the same type during this time, the interpreter crashes with
SIGSEGV (tools/reports/msgspec_first_decode.py). Encoders have no such problem, since they store nothing on the class.
"""

from __future__ import annotations

import json
import threading
from collections import Counter
from typing import Any, Final, TypeVar, overload

import msgspec

from trirail.wire.text import quoted

T = TypeVar("T")
Decoder = msgspec.json.Decoder[Any] | msgspec.msgpack.Decoder[Any]

INVALID: Final = (ValueError, RecursionError)
"""Errors with which decoders refuse invalid content.

The first includes msgspec.DecodeError, and UnicodeDecodeError for strings that are not UTF-8; the second is raised for
content that is nested too deeply.
"""

_MADE: dict[Any, tuple[msgspec.json.Decoder[Any], msgspec.msgpack.Decoder[Any]]] = {}
_MAKING = threading.Lock()
"""Lock for modules that are imported concurrently and prepare types with common components."""


def prepare(*kinds: Any) -> None:
    """Create the decoders of types or unions, which also completes the type information of all contained types."""
    with _MAKING:
        for kind in kinds:
            if kind not in _MADE:
                _MADE[kind] = msgspec.json.Decoder(kind), msgspec.msgpack.Decoder(kind)


def decoder(kind: Any, *, packed: bool = False) -> Decoder:
    """Return the decoder of a prepared type, for msgpack if `packed`, otherwise for JSON.

    Raises LookupError if the type is not prepared.
    """
    if kind not in _MADE:
        raise LookupError(f"{kind!r} is not prepared: its decoder would be made while other threads decode")
    return _MADE[kind][packed]


@overload
def decoded(content: bytes | str, kind: type[T]) -> T: ...
@overload
def decoded(content: bytes | str, kind: object) -> Any: ...
def decoded(content: bytes | str, kind: object) -> Any:
    """Decode JSON as a value of a prepared type.

    Raises the errors of msgspec.json.decode, and LookupError if the type is not prepared. Raises
    msgspec.ValidationError if an object contains a key twice, because some decoders would use the last value and others
    the first value (RFC 8259, 4).
    """
    value = decoder(kind).decode(content)  # type: ignore[arg-type]  # JSON may be a string
    _KEYS.decode(content if isinstance(content, str) else content.decode())
    return value


def _refuse_twice(pairs: list[tuple[str, object]]) -> None:
    if len({key for key, _ in pairs}) < len(pairs):
        (key, times), *_ = Counter(key for key, _ in pairs).most_common()
        often = "twice" if times == 2 else f"{times} times"
        raise msgspec.ValidationError(f"key {quoted(key)} is given {often}; give it once")


_KEYS = json.JSONDecoder(object_pairs_hook=_refuse_twice, parse_int=len, parse_float=len)
"""Decoder that checks only the keys and does not parse numbers. It is as fast as msgspec's decoder, 3 µs for a pose."""


@overload
def converted(value: object, kind: type[T]) -> T: ...
@overload
def converted(value: object, kind: object) -> Any: ...
def converted(value: object, kind: Any) -> Any:
    """Convert a value of built-in types to a prepared type.

    Raises the errors of msgspec.convert, and LookupError if the type is not prepared.
    """
    decoder(kind)
    return msgspec.convert(value, kind)
