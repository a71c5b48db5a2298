"""Selection of the objects that are parameters of a drive, and conversion of their values."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

from canopen.objectdictionary import ObjectDictionary, ODVariable
from canopen.objectdictionary.datatypes import (
    BOOLEAN,
    DOMAIN,
    FLOAT_TYPES,
    OCTET_STRING,
    SIGNED_TYPES,
    UNSIGNED_TYPES,
)

from trirail_drivers.cia402.objects import Key

Value = int | float | str | bytes

_COMMANDS: Final = frozenset((0x1003, 0x1010, 0x1011, 0x1013, 0x1020, *range(0x1023, 0x1027)))
"""Command objects of CiA 301: error field, store and restore, time stamp, objects cleared by any write, OS command."""
_PROGRAMS: Final = range(0x1F50, 0x1F60)
_NMT_REQUESTS: Final = (0x1F82, 0x1F83)
"""Command objects of CiA 302: program download and control, and requests to the NMT master."""
_PROCESS: Final = frozenset(
    (0x603F, *range(0x6040, 0x6046), *range(0x6060, 0x6065), 0x6069, 0x606B, 0x606C, 0x6071, 0x6074,
     *range(0x6077, 0x607B), *range(0x60B0, 0x60B3), *range(0x60B8, 0x60BE), 0x60C1, *range(0x60D1, 0x60DA),
     0x60E4, 0x60E5, 0x60F4, 0x60FA, 0x60FC, 0x60FD, 0x60FF)
)  # fmt: skip
"""Process data of CiA 402-2: control- and statuswords, modes, targets, offsets, demands, actual values, touch probes,
inputs."""
_OUTPUTS: Final[Key] = 0x60FE, 1
"""Digital outputs; their mask 60FE:02 is a parameter."""
_MAKERS: Final = range(0x2000, 0x6000)
_PROFILE: Final = range(0x6000, 0xA000)
_NEXT_AXIS: Final = 0x800
"""Offset of the objects of a second axis (CiA 402-2)."""


class Parameter(NamedTuple):
    """Content of one object of a drive."""

    data_type: int
    """CiA 301 data type."""
    data: bytes
    """Value as transferred by SDO."""
    name: str

    @property
    def value(self) -> int | float | str:
        """Value for people: a number, a text, or bytes in hexadecimal."""
        value = decode(self.data_type, self.data)
        return value.hex(" ") if isinstance(value, bytes) else value

    @property
    def fixed_size(self) -> bool:
        """Whether all values of the data type have the same length."""
        return self.data_type in ODVariable.STRUCT_TYPES


def named(key: Key) -> str:
    """Return an object's index and subindex as written in files and tables, such as 6065:00."""
    return f"{key[0]:04X}:{key[1]:02X}"


def variables(objects: ObjectDictionary) -> Iterator[tuple[Key, ODVariable]]:
    """Yield every object and sub-object of a dictionary in order."""
    for index, item in objects.items():
        members = [item] if isinstance(item, ODVariable) else item.subindices.values()
        yield from sorted(((index, each.subindex), each) for each in members)


def is_parameter(variable: ODVariable) -> bool:
    """Whether an object is a parameter: it can be read and written, and is neither process data nor a command."""
    index, access = variable.index, variable.access_type
    if not (variable.readable and variable.writable) or variable.data_type == DOMAIN:
        return False
    if index in _COMMANDS or index in _PROGRAMS or index in _NMT_REQUESTS:
        return False
    if index in _PROFILE:
        index = 0x6000 + index % _NEXT_AXIS
        return index not in _PROCESS and (index, variable.subindex) != _OUTPUTS
    # CiA 306: an rwr object that can be mapped is meant for TPDOs, so the drive itself sets its value.
    return not (index in _MAKERS and access == "rwr" and variable.pdo_mappable)


def parameter(data_type: int | None, data: bytes, name: str) -> Parameter:
    """Return bytes as a parameter with the data type of the EDS or, if this does not fit, a data type that does."""
    sign = next((types for types in (SIGNED_TYPES, (BOOLEAN, *UNSIGNED_TYPES)) if data_type in types), ())
    for each in (data_type or OCTET_STRING, *sign):
        if _is_exact(each, data):
            return Parameter(each, data, name)
    return Parameter(OCTET_STRING, data, name)


def decode(data_type: int, data: bytes) -> Value:
    """Decode bytes according to a data type of CiA 301."""
    value = _variable(data_type).decode_raw(data)
    return int(value) if isinstance(value, bool) else bytes(value) if isinstance(value, bytearray) else value


def encode(data_type: int, value: Value, where: str = "") -> bytes:
    """Encode a value for transfer by SDO. Raises ValueError if the data type does not allow the value."""
    try:
        data = bytes(_variable(data_type).encode_raw(value))
        if data_type in FLOAT_TYPES or decode(data_type, data) == value:
            return data
    except (AttributeError, OverflowError, TypeError, ValueError):
        pass
    raise ValueError(f"{where}{value!r} is not a value of data type {data_type:04X}h")


def _variable(data_type: int) -> ODVariable:
    variable = ODVariable("", 0)
    variable.data_type = data_type
    return variable


def _is_exact(data_type: int, data: bytes) -> bool:
    """Whether a file can represent the bytes exactly as a value of a data type."""
    codec = ODVariable.STRUCT_TYPES.get(data_type)
    if codec is not None and codec.size != len(data):
        return False
    value = decode(data_type, data)
    if isinstance(value, bytes) or (isinstance(value, float) and math.isnan(value)):  # no text keeps the bits of a NaN
        return data_type == OCTET_STRING
    # A DCF cannot represent a text with line breaks, spaces at its ends, or a semicolon, which begins a comment.
    if isinstance(value, str) and (not value.isprintable() or value != value.strip() or ";" in value):
        return False
    try:
        return encode(data_type, value) == data
    except ValueError:
        return False
