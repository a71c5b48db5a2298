"""A drive's object dictionary over SDO, without threads: reads, writes and checks that name what failed."""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import can
import canopen
from canopen.objectdictionary import INTEGER_TYPES, ObjectDictionary
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from trirail_drivers.cia402 import frames
from trirail_drivers.cia402.objects import MODE, MODE_DISPLAY, Key, signed, use, width
from trirail_drivers.errors import BusError, ConfigurationRefused, DriveError, DriveTimeout
from trirail_drivers.interface import Clock

# What canopen would say of a failed transfer is in the DriveError; standard error is for that one line.
logging.getLogger("canopen").addHandler(logging.NullHandler())


NO_SUCH_OBJECT: Final = (0x0602_0000, 0x0609_0011)
"""SDO abort codes: object does not exist, subindex does not exist (CiA 301)."""
READ_ONLY: Final = 0x0601_0002
"""SDO abort code: an attempt to write a read-only object."""
TOO_LONG: Final = 0x0607_0012
WRONG_LENGTH: Final = (0x0607_0010, TOO_LONG, 0x0607_0013)
"""SDO abort codes: the value is of another length than the object, longer, shorter."""
INVALID: Final = 1 << 31
"""Bit of a PDO's COB-ID: the PDO is not used."""
NO_REMOTE_REQUEST: Final = 1 << 30
"""Bit of a TPDO's COB-ID; some drives report it always, some never."""
_BIT_FIELDS: Final = (0x1005, 0x1014, 0x60A8, 0x60A9, 0x60AA, 0x6502)


SECOND_ANSWERS: Final = 10
"""So many requests of one set-up that are answered twice are answered by two nodes."""


class TwoNodesError(SdoCommunicationError):
    """Requests are answered twice."""

    def __init__(self, node: int) -> None:
        super().__init__(f"two nodes answer as node {node}; give each its own node id")


class NoAnswerError(SdoCommunicationError):
    """The drive has not answered in time."""


class Client(SdoClient):
    """An SDO client that reads the bus itself while it waits, where canopen would have a thread do it.

    A drive may still answer what somebody asked before, this service's last run or an attempt that was given up.
    So what is taken for the answer to a request is of its kind, and names the same object.
    """

    def __init__(self, bus: can.BusABC, node: int, objects: ObjectDictionary, timeout: float, clock: Clock) -> None:
        super().__init__(frames.SDO_REQUEST + node, frames.SDO_ANSWER + node, objects)  # type: ignore[no-untyped-call]
        self.network = canopen.Network(bus)
        self.bus = bus
        self.timeout = timeout
        self.clock = clock
        self._asked = self._answered = bytes(8)
        self._again = 0
        self._knows_no_segments = False

    def send_request(self, request: bytes | bytearray) -> None:
        """Send a request, whose answer the next one is that `read_response` takes."""
        self._asked, self._answered = bytes(request), self._asked
        super().send_request(request)  # type: ignore[no-untyped-call]

    def read_response(self) -> bytes:
        """Wait for the drive's answer; other frames are let go, for the cycle starts afresh."""
        deadline = self.clock() + self.timeout
        while self.responses.empty():
            message = self.bus.recv(max(0.0, deadline - self.clock()))
            if message is None:
                raise NoAnswerError("no answer")
            if message.arbitration_id == self.tx_cobid and not message.is_error_frame:
                data = bytes(message.data)
                if answers(self._asked, data):
                    self.responses.put(data)
                elif answers(self._answered, data):
                    self._note_second_answer()
        response: bytes = super().read_response()  # type: ignore[no-untyped-call]
        return response

    def upload(self, index: int, subindex: int) -> bytes:
        """All bytes that the drive has for an object: some tell four of one that is shorter."""
        with self.open(index, subindex, buffering=0) as stream:  # type: ignore[no-untyped-call]
            return bytes(stream.read())

    def try_download(self, index: int, subindex: int, size: int) -> None:
        """Begin to write so many bytes and give it up before the first; SdoAbortedError where the drive refuses.

        A segmented download, whose first frame has the length only (CiA 301, SDO download initiate). A drive that
        answers none is not asked again: it takes expedited ones alone, and each would be waited for.
        """
        if self._knows_no_segments:
            return
        request = struct.pack("<BHBI", _BEGIN_DOWNLOAD, index, subindex, size)
        try:
            self.request_response(request)  # type: ignore[no-untyped-call]
        except NoAnswerError:
            self._knows_no_segments = True
            return
        self.send_request(struct.pack("<BHBI", _ABORT << 5, index, subindex, _GIVEN_UP))
        # An abort is not answered, and the next request could overtake it in a drive that has room for one frame.
        self.bus.recv(PAUSE)

    def _note_second_answer(self) -> None:
        """The request before was answered already: once may be chance, so many times are two servers."""
        self._again += 1
        if self._again >= SECOND_ANSWERS:
            raise TwoNodesError(self.rx_cobid - frames.SDO_REQUEST)


def answers(request: bytes, data: bytes) -> bool:
    """Whether a frame of an SDO server can be the answer to a request (CiA 301, 7.2.4.3: the first byte's top bits)."""
    if len(data) != 8:
        return False
    asked, answered = request[0] >> 5, data[0] >> 5
    same_object = asked in _SEGMENTS or data[1:4] == request[1:4]
    return same_object and answered in (_ANSWERS[asked], _ABORT)


_ANSWERS: Final = {0: 1, 1: 3, 2: 2, 3: 0, 4: 4}
"""Command specifiers: the client's for download segment, download, upload, upload segment, abort; the answer's."""
_SEGMENTS: Final = (0, 3)
"""Those whose frames name no object."""
_ABORT: Final = 4
_BEGIN_DOWNLOAD: Final = 0x21
"""Download initiate, not expedited, with the length."""
_GIVEN_UP: Final = 0x0800_0000
"""SDO abort code: general."""
EXPEDITED: Final = 4
"""So many bytes travel with the first frame."""
PAUSE: Final = 0.002
"""What a drive is given to take an abort in [s]."""


class SdoRefused(DriveError):
    """A drive refused a request about an object."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class Remote:
    """A drive's object dictionary over SDO; every failure is told as this drive's and this object's.

    What was read is kept until it is written: nobody else sets the drive up meanwhile.
    """

    rehearsed = False
    """Whether nothing is written."""
    asks = False
    """Whether the drive is asked what it would take."""

    def __init__(self, name: str, client: Client) -> None:
        self.name = name
        self.client = client
        self._read: dict[Key, bytes | None] = {}
        self._missing: set[Key] = set()
        self._writable: dict[Key, bool] = {}

    def look(self, index: int, subindex: int = 0) -> int | None:
        """Value of an object; None where the drive has none to tell: it lacks the object, or cannot read it."""
        key = index, subindex
        if key not in self._read and key not in self._missing:
            try:
                with self._told("read", key):
                    self._read[key] = self.client.upload(index, subindex)
            except SdoRefused as refusal:
                if refusal.code in NO_SUCH_OBJECT:
                    self._missing.add(key)
                else:
                    self._read[key] = None
        data = self._read.get(key)
        return None if data is None else self._value(key, data)

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the drive has an object."""
        self.look(index, subindex)
        return (index, subindex) not in self._missing

    def read(self, index: int, subindex: int = 0) -> int:
        """Value of an object, as it is now; SdoRefused where the drive has none to tell."""
        key = index, subindex
        with self._told("read", key):
            data = self._read[key] = self.client.upload(index, subindex)
        return self._value(key, data)

    def write(self, index: int, subindex: int, value: int) -> None:
        """Give an object a value; SdoRefused where the drive does not take it."""
        key = index, subindex
        data = self._encoded(key, value)
        self._read.pop(key, None)
        with self._told(f"write {shown(index, subindex, value)} to", key):
            self.client.download(index, subindex, data)

    def may_be_written(self, index: int, subindex: int = 0) -> bool:
        """Whether the drive lets an object be written, as far as it says so before it is."""
        key = index, subindex
        if key not in self._writable:
            try:
                self._try_to_write("write", key, self.bits(index, subindex) // 8)
            except SdoRefused:
                self._writable[key] = False
            else:
                self._writable[key] = True
        return self._writable[key]

    def _try_to_write(self, attempt: str, key: Key, size: int) -> None:
        """SdoRefused where the drive says that an object may not be written, or not with so many bytes.

        What else it says is no such word, as that it takes no segments.
        """
        try:
            with self._told(attempt, key):
                self.client.try_download(*key, size)
        except SdoRefused as refusal:
            read = len(self._read.get(key) or b"") == size  # then the length is right
            if refusal.code in (READ_ONLY, *NO_SUCH_OBJECT, *(() if read else WRONG_LENGTH)):
                raise

    def bits(self, index: int, subindex: int = 0) -> int:
        """How long an object is: as it was read, else by the drive's EDS, else by the standards."""
        key = index, subindex
        self.look(index, subindex)
        known = self._read.get(key)
        return 8 * (self._size(key) if known is None else len(self._own(key, known)))

    def _encoded(self, key: Key, value: int) -> bytes:
        """A value as it travels; SdoRefused where it is too long for the object."""
        size = self.bits(*key) // 8
        if not size or not -1 << 8 * size - 1 <= value < 1 << 8 * size:
            raise SdoRefused(
                f"drive {self.name}: cannot write {shown(*key, value)} to {self._called(key)}: "
                f"it has {8 * size} bits, and the standard's {8 * width(key)} are wanted",
                TOO_LONG,
            )
        return (value & (1 << 8 * size) - 1).to_bytes(size, "little")

    def check(self, index: int, subindex: int, wanted: int) -> None:
        """Read an object back; ConfigurationRefused if its value is not the wanted one."""
        found = self.read(index, subindex)
        if not same(index, subindex, found, wanted):
            raise ConfigurationRefused(
                self.name,
                self.name_of((index, subindex)),
                index,
                subindex,
                shown(index, subindex, wanted),
                shown(index, subindex, found),
            )

    def _value(self, key: Key, data: bytes) -> int:
        return int.from_bytes(self._own(key, data), "little", signed=signed(key))

    def _own(self, key: Key, data: bytes) -> bytes:
        """The bytes of an answer that are the object's, by its EDS: some drives fill it up to four."""
        variable = self.client.od.get_variable(*key)
        if len(data) > EXPEDITED or variable is None or not variable.fixed_size:
            return data
        return data[: len(variable) // 8]

    def _size(self, key: Key) -> int:
        """Bytes of an object that could not be read: by the drive's EDS, else by the standards."""
        variable = self.client.od.get_variable(*key)
        return len(variable) // 8 if variable is not None and variable.data_type in INTEGER_TYPES else width(key)

    def name_of(self, key: Key) -> str:
        """What people call an object."""
        variable = self.client.od.get_variable(*key)
        if variable is not None:
            return str(variable.qualname)
        found = use(key)
        return found[1].name if found else "not in its EDS"

    def _called(self, key: Key) -> str:
        return f"object {key[0]:04X}:{key[1]:02X} ({self.name_of(key)})"

    @contextmanager
    def _told(self, attempt: str, key: Key) -> Iterator[None]:
        """Turn what canopen and the bus raise into the one tree of errors."""
        called = self._called(key)
        try:
            yield
        except SdoAbortedError as error:
            reason = error.CODES.get(error.code, "for a reason of its own")
            raise SdoRefused(
                f"drive {self.name}: cannot {attempt} {called}: {reason} (SDO abort {error.code:08X})", error.code
            ) from error
        except TwoNodesError as error:
            raise DriveError(f"drive {self.name}: {error}") from error
        except NoAnswerError as error:
            raise DriveTimeout(self.name, f"answer about {called}", self.client.timeout) from error
        except SdoCommunicationError as error:
            raise DriveError(f"drive {self.name}: cannot {attempt} {called}: {error}") from error
        except (can.CanError, OSError) as error:
            raise BusError(f"drive {self.name}: cannot {attempt} {called}: {error}") from error


class Rehearsal(Remote):
    """A drive's object dictionary that nothing is written to; where it `asks`, the drive says whether it would take it.

    What is written is read back as if the drive held it. What a drive says of a value itself, it says only when it
    gets it.
    """

    rehearsed = True

    def __init__(self, remote: Remote, *, asks: bool) -> None:
        super().__init__(remote.name, remote.client)
        self.asks = asks
        self._read, self._missing, self._writable = remote._read, remote._missing, remote._writable
        self._written: dict[Key, bytes] = {}

    def look(self, index: int, subindex: int = 0) -> int | None:
        """Value of an object, as it would be; None where the drive has none to tell."""
        found = super().look(index, subindex)
        return found if found is None else self._would_be((index, subindex), found)

    def read(self, index: int, subindex: int = 0) -> int:
        """Value of an object, as it would be; SdoRefused where the drive has none to tell."""
        return self._would_be((index, subindex), super().read(index, subindex))

    def write(self, index: int, subindex: int, value: int) -> None:
        """Ask the drive whether an object may be written; SdoRefused where it may not."""
        key = index, subindex
        data = self._encoded(key, value)
        if self.asks:
            self._try_to_write(f"write {shown(index, subindex, value)} to", key, len(data))
        self._written[key] = data
        if key == MODE and self.bits(*MODE_DISPLAY) == self.bits(*MODE):
            self._written[MODE_DISPLAY] = data

    def _would_be(self, key: Key, found: int) -> int:
        data = self._written.get(key)
        return found if data is None else int.from_bytes(data, "little", signed=signed(key))


def is_pdo(index: int) -> bool:
    """Whether an object is a PDO's parameter or mapping."""
    return 0x1400 <= index < 0x1C00


def shown(index: int, subindex: int, value: int) -> str:  # noqa: ARG001
    """A value as people read it: bit fields as the standards write them."""
    if is_pdo(index) or index in _BIT_FIELDS:
        return f"{value & 0xFFFF_FFFF:08X}h"
    return str(value)


def same(index: int, subindex: int, one: int, other: int) -> bool:
    """Whether two values are the same to this service."""
    # Bit 30 of a PDO's COB-ID tells whether remote requests are answered: unused here, so either will do.
    ignored = NO_REMOTE_REQUEST if is_pdo(index) and not index & 0x200 and subindex == 1 else 0
    return one | ignored == other | ignored
