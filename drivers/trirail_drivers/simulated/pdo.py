"""Process data objects: mapping rules, packing, and when they take effect (CiA 301, PDO)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from struct import Struct

from trirail_drivers.simulated.dictionary import (
    INVALID_VALUE,
    NO_OBJECT,
    NOT_MAPPABLE,
    PDO_TOO_LONG,
    UNSUPPORTED_ACCESS,
    WRONG_STATE,
    Dictionary,
    ObjectEntry,
    SdoAbort,
)

_NOT_VALID = 1 << 31
_NO_REMOTE = 1 << 30
_EXTENDED = 1 << 29
_CAN_ID = 0x7FF
_RESTRICTED = (
    range(0x080),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x800),
)
"""CAN-IDs that no PDO may have (CiA 301, restricted CAN-IDs)."""
_MOST_BYTES = 8
_ON_EVENT = 255
"""Transmission type: as the device profile has it."""


class Pdo(ABC):
    """What both directions share: communication parameter, mapping, and the rules for changing them."""

    def __init__(self, objects: Dictionary, communication: int, mapping: int, changed: Callable[[], None]) -> None:
        self.number = communication % 0x200 + 1
        self._objects = objects
        self._mapping = mapping
        self._cob_id = objects.internal(communication, 1, _NOT_VALID)
        self._type = objects.internal(communication, 2, _ON_EVENT)
        self._most = 0
        """Objects that its mapping has room for."""
        while (mapping, self._most + 1) in objects:
            self._most += 1
        given = [objects.internal(mapping, n).default for n in range(1, self._most + 1)]
        self._count = objects.internal(mapping, 0, (*given, 0).index(0))
        self._changed = changed
        self.entries: tuple[ObjectEntry, ...] = ()
        self.layout = Struct("<")
        self._plain = True
        objects.on_write(communication, self._communication_written)
        objects.on_write(mapping, self._mapping_written)
        self.power_on()

    @property
    def valid(self) -> bool:
        """Whether the PDO exists (bit 31 of its COB-ID is clear)."""
        return not self._cob_id.value & _NOT_VALID

    @property
    def can_id(self) -> int:
        """The CAN-ID that it is sent with."""
        return self._cob_id.value & _CAN_ID

    @property
    def remote(self) -> bool:
        """Whether a remote frame may ask for it (bit 30 of its COB-ID is clear)."""
        return not self._cob_id.value & _NO_REMOTE

    @property
    def synchronous(self) -> bool:
        """Whether it goes by SYNC (transmission types 0 to 240)."""
        return self._type.value <= 240

    def refresh(self) -> None:
        """Work out the packing from the mapping, so that the cycle has only to use it."""
        self.entries = tuple(self._mapped(value) for value in self._values())
        self.layout = Struct("<" + "".join(entry.format for entry in self.entries))
        self._plain = all(entry.plain for entry in self.entries)

    def power_on(self) -> None:
        """Take up the mapping that the EDS gives; where that is none that could be written, nothing is mapped."""
        try:
            self.refresh()
        except SdoAbort:
            self.entries, self.layout, self._plain = (), Struct("<"), True

    @abstractmethod
    def permits(self, entry: ObjectEntry) -> bool:
        """Whether `entry` may travel in this direction."""

    @abstractmethod
    def reset(self) -> None:
        """Forget what was received or sent."""

    def _values(self) -> list[int]:
        """The mapping as far as it is counted; the counts that some drives have at power-on go beyond it."""
        values = [self._objects[self._mapping, n].value for n in range(1, min(self._count.value, self._most) + 1)]
        return values[: (*values, 0).index(0)]

    def _mapped(self, value: int) -> ObjectEntry:
        """The entry that a mapping parameter names: index, subindex, length in bits."""
        index, subindex, bits = value >> 16, value >> 8 & 0xFF, value & 0xFF
        if not value:
            raise SdoAbort(NO_OBJECT)
        entry = self._objects[index, subindex]
        if not (entry.mappable and self.permits(entry) and entry.size and bits == 8 * entry.size):
            raise SdoAbort(NOT_MAPPABLE)
        return entry

    def _mapping_written(self, entry: ObjectEntry, old: int) -> None:
        """CiA 301, 1600h and 1A00h: first no PDO, then no entries, then the entries, then how many."""
        count = old if entry.subindex == 0 else self._count.value
        if self.valid or (entry.subindex and count):
            raise SdoAbort(UNSUPPORTED_ACCESS)
        if entry.subindex:
            if entry.value:
                self._mapped(entry.value)
            return
        if entry.value > self._most:
            raise SdoAbort(PDO_TOO_LONG)
        mapped = [self._mapped(self._objects[self._mapping, n].value) for n in range(1, entry.value + 1)]
        if sum(item.size or 0 for item in mapped) > _MOST_BYTES:
            raise SdoAbort(PDO_TOO_LONG)
        self.refresh()

    def _communication_written(self, entry: ObjectEntry, old: int) -> None:
        match entry.subindex:
            case 1:
                restricted = self.valid and any(self.can_id in ids for ids in _RESTRICTED)
                if entry.value & _EXTENDED or restricted:
                    raise SdoAbort(INVALID_VALUE)
                if self.valid and not old & _NOT_VALID and (entry.value ^ old) & ~_NOT_VALID:
                    raise SdoAbort(WRONG_STATE)
            case 2:
                if 240 < entry.value < 254:
                    raise SdoAbort(INVALID_VALUE)
            case 3:
                if self.valid:
                    raise SdoAbort(WRONG_STATE)
        self.reset()
        self._changed()


class ReceivePdo(Pdo):
    """An RPDO: taken up at the SYNC after it arrived (types 0 to 240) or at once (254, 255)."""

    _latched: tuple[int | bytes, ...] | None = None

    def permits(self, entry: ObjectEntry) -> bool:
        """Only what the bus may write."""
        return entry.writable

    def reset(self) -> None:
        """Forget what was latched."""
        self._latched = None

    def receive(self, data: bytes) -> None:
        """Take in a frame that is long enough."""
        self._latched = self.layout.unpack_from(data)
        if not self.synchronous:
            self.write_latched()

    def write_latched(self) -> None:
        """Write what was latched; a value that an object refuses is left out, as an SDO's would be."""
        values, self._latched = self._latched, None
        if values is None:
            return
        for entry, value in zip(self.entries, values, strict=True):
            try:
                if isinstance(value, int):
                    entry.write(value)
                else:
                    entry.load(value)
            except SdoAbort:
                continue


class TransmitPdo(Pdo):
    """A TPDO: sent on every n-th SYNC, on a SYNC after a change (type 0), or on a change (254, 255)."""

    def __init__(self, objects: Dictionary, communication: int, mapping: int, changed: Callable[[], None]) -> None:
        super().__init__(objects, communication, mapping, changed)
        self._inhibit = objects.internal(communication, 3)
        self._event_timer = objects.internal(communication, 5)
        self.reset()

    def permits(self, entry: ObjectEntry) -> bool:
        """Only what the bus may read."""
        return entry.readable

    def reset(self) -> None:
        """Begin anew: nothing sent yet, no SYNC counted."""
        self._syncs = 0
        self._sent: bytes | None = None
        self._sent_at = 0.0

    def pack(self) -> bytes:
        """The mapped values as they are now."""
        if self._plain:
            return self.layout.pack(*[entry.value for entry in self.entries])
        return b"".join([entry.encode() for entry in self.entries])

    def at_sync(self) -> bytes | None:
        """The data to send on this SYNC, if any."""
        if self._type.value:
            self._syncs += 1
            if self._syncs < self._type.value:
                return None
            self._syncs = 0
            return self.pack()
        data = self.pack()
        if data == self._sent:
            return None
        self._sent = data
        return data

    def on_event(self, now: float) -> bytes | None:
        """The data to send at time `now` [s], if any: on a change or by event timer, unless inhibited."""
        data = self.pack()
        if self._sent is not None:
            elapsed = now - self._sent_at
            timer = self._event_timer.value * 1e-3
            if (data == self._sent and not 0.0 < timer <= elapsed) or elapsed < self._inhibit.value * 1e-4:
                return None
        self._sent, self._sent_at = data, now
        return data
