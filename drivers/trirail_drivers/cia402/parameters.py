"""Which of a drive's objects are its parameters, and their values as people read them."""

from __future__ import annotations

import math
import struct
from typing import Final, NamedTuple

from canopen.objectdictionary import ODVariable

from trirail_drivers.cia402.objects import Key

Value = int | float | str

_UNSIGNED: Final = {0x01: 1, 0x05: 1, 0x06: 2, 0x16: 3, 0x07: 4, 0x18: 5, 0x19: 6, 0x1A: 7, 0x1B: 8}
_SIGNED: Final = {0x02: 1, 0x03: 2, 0x10: 3, 0x04: 4, 0x12: 5, 0x13: 6, 0x14: 7, 0x15: 8}
_FLOATS: Final = {"f32": "<f", "f64": "<d"}
_KINDS: Final = (
    {code: f"u{8 * size}" for code, size in _UNSIGNED.items()}
    | {code: f"i{8 * size}" for code, size in _SIGNED.items()}
    | {0x08: "f32", 0x11: "f64", 0x09: "text"}
)
"""By CiA 301's data types; what is none of them is told as its bytes."""
BYTES: Final = "bytes"
KINDS: Final = (*dict.fromkeys(_KINDS.values()), BYTES)
_DOMAIN: Final = 0x0F
_LARGEST: Final = 2**63 - 1
"""Of TOML's integers."""

_COMMANDS: Final = frozenset((0x1003, 0x1010, 0x1011, 0x1013, 0x1020, *range(0x1023, 0x1027)))
"""Of CiA 301: the error field, store and restore, the time stamp, what any write sets to 0, and the OS command."""
_PROGRAMS: Final = range(0x1F50, 0x1F60)
_NMT_REQUESTS: Final = (0x1F82, 0x1F83)
"""Of CiA 302: program download and control; a master's requests."""
_PROCESS: Final = frozenset(
    (0x603F, *range(0x6040, 0x6046), *range(0x6060, 0x6065), 0x6069, 0x606B, 0x606C, 0x6071, 0x6074,
     *range(0x6077, 0x607B), *range(0x60B0, 0x60B3), *range(0x60B8, 0x60BE), 0x60C1, *range(0x60D1, 0x60DA),
     0x60E4, 0x60E5, 0x60F4, 0x60FA, 0x60FC, 0x60FD, 0x60FF)
)  # fmt: skip
"""Of CiA 402-2: control- and statuswords, modes, targets, offsets, demands, actual values, touch probes, inputs."""
_OUTPUTS: Final[Key] = 0x60FE, 1
"""The digital outputs themselves; 60FE:02, which of them may be set, is a parameter."""
_MAKERS: Final = range(0x2000, 0x6000)
_PROFILE: Final = range(0x6000, 0xA000)
_NEXT_AXIS: Final = 0x800
"""CiA 402-2: a second axis has its objects so much higher."""


class Parameter(NamedTuple):
    """What a drive holds in one object."""

    kind: str
    """One of KINDS."""
    data: bytes
    """As it travels."""
    name: str

    @property
    def value(self) -> Value:
        """For people: a number, a text, or bytes in hexadecimal."""
        return decoded(self.kind, self.data)


def named(key: Key) -> str:
    """An object as files and tables write it: 6065:00."""
    return f"{key[0]:04X}:{key[1]:02X}"


def is_parameter(variable: ODVariable) -> bool:
    """Whether an object is what a drive is given and keeps: read and written, no process data and no command."""
    index, access = variable.index, variable.access_type
    if not (variable.readable and variable.writable) or variable.data_type == _DOMAIN:
        return False
    if index in _COMMANDS or index in _PROGRAMS or index in _NMT_REQUESTS:
        return False
    if index in _PROFILE:
        index = 0x6000 + index % _NEXT_AXIS
        return index not in _PROCESS and (index, variable.subindex) != _OUTPUTS
    # CiA 306: rwr is a value that a TPDO can carry, so one that the drive itself gives.
    return not (index in _MAKERS and access == "rwr" and variable.pdo_mappable)


def parameter(variable: ODVariable, data: bytes) -> Parameter:
    """What a drive answered of an object."""
    return of_kind(_KINDS.get(variable.data_type or 0, BYTES), data, str(variable.qualname))


def of_kind(kind: str, data: bytes, name: str) -> Parameter:
    """Bytes as a value of a kind, or of one that they are: their length counts, whatever an EDS says."""
    if kind[0] in "ui":
        kind = f"{kind[0]}{8 * len(data)}"
    return Parameter(kind if kind in KINDS and _says_all(kind, data) else BYTES, data, name)


def decoded(kind: str, data: bytes) -> Value:
    """A value of one of KINDS."""
    if kind == BYTES:
        return data.hex(" ")
    if kind == "text":
        return data.decode("ascii")
    if kind in _FLOATS:
        return float(struct.unpack(_FLOATS[kind], data)[0])
    return int.from_bytes(data, "little", signed=kind[0] == "i")


def encoded(kind: str, value: Value) -> bytes:
    """A value as it travels; ValueError where it is none of its kind."""
    try:
        if kind == BYTES:
            return bytes.fromhex(str(value))
        if kind == "text":
            return str(value).encode("ascii")
        if kind in _FLOATS:
            return struct.pack(_FLOATS[kind], value)
        if isinstance(value, int):
            return value.to_bytes(int(kind[1:]) // 8, "little", signed=kind[0] == "i")
    except (OverflowError, struct.error) as error:
        raise ValueError(f"{value} is no {kind}") from error
    raise ValueError(f"{value} is no {kind}")


def _says_all(kind: str, data: bytes) -> bool:
    """Whether the bytes come back from the value that a file has for them."""
    try:
        value = decoded(kind, data)
        if isinstance(value, str):
            fits = kind == BYTES or value.isprintable()
        else:
            fits = (isinstance(value, float) or value <= _LARGEST) and not math.isnan(
                value
            )  # no text keeps the bits of a NaN
        return fits and encoded(kind, value) == data
    except (ValueError, struct.error):
        return False
