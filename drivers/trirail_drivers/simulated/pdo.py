"""Process data objects of a simulated device: mapping rules, packing, and times of transmission (CiA 301, PDO)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from struct import Struct

from canopen import SdoAbortedError

from trirail_drivers.simulated.dictionary import (
    INVALID_VALUE,
    NO_OBJECT,
    NOT_MAPPABLE,
    PDO_TOO_LONG,
    UNSUPPORTED_ACCESS,
    WRONG_STATE,
    Dictionary,
    ObjectEntry,
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
"""CAN-IDs forbidden for PDOs (CiA 301, restricted CAN-IDs)."""
_MOST_BYTES = 8
_ON_EVENT = 255
"""Transmission type of event-driven PDOs, whose events the device profile defines."""


class Pdo(ABC):
    """PDO in either direction: communication parameters, mapping, and the rules for changing both."""

    def __init__(self, objects: Dictionary, communication: int, mapping: int, changed: Callable[[], None]) -> None:
        self.number = communication % 0x200 + 1
        self._objects = objects
        self._mapping = mapping
        self._cob_id = objects.internal(communication, 1, _NOT_VALID)
        self._type = objects.internal(communication, 2, _ON_EVENT)
        self._most = 0
        """Maximum number of objects in the mapping."""
        while (mapping, self._most + 1) in objects:
            self._most += 1
        defaults = [objects.internal(mapping, n).default for n in range(1, self._most + 1)]
        self._count = objects.internal(mapping, 0, (*defaults, 0).index(0))
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
        """CAN-ID of the PDO's frames."""
        return self._cob_id.value & _CAN_ID

    @property
    def remote(self) -> bool:
        """Whether the PDO may be requested with a remote frame (bit 30 of its COB-ID is clear)."""
        return not self._cob_id.value & _NO_REMOTE

    @property
    def synchronous(self) -> bool:
        """Whether the PDO is sent or applied at a SYNC (transmission types 0 to 240)."""
        return self._type.value <= 240

    def refresh(self) -> None:
        """Compute the packing from the mapping, so that this need not be done in each cycle."""
        self.entries = tuple(self._mapped(value) for value in self._values())
        self.layout = Struct("<" + "".join(entry.format for entry in self.entries))
        self._plain = all(entry.plain for entry in self.entries)

    def power_on(self) -> None:
        """Apply the mapping of the EDS. If the device would refuse to write this mapping, nothing is mapped."""
        try:
            self.refresh()
        except SdoAbortedError:
            self.entries, self.layout, self._plain = (), Struct("<"), True

    @abstractmethod
    def permits(self, entry: ObjectEntry) -> bool:
        """Return whether `entry` may be mapped in this direction."""

    @abstractmethod
    def reset(self) -> None:
        """Discard received or sent data."""

    def _values(self) -> list[int]:
        """Return the mapping parameters up to the count. In some EDS files, the count exceeds the mapping."""
        values = [self._objects[self._mapping, n].value for n in range(1, min(self._count.value, self._most) + 1)]
        return values[: (*values, 0).index(0)]

    def _mapped(self, value: int) -> ObjectEntry:
        """Return the entry that a mapping parameter names by index, subindex and length [bits].

        Raises SdoAbortedError if there is no such entry, or if it must not be mapped.
        """
        index, subindex, bits = value >> 16, value >> 8 & 0xFF, value & 0xFF
        if not value:
            raise SdoAbortedError(NO_OBJECT)
        entry = self._objects[index, subindex]
        if not (entry.mappable and self.permits(entry) and entry.size and bits == 8 * entry.size):
            raise SdoAbortedError(NOT_MAPPABLE)
        return entry

    def _mapping_written(self, entry: ObjectEntry, old: int) -> None:
        """Check that a mapping is written in the prescribed order (CiA 301, 1600h and 1A00h).

        The order is: switch the PDO off, set the count to 0, write the entries, write the count.
        """
        count = old if entry.subindex == 0 else self._count.value
        if self.valid or (entry.subindex and count):
            raise SdoAbortedError(UNSUPPORTED_ACCESS)
        if entry.subindex:
            if entry.value:
                self._mapped(entry.value)
            return
        if entry.value > self._most:
            raise SdoAbortedError(PDO_TOO_LONG)
        mapped = [self._mapped(self._objects[self._mapping, n].value) for n in range(1, entry.value + 1)]
        if sum(item.size or 0 for item in mapped) > _MOST_BYTES:
            raise SdoAbortedError(PDO_TOO_LONG)
        self.refresh()

    def _communication_written(self, entry: ObjectEntry, old: int) -> None:
        match entry.subindex:
            case 1:
                restricted = self.valid and any(self.can_id in ids for ids in _RESTRICTED)
                if entry.value & _EXTENDED or restricted:
                    raise SdoAbortedError(INVALID_VALUE)
                if self.valid and not old & _NOT_VALID and (entry.value ^ old) & ~_NOT_VALID:
                    raise SdoAbortedError(WRONG_STATE)
            case 2:
                if 240 < entry.value < 254:
                    raise SdoAbortedError(INVALID_VALUE)
            case 3:
                if self.valid:
                    raise SdoAbortedError(WRONG_STATE)
        self.reset()
        self._changed()


class ReceivePdo(Pdo):
    """RPDO, which is applied at the next SYNC (transmission types 0 to 240) or when it arrives (254, 255)."""

    _latched: tuple[int | bytes, ...] | None = None

    def permits(self, entry: ObjectEntry) -> bool:
        """Return whether the entry may be written over the bus."""
        return entry.writable

    def reset(self) -> None:
        """Discard the latched values."""
        self._latched = None

    def receive(self, data: bytes) -> None:
        """Receive a frame, which must contain all mapped bytes."""
        self._latched = self.layout.unpack_from(data)
        if not self.synchronous:
            self.write_latched()

    def write_latched(self) -> None:
        """Write the latched values. A value that the object would also refuse from an SDO is skipped."""
        values, self._latched = self._latched, None
        if values is None:
            return
        for entry, value in zip(self.entries, values, strict=True):
            try:
                if isinstance(value, int):
                    entry.write(value)
                else:
                    entry.load(value)
            except SdoAbortedError:
                continue


class TransmitPdo(Pdo):
    """TPDO, sent at every n-th SYNC (type n), at a SYNC after a change (type 0), or on a change (254, 255)."""

    def __init__(self, objects: Dictionary, communication: int, mapping: int, changed: Callable[[], None]) -> None:
        super().__init__(objects, communication, mapping, changed)
        self._inhibit = objects.internal(communication, 3)
        self._event_timer = objects.internal(communication, 5)
        self.reset()

    def permits(self, entry: ObjectEntry) -> bool:
        """Return whether the entry may be read over the bus."""
        return entry.readable

    def reset(self) -> None:
        """Reset the state: nothing has been sent, and no SYNC has been counted."""
        self._syncs = 0
        self._sent: bytes | None = None
        self._sent_at = 0.0

    def pack(self) -> bytes:
        """Return the current mapped values."""
        if self._plain:
            return self.layout.pack(*[entry.value for entry in self.entries])
        return b"".join([entry.encode() for entry in self.entries])

    def at_sync(self) -> bytes | None:
        """Return the data to send at this SYNC, or None."""
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
        """Return the data to send at time `now` [s], or None.

        Data are sent on a change, or when the event timer has elapsed, but not within the inhibit time.
        """
        data = self.pack()
        if self._sent is not None:
            elapsed = now - self._sent_at
            timer = self._event_timer.value * 1e-3
            if (data == self._sent and not 0.0 < timer <= elapsed) or elapsed < self._inhibit.value * 1e-4:
                return None
        self._sent, self._sent_at = data, now
        return data
