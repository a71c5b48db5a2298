"""A device's objects, as its EDS describes them: values, access rules and what follows a write."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from struct import Struct

import canopen
from canopen.objectdictionary import ODVariable

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


class SdoAbort(Exception):
    """A request is refused, with an abort code of CiA 301 (SDO abort transfer)."""

    def __init__(self, code: int) -> None:
        super().__init__(f"SDO abort {code:08X}h")
        self.code = code


class Entry:
    """One object or sub-object. `value` is the integer it holds; the device's own code sets it directly."""

    __slots__ = (
        "_limits",
        "default",
        "index",
        "layout",
        "mappable",
        "on_write",
        "readable",
        "subindex",
        "text",
        "value",
    )

    def __init__(self, variable: ODVariable) -> None:
        self.index: int = variable.index
        self.subindex: int = variable.subindex
        self.readable: bool = variable.readable
        self.mappable: bool = variable.pdo_mappable
        self.on_write: Callable[[Entry, int], None] | None = None
        self.default = self.value = 0
        self.text = b""
        self.layout: Struct | None = None
        if isinstance(variable.default, str):
            self.text = variable.default.encode("ascii")
        else:
            self.layout = Struct(_LAYOUTS[variable.data_type or 0])
            self.default = self.value = variable.default or 0
        writable: bool = variable.writable
        self._limits = (variable.min, variable.max) if writable else None

    @property
    def writable(self) -> bool:
        """Whether the bus may write it."""
        return self._limits is not None

    @property
    def size(self) -> int:
        """Length in bytes."""
        return self.layout.size if self.layout else len(self.text)

    def encode(self) -> bytes:
        """The value as it travels, little-endian."""
        return self.layout.pack(self.value) if self.layout else self.text

    def decode(self, data: bytes) -> int:
        """The integer in `data`; its length must be the object's."""
        if self.layout is None or len(data) > self.layout.size:
            raise SdoAbort(TOO_LONG)
        if len(data) < self.layout.size:
            raise SdoAbort(TOO_SHORT)
        value: int = self.layout.unpack(data)[0]
        return value

    def write(self, value: int) -> None:
        """Take `value` from the bus, by SDO or PDO; refused, it raises SdoAbort and leaves the old one."""
        if self._limits is None:
            raise SdoAbort(READ_ONLY)
        low, high = self._limits
        if high is not None and value > high:
            raise SdoAbort(VALUE_TOO_HIGH)
        if low is not None and value < low:
            raise SdoAbort(VALUE_TOO_LOW)
        old, self.value = self.value, value
        if self.on_write is not None:
            try:
                self.on_write(self, old)
            except SdoAbort:
                self.value = old
                raise


_LAYOUTS = {2: "<b", 3: "<h", 4: "<i", 5: "<B", 6: "<H", 7: "<I"}
"""CiA 301 data types (INTEGER8 … UNSIGNED32) as struct formats."""


class Dictionary:
    """The object dictionary of one node."""

    def __init__(self, eds: Path, node: int) -> None:
        self._entries: dict[tuple[int, int], Entry] = {}
        self._indices: set[int] = set()
        for index, item in canopen.import_od(str(eds), node).items():
            self._indices.add(index)
            for variable in [item] if isinstance(item, ODVariable) else item.subindices.values():
                self._entries[index, variable.subindex] = Entry(variable)

    def __getitem__(self, key: tuple[int, int]) -> Entry:
        """The entry at (index, subindex); raises SdoAbort where there is none."""
        try:
            return self._entries[key]
        except KeyError:
            raise SdoAbort(NO_SUBINDEX if key[0] in self._indices else NO_OBJECT) from None

    def on_write(self, index: int, action: Callable[[Entry, int], None]) -> None:
        """Call `action(entry, old value)` after each write to `index`; it may refuse by raising SdoAbort."""
        for entry in self._entries.values():
            if entry.index == index:
                entry.on_write = action

    def restore(self, indices: range) -> None:
        """Give the objects in `indices` their power-on values."""
        for entry in self._entries.values():
            if entry.index in indices:
                entry.value = entry.default
