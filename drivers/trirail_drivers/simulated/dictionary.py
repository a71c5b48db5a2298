"""Object dictionary of a simulated device, as its EDS describes it: values, access rules and write callbacks."""

from __future__ import annotations

import configparser
from collections.abc import Callable
from pathlib import Path

from canopen import SdoAbortedError
from canopen.objectdictionary import ODVariable

from trirail_drivers.cia402 import eds
from trirail_drivers.cia402.eds import read


def compact_arrays(file: Path) -> dict[int, int]:
    """Return the number of elements of each array that the EDS describes in compact form (CiA 306, CompactSubObj)."""
    sections = configparser.RawConfigParser(inline_comment_prefixes=(";",), strict=False)
    with eds.open_text(file) as text:
        sections.read_file(text)
    return {
        int(section, 16): int(sections.get(section, "CompactSubObj"), 0)
        for section in sections.sections()
        if sections.has_option(section, "CompactSubObj")
    }


WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
UNSUPPORTED_ACCESS = 0x06010000
NO_OBJECT = 0x06020000
NOT_MAPPABLE = 0x06040041
PDO_TOO_LONG = 0x06040042
WRONG_LENGTH = 0x06070010
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
NO_SUBINDEX = 0x06090011
INVALID_VALUE = 0x06090030
VALUE_TOO_HIGH = 0x06090031
VALUE_TOO_LOW = 0x06090032
WRONG_STATE = 0x08000022
NO_DATA = 0x08000024

MAX_DOMAIN_SIZE = 1 << 16
"""Maximum size of a text or domain [bytes]."""

_UNSIGNED = {0x01: 1, 0x05: 1, 0x06: 2, 0x16: 3, 0x07: 4, 0x18: 5, 0x19: 6, 0x1A: 7, 0x1B: 8}
_SIGNED = {0x02: 1, 0x03: 2, 0x10: 3, 0x04: 4, 0x12: 5, 0x13: 6, 0x14: 7, 0x15: 8}
_OCTETS = {0x08: 4, 0x11: 8, 0x0C: 6, 0x0D: 6}
"""Sizes of CiA 301 data types [bytes]: BOOLEAN and UNSIGNED8 to 64; INTEGER8 to 64; REAL32, REAL64, TIME_OF_DAY and
TIME_DIFFERENCE.

The last four are stored as bytes, since no code here computes with them. Any other type is a text or a domain, of any
length.
"""
_BOOLEAN = 0x01
_FORMATS = {(1, False): "B", (1, True): "b", (2, False): "H", (2, True): "h", (4, False): "I", (4, True): "i",
            (8, False): "Q", (8, True): "q"}  # fmt: skip


class ObjectEntry:
    """Object or sub-object with its content: an integer or, for other data types, bytes.

    `value` is the integer. The code of the device sets it directly.
    """

    __slots__ = (
        "_default_content",
        "_limits",
        "_signed",
        "content",
        "default",
        "index",
        "integer",
        "mappable",
        "on_write",
        "readable",
        "size",
        "subindex",
        "unset",
        "value",
    )

    def __init__(self, variable: ODVariable) -> None:
        self.index: int = variable.index
        self.subindex: int = variable.subindex
        self.readable: bool = variable.readable
        self.mappable: bool = variable.pdo_mappable
        self.on_write: Callable[[ObjectEntry, int], None] | None = None
        kind = variable.data_type or 0
        self.integer = kind in _UNSIGNED or kind in _SIGNED
        self._signed = kind in _SIGNED
        self.size: int | None = (_UNSIGNED | _SIGNED | _OCTETS).get(kind)
        """Size of the value [bytes]; None if values of any length are possible."""
        eds_value = variable.value if variable.value is not None else variable.default
        self.unset = eds_value is None
        """Whether the EDS has no power-on value."""
        self.default = self.value = self._wrapped(eds_value) if self.integer and isinstance(eds_value, int) else 0
        self._default_content = self.content = b"" if self.integer else _octets(variable, eds_value, self.size)
        low, high = variable.min, variable.max
        if low is not None and high is not None and low > high:  # some EDS files write "no limit" this way
            low = high = None
        if kind == _BOOLEAN:
            low, high = 0, 1
        self._limits = (low, high) if variable.writable else None

    @property
    def writable(self) -> bool:
        """Whether the object may be written over the bus."""
        return self._limits is not None

    @property
    def format(self) -> str:
        """Format string for `struct`, if the size is fixed."""
        return _FORMATS.get((self.size or 0, self._signed), f"{self.size}s") if self.integer else f"{self.size}s"

    @property
    def plain(self) -> bool:
        """Whether `struct` can pack `value` with `format`; otherwise the result of `encode` must be packed."""
        return not self.format.endswith("s")

    def encode(self) -> bytes:
        """Return the value as it is transmitted, in little-endian order."""
        return (
            self._wrapped(self.value).to_bytes(self.size or 0, "little", signed=self._signed)
            if self.integer
            else self.content
        )

    def load(self, data: bytes) -> None:
        """Write bytes from the bus. If they are refused, raise SdoAbortedError and keep the old value."""
        if self._limits is None:
            raise SdoAbortedError(READ_ONLY)
        longest = self.size or MAX_DOMAIN_SIZE
        if len(data) > longest:
            raise SdoAbortedError(TOO_LONG)
        if self.size is not None and len(data) < self.size:
            raise SdoAbortedError(TOO_SHORT)
        if self.integer:
            self.write(int.from_bytes(data, "little", signed=self._signed))
        else:
            self.content = data

    def write(self, value: int) -> None:
        """Write an integer from an SDO or PDO. If it is refused, raise SdoAbortedError and keep the old value."""
        if self._limits is None:
            raise SdoAbortedError(READ_ONLY)
        low, high = self._limits
        if high is not None and value > high:
            raise SdoAbortedError(VALUE_TOO_HIGH)
        if low is not None and value < low:
            raise SdoAbortedError(VALUE_TOO_LOW)
        old, self.value = self.value, value
        if self.on_write is not None:
            try:
                self.on_write(self, old)
            except SdoAbortedError:
                self.value = old
                raise

    def store(self, number: float) -> None:
        """Set the value to the integer nearest to `number` in the range of the data type; for the device's own code."""
        bits = 8 * (self.size or 0) - self._signed
        self.value = max(-(1 << bits) if self._signed else 0, min(round(number), (1 << bits) - 1))

    def _wrapped(self, eds_value: int) -> int:
        """Convert a value from the EDS, which may represent a negative number by its two's complement."""
        bits = 8 * (self.size or 0)
        value = eds_value % (1 << bits)
        return value - (1 << bits) if self._signed and value >> (bits - 1) else value

    def restore(self) -> None:
        """Restore the power-on value."""
        self.value, self.content = self.default, self._default_content


def _octets(variable: ODVariable, eds_value: object, size: int | None) -> bytes:
    """Return the EDS value of an object that is not an integer, as it is transmitted."""
    if isinstance(eds_value, int) and size is not None:  # EDS files write times as integers
        return (eds_value % (1 << 8 * size)).to_bytes(size, "little")
    if isinstance(eds_value, str | float):
        try:
            return bytes(variable.encode_raw(eds_value))
        except (ValueError, TypeError):  # text outside ASCII
            return str(eds_value).encode("utf-8")
    return bytes(eds_value) if isinstance(eds_value, bytes) else bytes(size or 0)


class Dictionary:
    """Object dictionary of one node."""

    def __init__(self, eds: Path, node: int) -> None:
        self._entries: dict[tuple[int, int], ObjectEntry] = {}
        self._indices: set[int] = set()
        self._hidden: dict[tuple[int, int], ObjectEntry] = {}
        objects = read(eds, node)
        compact = compact_arrays(eds)
        for index, item in objects.items():
            self._indices.add(index)
            variables = [item] if isinstance(item, ODVariable) else list(item.subindices.values())
            for variable in variables:
                self._entries[index, variable.subindex] = ObjectEntry(variable)
            for subindex in range(1, compact.get(index, 0) + 1):
                self._entries.setdefault((index, subindex), ObjectEntry(item[subindex]))
            if compact.get(index):
                self._entries[index, 0].default = self._entries[index, 0].value = compact[index]

    def add(self, index: int, subindex: int, bits: int, *, signed: bool) -> None:
        """Add an integer that may be written over the bus, unless the object already exists."""
        variable = ODVariable(f"Object {index:04X}", index, subindex)
        sizes = _SIGNED if signed else _UNSIGNED
        variable.data_type = next(kind for kind, size in sizes.items() if size * 8 == bits and kind != _BOOLEAN)
        variable.access_type = "rw"
        self._indices.add(index)
        self._entries.setdefault((index, subindex), ObjectEntry(variable))

    def __getitem__(self, key: tuple[int, int]) -> ObjectEntry:
        """Return the entry at (index, subindex). Raises SdoAbortedError if there is none."""
        try:
            return self._entries[key]
        except KeyError:
            raise SdoAbortedError(NO_SUBINDEX if key[0] in self._indices else NO_OBJECT) from None

    def __contains__(self, key: tuple[int, int]) -> bool:
        """Whether the device has the object."""
        return key in self._entries

    def internal(self, index: int, subindex: int, initial: int = 0) -> ObjectEntry:
        """Return the entry at (index, subindex), or an entry hidden from the bus if the device has none.

        `initial` is the power-on value if the EDS has none.
        """
        entry = self._entries.get((index, subindex)) or self._hidden.get((index, subindex))
        if entry is None:
            variable = ODVariable("", index, subindex)
            variable.data_type, variable.access_type = 0x15, ""
            entry = self._hidden[index, subindex] = ObjectEntry(variable)
        if entry.unset:
            entry.unset = False
            entry.default = entry.value = initial
        return entry

    def on_write(self, index: int, action: Callable[[ObjectEntry, int], None]) -> None:
        """Call `action(entry, old value)` after each write to `index`.

        `action` may raise SdoAbortedError to refuse the write.
        """
        for entry in self._entries.values():
            if entry.index == index:
                entry.on_write = action

    def restore(self, indices: range) -> None:
        """Restore the power-on values of the objects in `indices`."""
        for entry in (*self._entries.values(), *self._hidden.values()):
            if entry.index in indices:
                entry.restore()
